"""The oscillator's parameters: checked, immutable, and convertible from a rig in SI units."""

import dataclasses
import functools
import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.kernel import (
    Coulomb,
    Cubic,
    Discontinuous,
    Duffing,
    Excitation,
    Exponential,
    Gaussian,
    Hyperbolic,
    Inclined,
    Linear,
    Plant,
    ScaledFriction,
    ScaledSpring,
    Stribeck,
    Unexcited,
)
from sd_friction_env.physics.laws import checked_law, missing_gradient
from sd_friction_env.physics.theory import stribeck_coefficients

GEOMETRIES = ("exact", "cubic", "linear", "duffing")
FRICTIONS = ("stribeck", "coulomb", "hyperbolic", "exponential", "gaussian")
EXCITATIONS = ("force", "ripple", "stiffness")

SMALLEST_ALPHA = 1e-3  # below it only 0, the discontinuous limit
STATE_LIMIT = 10.0  # |x| and |v| of a start


def checked_number(name: str, value: Any, low: float, high: float) -> float:
    """Return ``value`` as a float.

    Raises:
        TypeError: if it is not a real number.
        ValueError: if it is not finite or not in [low, high].
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        kind = type(value).__name__
        raise TypeError(f"{name} must be a real number in [{low:g}, {high:g}], got {brief_repr(value)} ({kind})")
    try:
        number = float(value)
    except OverflowError:  # a whole number or a fraction beyond the greatest float
        raise ValueError(f"{name} must be a finite number in [{low:g}, {high:g}], got {brief_repr(value)}") from None
    if not low <= number <= high:  # refuses NaN too
        raise ValueError(f"{name} must be a finite number in [{low:g}, {high:g}], got {number!r}")
    return number


def checked_count(name: str, value: Any, low: int, high: int) -> int:
    """Return ``value`` as an int.

    Raises:
        TypeError: if it is not a real number.
        ValueError: if it is not whole or not in [low, high].
    """
    number = checked_number(name, value, low, high)
    if number != int(number):
        raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {brief_repr(value)}")
    return int(number)


def brief_repr(value: Any) -> str:
    """Return ``repr(value)`` for an error message, shortened where it is long.

    Python refuses to write whole numbers of more than 4,300 digits.
    """
    try:
        text = repr(value)
    except ValueError:
        return f"a value of type {type(value).__name__} with too many digits to be written"
    return text if len(text) <= 300 else f"{text[:100]}... ({len(text)} characters)"


def checked_choice(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """Return ``value`` if it is one of ``choices``.

    Raises:
        ValueError: if it is not.
    """
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {brief_repr(value)}")
    return str(value)


def checked_range(over: Any, choices: tuple[str, ...], argument: str = "over") -> tuple[str, float, float]:
    """Return ``over``, (name, low, high), with the name of a parameter among ``choices`` and its range checked.

    Raises:
        TypeError: if it is not of this form.
        ValueError: if the name is unknown, or low < high do not lie in the parameter's range.
    """
    if not isinstance(over, tuple | list) or len(over) != 3 or not isinstance(over[0], str):
        raise TypeError(f"{argument} must be (name, low, high), got {brief_repr(over)}")
    name = checked_choice(argument, over[0], choices)
    low, high = (checked_number(f"{argument}, {name},", value, *RANGES.get(name, (-1e12, 1e12))) for value in over[1:])
    if not low < high:
        raise ValueError(f"{argument} must be (name, low, high) with low < high, got {over!r}")
    return name, low, high


def _number(default: float, low: float, high: float, meaning: str, unit: str = "1", law: str = "") -> Any:
    """Return a field of :class:`OscillatorParameters`: its default, range, meaning, unit, and the law that uses it."""
    return dataclasses.field(
        default=default, metadata={"range": (low, high), "meaning": meaning, "unit": unit, "law": law}
    )


@dataclass(frozen=True, kw_only=True)
class OscillatorParameters:
    """Parameters of the self-excited SD oscillator (dimensionless; defaults: the nominal plant).

    The equation of motion is x'' = -2 beta x' - R(x) - mu(x' - v_belt) N(x) + u, with lengths in units of the free
    spring length and time in units of 1/omega0 (the paper's Eq. 4). A plant may be excited: by a force
    force_amplitude cos(force_frequency t + force_phase), by a ripple ripple_amplitude cos(...) on the belt's speed, and
    by a spring whose force is 1 + stiffness_amplitude cos(...) times as great, at every place.

    Attributes:
        geometry: "exact" (R and N of Eq. 4), "cubic" (their Taylor polynomials, Eq. 9: what the paper's figures show),
            "linear" (R = x, N = g1: the belt of Thomsen and Fidlin), "duffing" (R = linear_stiffness x + kappa x^3,
            N = g1), or a user-defined spring (:func:`spring_law`).
        alpha: height of the spring's anchor over the belt, H/L, in [0.001, 10]; unused by "linear" and "duffing". With
            "exact" also 0, the discontinuous limit R = x - sgn(x), N = g1: x = 0 switches the spring's force, which a
            mass that moves meets as on the side it moves to, and one at rest there as 0.
        g1: weight, g/(L omega0^2), in [0.001, 100].
        beta: damping ratio, C/(2 M omega0), in [0, 10].
        mu_s: static friction coefficient, in [0, 10].
        mu_m: least kinetic friction coefficient, in [0, 10]; of "stribeck", in [0, mu_s].
        v_m: relative speed at which friction is least, in [0.01, 100].
        belt_speed: the belt's (mean) speed v_b, in [0, 10].
        time_scale: seconds per unit of time, 1/omega0 (1 unless made by :meth:`from_physical`).
        length_scale: metres per unit of length, L (1 unless made by :meth:`from_physical`).
        force_scale: newtons per unit of force, K L (1 unless made by :meth:`from_physical`).
        friction: "stribeck" (Eq. 5, with mu_s, mu_m and v_m), "coulomb" (two levels: mu_s for stick, mu_k for slip),
            "hyperbolic" (mu_s/(1 + delta |w|) and mu_v w, w the relative velocity), "exponential"
            (mu_k + (mu_s - mu_k) exp(-|w|/v_0), and mu_v w), "gaussian" (the same with exp(-(w/v_0)^2)), or a law
            object: :func:`tabulated_friction`, :class:`Asymmetric`, or a user-defined one (:func:`friction_law`).
        mu_k: kinetic friction coefficient of "coulomb", least one of "exponential" and "gaussian", in [0, mu_s] where
            used.
        delta: of "hyperbolic", in [0, 1000].
        v_0: of "exponential" and "gaussian", in [0.001, 100].
        mu_v: viscous part of "hyperbolic", "exponential" and "gaussian", in [0, 10].
        linear_stiffness: of "duffing", in [-10, 10]; below 0 with kappa > 0 it has two wells, at constant N.
        kappa: of "duffing", in [-10, 10]; below 0 the spring softens.
        force_amplitude: of the exciting force, in [0, 100].
        ripple_amplitude: of the ripple on the belt's speed, in [0, 10].
        stiffness_amplitude: of the spring's modulation, in [0, 1].
        force_frequency, ripple_frequency, stiffness_frequency: in radians per unit of time, in [0.01, 1000].
        force_phase, ripple_phase, stiffness_phase: at t = 0, in radians, in [-10, 10].

    Raises:
        TypeError: if a value is not of the type above.
        ValueError: if a value lies outside its range.
    """

    geometry: Any = "exact"
    alpha: float = _number(0.8, 0.0, 10.0, "height of the spring's anchor, H/L", law="exact, cubic")
    g1: float = _number(1.0, 1e-3, 100.0, "weight, g/(L omega0^2)")
    beta: float = _number(0.05, 0.0, 10.0, "damping ratio, C/(2 M omega0)")
    mu_s: float = _number(0.2, 0.0, 10.0, "static friction coefficient")
    mu_m: float = _number(0.05, 0.0, 10.0, "least kinetic friction coefficient", law="stribeck")
    v_m: float = _number(0.5, 1e-2, 100.0, "relative speed at which friction is least", law="stribeck")
    belt_speed: float = _number(0.2, 0.0, 10.0, "belt speed v_b")
    time_scale: float = _number(1.0, 1e-12, 1e12, "1/omega0", "s")
    length_scale: float = _number(1.0, 1e-12, 1e12, "L", "m")
    force_scale: float = _number(1.0, 1e-12, 1e18, "K L", "N")
    friction: Any = "stribeck"
    mu_k: float = _number(0.1, 0.0, 10.0, "kinetic friction coefficient", law="coulomb, exponential, gaussian")
    delta: float = _number(3.0, 0.0, 1e3, "inverse of the speed at which friction halves", law="hyperbolic")
    v_0: float = _number(0.5, 1e-3, 100.0, "speed over which friction falls", law="exponential, gaussian")
    mu_v: float = _number(0.0, 0.0, 10.0, "viscous friction", law="hyperbolic, exponential, gaussian")
    linear_stiffness: float = _number(
        1.0, -10.0, 10.0, "linear stiffness; below 0 with kappa > 0 two wells", law="duffing"
    )
    kappa: float = _number(1.0, -10.0, 10.0, "cubic stiffness", law="duffing")
    force_amplitude: float = _number(0.0, 0.0, 100.0, "amplitude of the exciting force", law="force")
    force_frequency: float = _number(1.0, 1e-2, 1e3, "angular frequency of the exciting force", law="force")
    force_phase: float = _number(0.0, -10.0, 10.0, "phase of the exciting force at t = 0", "rad", law="force")
    ripple_amplitude: float = _number(0.0, 0.0, 10.0, "amplitude of the belt speed's ripple", law="ripple")
    ripple_frequency: float = _number(1.0, 1e-2, 1e3, "angular frequency of the ripple", law="ripple")
    ripple_phase: float = _number(0.0, -10.0, 10.0, "phase of the ripple at t = 0", "rad", law="ripple")
    stiffness_amplitude: float = _number(0.0, 0.0, 1.0, "modulation of the spring's force", law="stiffness")
    stiffness_frequency: float = _number(1.0, 1e-2, 1e3, "angular frequency of the modulation", law="stiffness")
    stiffness_phase: float = _number(0.0, -10.0, 10.0, "phase of the modulation at t = 0", "rad", law="stiffness")

    def __post_init__(self) -> None:
        object.__setattr__(self, "geometry", _floats(checked_law("geometry", self.geometry, GEOMETRIES)))
        object.__setattr__(self, "friction", _floats(checked_law("friction", self.friction, FRICTIONS)))
        for name, (low, high) in RANGES.items():
            object.__setattr__(self, name, checked_number(name, getattr(self, name), low, high))
        if self.friction == "stribeck" and self.mu_m > self.mu_s:
            raise ValueError(f"mu_m must not exceed mu_s = {self.mu_s!r}, got {self.mu_m!r}")
        if self.friction in ("coulomb", "exponential", "gaussian") and self.mu_k > self.mu_s:
            raise ValueError(f"mu_k must not exceed mu_s = {self.mu_s!r}, got {self.mu_k!r}")
        least = {"exact": 0.0, "cubic": SMALLEST_ALPHA} if isinstance(self.geometry, str) else {}
        if self.alpha < SMALLEST_ALPHA and self.alpha != least.get(self.geometry, self.alpha):
            zero = "" if self.geometry == "cubic" else "0 or "
            raise ValueError(f"alpha must be {zero}a finite number in [{SMALLEST_ALPHA:g}, 10], got {self.alpha!r}")

    @classmethod
    def from_physical(
        cls,
        M: float,
        K: float,
        C: float,
        L: float | None = None,
        H: float | None = None,
        g: float = 9.80665,
        V0: float | None = None,
        mu_s: float | None = None,
        mu_m: float | None = None,
        V_m: float | None = None,
        *,
        geometry: Any = "exact",
        friction: Any = "stribeck",
        **numbers: Any,
    ) -> Self:
        """Return the dimensionless parameters of a rig given in SI units (the paper's list above Eq. 4).

        Args:
            M: mass, kg. K: spring stiffness, N/m. C: damping coefficient, N s/m.
            L: free length of the spring, m; the unit of length. Of a level spring None: M g/K, so that g1 is 1.
            H: height of the spring's anchor over the belt, m; of "exact" and "cubic".
            g: acceleration of gravity (or the load that presses the mass on the belt, over M), m/s^2.
            V0: belt speed, m/s.
            mu_s, mu_m: friction coefficients. V_m: relative speed at which friction is least, m/s.
            geometry, friction: as in the class; the numbers of user-defined laws are in SI units.
            numbers: others that the laws need. ``mu_k``; ``V_0``, m/s; ``delta``, s/m; ``mu_v``, s/m (0 if not given);
                ``K3``, the cubic stiffness of "duffing", N/m^3; ``linear_stiffness``, over K (1 if not given);
                ``force_amplitude``, N; ``ripple_amplitude``, m/s; ``stiffness_amplitude``; each with ``_frequency``,
                rad/s, and ``_phase``.

        The result's ``time_scale``, ``length_scale`` and ``force_scale`` convert back to SI units: t = time_scale tau,
        X = length_scale x, dX/dt = length_scale / time_scale x', F = force_scale u.

        Raises:
            TypeError: if a number that the laws need is missing, or a name is unknown.
            ValueError: as the class does; M, K, L, g, V_m and V_0 must be positive.
        """
        given = {"mu_m": mu_m, "V_m": V_m, **numbers}
        given = {name: value for name, value in given.items() if value is not None}
        unknown = sorted(set(given) - set(_SI_NUMBERS))
        if unknown:
            raise TypeError(f"a rig has no number {unknown[0]!r}; allowed: {', '.join(_SI_NUMBERS)}")
        geometry = checked_law("geometry", geometry, GEOMETRIES)
        friction = checked_law("friction", friction, FRICTIONS)
        rig = {"L": L, "H": H, "V0": V0, "mu_s": mu_s, **given}
        for name in ("V0", *(name for law in (geometry, friction) if isinstance(law, str) for name in _SI_NEEDED[law])):
            if rig.get(name) is None:
                raise TypeError(f"{name} must be given with geometry {geometry!r} and friction {friction!r}")
        positive = {"M": M, "K": K, "g": g, **({} if L is None else {"L": L})}
        positive |= {name: given[name] for name in ("V_m", "V_0") if name in given}
        for name, value in positive.items():
            checked_number(name, value, math.ulp(0.0), 1e12)
        L = M * g / K if L is None else L
        alpha = {} if H is None else {"alpha": checked_number("H", H, 0.0, 1e12) / L}
        belt_speed = checked_number("V0", V0, 0.0, 1e12)
        checked_number("C", C, 0.0, 1e12)
        omega0 = math.sqrt(K / M)
        speed = L * omega0
        units = {"": 1.0, "speed": speed, "1/speed": 1.0 / speed, "force": K * L, "frequency": omega0}
        units["force/length^3"] = K / (L * L)
        fields = {}
        for name, value in given.items():
            field, unit = _SI_NUMBERS[name]
            fields[field] = checked_number(name, value, -1e18, 1e18) / units[unit]
        if not isinstance(friction, str):
            friction = ScaledFriction(friction, speed)
        if not isinstance(geometry, str):
            geometry = ScaledSpring(geometry, L, K * L)
        return cls(
            geometry=geometry,
            friction=friction,
            **alpha,
            g1=g / (L * omega0 * omega0),
            beta=C / (2.0 * M * omega0),
            **({} if mu_s is None else {"mu_s": mu_s}),
            belt_speed=belt_speed / speed,
            time_scale=1.0 / omega0,
            length_scale=L,
            force_scale=K * L,
            **fields,
        )

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed, checked anew.

        Numbers of a user-defined law are named ``friction.name`` and ``geometry.name``:
        ``p.replace(**{"friction.mu_s": 0.3})``.
        """
        unknown = set(changes) - {field.name for field in dataclasses.fields(self)} - set(self.law_numbers)
        if unknown:
            names = ", ".join([*(field.name for field in dataclasses.fields(self)), *self.law_numbers])
            raise ValueError(f"unknown parameter {sorted(unknown)[0]!r}; allowed: {names}")
        dotted = {name: changes.pop(name) for name in list(changes) if "." in name}
        for part in {name.split(".")[0] for name in dotted}:
            changes[part] = _with_numbers(getattr(self, part), f"{part}.", dotted)
        return dataclasses.replace(self, **changes)

    @property
    def k1(self) -> float:
        """Linear coefficient of the Stribeck law, 3/2 (mu_s - mu_m)/v_m (below Eq. 5)."""
        return stribeck_coefficients(self.mu_s, self.mu_m, self.v_m)[0]

    @property
    def k3(self) -> float:
        """Cubic coefficient of the Stribeck law, 1/2 (mu_s - mu_m)/v_m^3 (below Eq. 5)."""
        return stribeck_coefficients(self.mu_s, self.mu_m, self.v_m)[1]

    @property
    def excited(self) -> bool:
        """Whether a force, a ripple or a modulated stiffness acts."""
        return self.force_amplitude > 0.0 or self.ripple_amplitude > 0.0 or self.stiffness_amplitude > 0.0

    @property
    def unexcited(self) -> Self:
        """The same without excitation."""
        if not self.excited:
            return self
        return dataclasses.replace(self, force_amplitude=0.0, ripple_amplitude=0.0, stiffness_amplitude=0.0)

    @property
    def first_belt_speed(self) -> float:
        """The belt's speed at t = 0, ripple included."""
        return self.belt_speed + self.ripple_amplitude * math.cos(self.ripple_phase)

    @functools.cached_property
    def discontinuous(self) -> bool:
        """Whether x = 0 switches the spring's force: alpha = 0."""
        return bool(self.geometry == "exact" and self.alpha == 0.0)

    @functools.cached_property
    def law_numbers(self) -> dict[str, float]:
        """The numbers of user-defined laws, as ``friction.name`` and ``geometry.name``."""
        numbers: dict[str, float] = {}
        for part in ("geometry", "friction"):
            law = getattr(self, part)
            if not isinstance(law, str):
                names = (f"{part}.{name}" for name in kernel.leaf_names(law))
                numbers.update(zip(names, kernel.leaves_of(law), strict=True))
        return numbers

    @functools.cached_property
    def values(self) -> dict[str, float]:
        """All numbers by name, including those of user-defined laws."""
        return {name: getattr(self, name) for name in RANGES} | self.law_numbers

    @functools.cached_property
    def kind(self) -> "Kind":
        """The laws without their numbers."""
        geometry = "discontinuous" if self.discontinuous else _blank(self.geometry)
        return Kind(geometry, _blank(self.friction), self.excited)

    @functools.cached_property
    def plant(self) -> Plant:
        """The plant in the form that compiled code takes."""
        return plant_of(self.kind, self.values)

    def excited_plant(self, time: float) -> Plant:
        """Return the plant in its excited form at a time, even if its amplitudes are 0."""
        plant = plant_of(self.kind._replace(excited=True), self.values)
        return plant._replace(excitation=plant.excitation._replace(time=time))

    def plant_change(self, name: str, *, excited: bool | None = None) -> NDArray[np.float64]:
        """Return the derivatives of the plant's numbers (``kernel.leaf_names``) by a parameter, of its form by default.

        Raises:
            ValueError: if there is no such parameter, the plant does not use it, or its law offers no derivatives.
        """
        kind = self.kind if excited is None else self.kind._replace(excited=excited)
        if name not in self.values:
            raise ValueError(f"unknown parameter {name!r}; allowed: {', '.join(self.values)}")
        changes = plant_derivative(kind, self.values, name, self.plant if excited is None else None)
        if not changes.any():
            raise ValueError(f"the plant does not use the parameter {name!r}: {self}")
        law = getattr(self, name.partition(".")[0]) if "." in name else None
        lacks = None if law is None else missing_gradient(law)
        if lacks:
            raise ValueError(f"no derivative by {name!r}: {lacks}")
        return changes

    def restoring_force(self, x: float) -> float:
        """Return R(x), at time 0."""
        return float(kernel.restoring_force(self.plant, float(x)))

    def normal_force(self, x: float) -> float:
        """Return N(x), at time 0."""
        return float(kernel.normal_force(self.plant, float(x)))

    def friction_coefficient(self, v_rel: float) -> float:
        """Return mu(v_rel); at v_rel = 0, where it is set-valued, 0."""
        if v_rel == 0:
            return 0.0
        return float(self.plant.friction.coefficient(1 if v_rel > 0 else -1, float(v_rel)))


FIELDS: dict[str, Mapping[str, Any]] = {
    field.name: field.metadata for field in dataclasses.fields(OscillatorParameters) if field.metadata
}
RANGES: dict[str, tuple[float, float]] = {name: field["range"] for name, field in FIELDS.items()}  # both ends included


_SI_NEEDED = {  # by laws of a rig
    "exact": ("L", "H"),
    "cubic": ("L", "H"),
    "linear": (),
    "duffing": ("K3",),
    "stribeck": ("mu_s", "mu_m", "V_m"),
    "coulomb": ("mu_s", "mu_k"),
    "hyperbolic": ("mu_s", "delta"),
    "exponential": ("mu_s", "mu_k", "V_0"),
    "gaussian": ("mu_s", "mu_k", "V_0"),
}
_SI_NUMBERS = {  # of a rig, by their names in SI units: the field, and what it is divided by
    **{name: (name, "") for name in ("mu_m", "mu_k", "linear_stiffness", "stiffness_amplitude")},
    **{f"{means}_phase": (f"{means}_phase", "") for means in EXCITATIONS},
    **{f"{means}_frequency": (f"{means}_frequency", "frequency") for means in EXCITATIONS},
    "V_m": ("v_m", "speed"),
    "V_0": ("v_0", "speed"),
    "delta": ("delta", "1/speed"),
    "mu_v": ("mu_v", "1/speed"),
    "K3": ("kappa", "force/length^3"),
    "force_amplitude": ("force_amplitude", "force"),
    "ripple_amplitude": ("ripple_amplitude", "speed"),
}


class Kind(NamedTuple):
    """The laws of a plant without their numbers."""

    geometry: Any  # a name, or a user-defined spring with zeros; "discontinuous" for alpha = 0
    friction: Any  # a name, or a user-defined law with zeros
    excited: bool


def _floats(law: Any) -> Any:
    """Return a law with floats for whole numbers, which numba would compile a second time."""
    if isinstance(law, str):
        return law
    values = (_floats(value) if isinstance(value, tuple) else value for value in law)
    return law._make(float(value) if isinstance(value, int) else value for value in values)


def _blank(law: Any) -> Any:
    return law if isinstance(law, str) else _with_numbers(law, "", dict.fromkeys(kernel.leaf_names(law), 0.0))


def _with_numbers(law: Any, prefix: str, values: Mapping[str, Any]) -> Any:
    """Return a law with the numbers that ``values`` holds under its fields' names, after a prefix."""
    fields = {}
    for name, value in zip(law._fields, law, strict=True):
        nested = isinstance(value, tuple)
        path = prefix + name
        fields[name] = _with_numbers(value, f"{path}.", values) if nested else values.get(path, value)
    return type(law)(**fields)


def plant_derivative(kind: Kind, values: Mapping[str, Any], name: str, like: Any = None) -> NDArray[np.float64]:
    """Return the derivatives of a plant's numbers (``kernel.leaf_names``) by a parameter; ``like``: one of its form.

    They are exact: a step of 1e-20 in the imaginary direction has no rounding error (Squire and Trapp, 1998).
    """
    plant = plant_of(kind, {**values, name: complex(values[name], 1e-20)})
    return np.asarray(np.imag(np.array(kernel.leaves_of(plant, like))) / 1e-20)


def plant_of(kind: Kind, values: Mapping[str, Any]) -> Plant:
    """Return the plant with these laws and numbers, floats or arrays (n,)."""

    def numbers(*names: str) -> list[Any]:
        return [values[name] for name in names]

    spring: Any
    match kind.geometry:
        case "exact":
            spring = Inclined(values["alpha"])
        case "discontinuous":
            spring = Discontinuous(0.0)
        case "cubic":
            spring = Cubic(values["alpha"])
        case "linear":
            spring = Linear(1.0)
        case "duffing":
            spring = Duffing(values["linear_stiffness"], values["kappa"])
        case law:
            spring = _with_numbers(law, "geometry.", values)
    friction: Any
    match kind.friction:
        case "stribeck":
            friction = Stribeck(values["mu_s"], *stribeck_coefficients(*numbers("mu_s", "mu_m", "v_m")))
        case "coulomb":
            friction = Coulomb(*numbers("mu_s", "mu_k"))
        case "hyperbolic":
            friction = Hyperbolic(*numbers("mu_s", "delta", "mu_v"))
        case "exponential":
            friction = Exponential(*numbers("mu_s", "mu_k", "v_0", "mu_v"))
        case "gaussian":
            friction = Gaussian(*numbers("mu_s", "mu_k", "v_0", "mu_v"))
        case law:
            friction = _with_numbers(law, "friction.", values)
    excitation: Any = Unexcited(0.0)
    if kind.excited:
        names = [f"{means}_{what}" for means in EXCITATIONS for what in ("amplitude", "frequency", "phase")]
        excitation = Excitation._make((*numbers(*names), 0.0))
    return Plant(spring, friction, excitation, values["g1"], values["beta"])
