"""Observers of one guess that constant gains correct."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.observers.observer import Observer

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class AlphaBetaFilter(Observer):
    """Position and velocity by two constant gains, without a model of the plant, for a belt actuator.

    x += x_gain e and v += v_gain e / control_interval with the reading's deviation e; between readings x moves by v.
    The nominal belt speed is the largest of 0.9 v/(v_belt/belt_speed) so far, because a mass that sticks has the belt's
    speed; other hidden parameters are taken for nominal. Source: Y. Bar-Shalom, X. R. Li and T. Kirubarajan,
    Estimation with Applications to Tracking and Navigation (2001), section 6.5.

    Attributes:
        x_gain, v_gain: in [0, 2].
    """

    x_gain: float = 0.4
    v_gain: float = 0.2

    _ranges: ClassVar = {**Observer._ranges, "x_gain": (0.0, 2.0), "v_gain": (0.0, 2.0)}
    _SHARE: ClassVar = 0.9

    @property
    def velocity_may_be_biased(self) -> bool:
        """False: the velocity is from the readings alone."""
        return False

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        return np.zeros((n, 1, self._width)), np.zeros((n, 0))

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        nominal = self.ensemble.nominal
        now = np.zeros((len(reading), 1, self._first))
        now[..., 0] = reading[:, :1]
        for i, (name, (low, _)) in enumerate(self.ensemble.ranges):
            now[..., 3 + i] = low if name == "belt_speed" else nominal.values[name]
        now[..., 2] = self.belt_speed(now[..., 3:])
        return self._row(now), np.zeros((len(reading), 0))

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        error = reading[:, :1] - guesses[..., self._first]
        guesses[..., 0] += self.x_gain * error
        guesses[..., 1] += self.v_gain / self.ensemble.task.control_interval * error
        guesses[..., self._first :: self._seen] += self.x_gain * error[..., None]
        if "belt_speed" in self.ensemble.names:
            column = 3 + self.ensemble.names.index("belt_speed")
            low, high = self.ensemble.task.randomise["belt_speed"]
            ratio = guesses[..., 2] / guesses[..., column]
            found = np.maximum(guesses[..., column], self._SHARE * guesses[..., 1] / np.maximum(ratio, 0.1))
            guesses[..., column] = np.clip(found, low, high)
            guesses[..., 2] = ratio * guesses[..., column]
        return guesses, spread

    def _step(
        self, guesses: _Floats, actions: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        task, now = self.ensemble.task, guesses[..., : self._first].copy()
        now[..., 0] += task.control_interval * now[..., 1]
        if task.actuator == "belt_speed":
            most = task.belt_acceleration_limit * task.control_interval
            target = (1.0 + task.belt_authority * actions) * self.belt_speed(now[..., 3:])
            now[..., 2] += np.clip(target - now[..., 2], -most, most)
        return self._row(now, guesses[..., self._first :]), spread


@dataclass(frozen=True)
class LuenbergerObserver(Observer):
    """State of the nominal plant, corrected by two constant gains; hidden parameters are taken for nominal.

    It keeps the state of the time at which the sensor took its reading. With the reading's deviation e, x moves by
    x_gain e and v by v_gain e; the actions since then advance the result over the delay. An episode begins at the
    belt's speed, because a squealing mass sticks for part of each cycle; a model that starts at rest takes longer to
    find the velocity. Source: D. G. Luenberger, An Introduction to Observers, IEEE Trans. Autom. Control 16 (1971) 596.

    Attributes:
        x_gain: share of the deviation, in [0, 2].
        v_gain: velocity per displacement, in [0, 1e6].
    """

    x_gain: float = 0.27
    v_gain: float = 0.18

    _ranges: ClassVar = {**Observer._ranges, "x_gain": (0.0, 2.0), "v_gain": (0.0, 1e6)}

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        """Return arrays for guesses, and for states at the readings' time with the actions since, oldest first."""
        return np.zeros((n, 1, self._width)), np.zeros((n, self._first + self.ensemble.task.sensor_delay))

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        nominal = self.ensemble.nominal
        now = np.full((len(reading), 1, self._first), nominal.belt_speed)
        now[..., : self._seen] = reading[:, None, : self._seen]
        now[..., 3:] = [nominal.values[name] for name, _ in self.ensemble.ranges]
        return self._row(now), np.pad(now[:, 0], ((0, 0), (0, self.ensemble.task.sensor_delay)))

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        error = reading[:, 0] - spread[:, 0]
        spread[:, 0] += self.x_gain * error
        spread[:, 1] += self.v_gain * error
        now, actions = spread[:, None, : self._first], spread[:, self._first :]
        for i, action in enumerate(actions.T):
            now = self._stepped(now, action[:, None], steps - len(actions.T) + i)
        guesses[..., : self._first] = now
        return guesses, spread

    def _step(
        self, guesses: _Floats, actions: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        ends, _ = super()._step(guesses, actions, spread, steps)
        read, since = spread[:, : self._first], np.concatenate([spread[:, self._first :], actions], axis=-1)
        passed = steps - self.ensemble.task.sensor_delay
        moved = self._stepped(read[:, None], since[:, :1], np.maximum(passed, 0))[:, 0]
        return ends, np.concatenate([np.where(passed[:, None] < 0, read, moved), since[:, 1:]], axis=-1)
