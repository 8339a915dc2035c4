"""Parameters of a batch's environments as columns of numbers, with their laws in a list, and their kinds of plant."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.info import law_codes
from sd_friction_env.environments.task import FloatArray, IntegerArray, Task, drifted
from sd_friction_env.physics.parameters import EXCITATIONS, RANGES, Kind, OscillatorParameters, plant_of


class Plants:
    """Conversion between :class:`OscillatorParameters` and the columns in which a batch stores them.

    A column has the numbers of the nominal parameters, those of its user-defined laws included, in the order of
    ``names``. ``laws`` lists the pairs of spring and friction in use, the nominal pair first.
    """

    def __init__(self, nominal: OscillatorParameters, task: Task) -> None:
        self.nominal = nominal
        self.names = tuple(nominal.values)
        self.laws: list[tuple[Any, Any]] = [(nominal.geometry, nominal.friction)]
        self.nominal_column = np.array(list(nominal.values.values()))[:, None]
        self._task = task

    def draw(self, keys: IntegerArray, episodes: IntegerArray) -> FloatArray:
        """Return the columns of episodes, the nominal numbers with the randomised ones drawn."""
        numbers = np.repeat(self.nominal_column, len(keys), axis=1)
        for name, values in self._task.draws(keys, episodes).items():
            numbers[self.names.index(name)] = values
        return numbers

    def drift(self, numbers: FloatArray, ends: FloatArray, steps: IntegerArray) -> FloatArray:
        """Return columns after some steps of their episodes; ``ends`` are the values at the end, in order of names."""
        rows = [self.names.index(name) for name in self._task.drift]
        numbers = numbers.copy()
        numbers[rows] = drifted(numbers[rows], ends, steps, self._task.episode_steps)
        return numbers

    def column_of(self, parameters: OscillatorParameters) -> tuple[list[float], int]:
        """Return the column of parameters, and the position of their laws in ``laws``."""
        numbers = self.nominal_column[:, 0].tolist()
        kind, nominal = parameters.unexcited.kind, self.nominal.unexcited.kind
        alike = kind.friction == nominal.friction and kind.geometry == nominal.geometry
        laws = self.laws[0] if alike else (parameters.geometry, parameters.friction)
        values = parameters.values
        pairs = zip(self.names, numbers, strict=True)
        numbers = [values[name] if name in RANGES or alike else number for name, number in pairs]
        if laws not in self.laws:
            self.laws.append(laws)
        return numbers, self.laws.index(laws)

    def parameters_of(self, column: FloatArray, law: int) -> OscillatorParameters:
        """Return the parameters in a column with the laws at a position in ``laws``."""
        values: dict[str, Any] = dict(zip(self.names, column.tolist(), strict=True))
        if law != 0:
            values = {name: value for name, value in values.items() if name in RANGES}
            values["geometry"], values["friction"] = self.laws[law]
        return self.nominal.replace(**values)

    def by_name(self, numbers: FloatArray) -> dict[str, FloatArray]:
        """Return the rows of columns by name."""
        return dict(zip(self.names, numbers, strict=True))

    def info(self, numbers: FloatArray, laws: IntegerArray) -> dict[str, NDArray[Any]]:
        """Return the parameters (k,) as info holds them, by name."""
        codes = [law_codes(*pair) for pair in self.laws]
        places = {name: np.array([code[name] for code in codes])[laws] for name in codes[0]}
        return {**places, **self.by_name(numbers)}

    def kinds_of(self, numbers: FloatArray, laws: IntegerArray) -> list[tuple[Kind, IntegerArray]]:
        """Return the kinds of plant among columns, each with the positions of its columns."""
        rows = self.by_name(numbers)
        excited = np.full(len(laws), self._task.always_excited)
        for means in EXCITATIONS:
            excited |= rows[f"{means}_amplitude"] > 0.0
        codes = 4 * laws + 2 * (rows["alpha"] == 0.0) + excited
        kinds: dict[Kind, IntegerArray] = {}
        for code in np.unique(codes).tolist():
            columns = np.flatnonzero(codes == code)
            parameters = self.parameters_of(numbers[:, columns[0]], code // 4)
            kind = self._task.kind_of(parameters)
            if code >= 4:  # columns lack the numbers of user-defined laws other than the nominal ones
                kind = kind._replace(
                    geometry=kind.geometry if isinstance(kind.geometry, str) else parameters.geometry,
                    friction=kind.friction if isinstance(kind.friction, str) else parameters.friction,
                )
            kinds[kind] = np.union1d(kinds[kind], columns) if kind in kinds else columns
        return list(kinds.items())

    def example(self, kind: Kind) -> kernel.Plant:
        """Return a plant of a kind, with the nominal numbers."""
        return plant_of(kind, self.nominal.values)

    def leaves(
        self, kinds: list[tuple[Kind, IntegerArray]], numbers: FloatArray, laws: IntegerArray
    ) -> Iterator[tuple[int, IntegerArray, Any]]:
        """Yield the plants' numbers as the kernel stores them: row, columns and values."""
        rows = self.by_name(numbers)
        for kind, columns in kinds:
            names = self.names if laws[columns[0]] == 0 else tuple(RANGES)
            here: Mapping[str, Any] = {name: rows[name][columns] for name in names}
            for row, values in enumerate(kernel.leaves_of(plant_of(kind, here), self.example(kind))):
                yield row, columns, values
