"""The oscillator's parameters as a person types them: checked, frozen, and convertible from a rig in SI units."""

import dataclasses
import math
import numbers
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

from sd_friction_env import kernel
from sd_friction_env.theory import stribeck_coefficients

Geometry = Literal["exact", "cubic", "linear", "duffing"]
Friction = Literal["stribeck", "coulomb", "hyperbolic", "exponential"]

GEOMETRIES: tuple[Geometry, ...] = get_args(Geometry)
FRICTIONS: tuple[Friction, ...] = get_args(Friction)
GEOMETRY_CODES = {"exact": kernel.EXACT, "cubic": kernel.CUBIC, "linear": kernel.LINEAR, "duffing": kernel.DUFFING}
FRICTION_CODES = {
    "stribeck": kernel.STRIBECK,
    "coulomb": kernel.COULOMB,
    "hyperbolic": kernel.HYPERBOLIC,
    "exponential": kernel.EXPONENTIAL,
}
EXCITATIONS = ("force", "ripple", "stiffness")

SMALLEST_ALPHA = 1e-3  # below it only 0, the discontinuous limit

# What is accepted, both ends included.
RANGES: dict[str, tuple[float, float]] = {
    "alpha": (0.0, 10.0),
    "g1": (1e-3, 100.0),
    "beta": (0.0, 10.0),
    "mu_s": (0.0, 10.0),
    "mu_m": (0.0, 10.0),
    "v_m": (1e-2, 100.0),
    "belt_speed": (0.0, 10.0),
    "time_scale": (1e-12, 1e12),
    "length_scale": (1e-12, 1e12),
    "force_scale": (1e-12, 1e18),
    "mu_k": (0.0, 10.0),
    "delta": (0.0, 1e3),
    "v_0": (1e-3, 100.0),
    "mu_v": (0.0, 10.0),
    "kappa": (0.0, 10.0),
    "force_amplitude": (0.0, 100.0),
    "force_frequency": (1e-2, 1e3),
    "force_phase": (-10.0, 10.0),
    "ripple_amplitude": (0.0, 10.0),
    "ripple_frequency": (1e-2, 1e3),
    "ripple_phase": (-10.0, 10.0),
    "stiffness_amplitude": (0.0, 1.0),
    "stiffness_frequency": (1e-2, 1e3),
    "stiffness_phase": (-10.0, 10.0),
}
STATE_LIMIT = 10.0  # |x| and |v| of a start


def law_numbers(friction: str) -> tuple[str, ...]:
    """Return which numbers a plant with this friction law has beyond the paper's, in the kernel's order."""
    decay = "delta" if friction == "hyperbolic" else "v_0"
    excitations = [f"{kind}_{what}" for kind in EXCITATIONS for what in ("amplitude", "frequency", "phase")]
    return ("mu_k", decay, "mu_v", "kappa", *excitations)


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
        TypeError: if it is not a real number. ValueError: if it is not whole or not in [low, high].
    """
    number = checked_number(name, value, low, high)
    if number != int(number):
        raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {brief_repr(value)}")
    return int(number)


def brief_repr(value: Any) -> str:
    """Return ``repr(value)`` for an error message, shortened where it is long.

    Whole numbers have no greatest: Python refuses to write one of more than 4,300 digits.
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


@dataclass(frozen=True, kw_only=True)
class OscillatorParameters:
    """Parameters of the self-excited SD oscillator (dimensionless; defaults: the nominal plant).

    The equation of motion is x'' = -2 beta x' - R(x) - mu(x' - v_belt) N(x) + u, with lengths in units of the free
    spring length and time in units of 1/omega0 (the paper's Eq. 4). A plant may be excited: by a force
    force_amplitude cos(force_frequency t + force_phase), by a ripple ripple_amplitude cos(...) on the belt's speed, and
    by a spring whose force is 1 + stiffness_amplitude cos(...) times as great, at every place.

    Attributes:
        geometry: "exact" (R and N of Eq. 4), "cubic" (their Taylor polynomials, Eq. 9: what the paper's figures show),
            "linear" (R = x, N = g1: the belt of Thomsen and Fidlin) or "duffing" (R = x + kappa x^3, N = g1).
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
            "hyperbolic" (mu_s/(1 + delta |w|), w the relative velocity) or "exponential"
            (mu_k + (mu_s - mu_k) exp(-|w|/v_0), and mu_v w).
        mu_k: kinetic friction coefficient of "coulomb", least one of "exponential", in [0, mu_s] where used.
        delta: of "hyperbolic", in [0, 1000].
        v_0: of "exponential", in [0.001, 100].
        mu_v: viscous part of "exponential", in [0, 10].
        kappa: of "duffing", in [0, 10].
        force_amplitude: of the exciting force, in [0, 100].
        ripple_amplitude: of the ripple on the belt's speed, in [0, 10].
        stiffness_amplitude: of the spring's modulation, in [0, 1].
        force_frequency, ripple_frequency, stiffness_frequency: in radians per unit of time, in [0.01, 1000].
        force_phase, ripple_phase, stiffness_phase: at t = 0, in radians, in [-10, 10].

    Raises:
        TypeError: if a value is not of the kind said above.
        ValueError: if a value lies outside its range.
    """

    geometry: Geometry = "exact"
    alpha: float = 0.8
    g1: float = 1.0
    beta: float = 0.05
    mu_s: float = 0.2
    mu_m: float = 0.05
    v_m: float = 0.5
    belt_speed: float = 0.2
    time_scale: float = 1.0
    length_scale: float = 1.0
    force_scale: float = 1.0
    friction: Friction = "stribeck"
    mu_k: float = 0.1
    delta: float = 3.0
    v_0: float = 0.5
    mu_v: float = 0.0
    kappa: float = 1.0
    force_amplitude: float = 0.0
    force_frequency: float = 1.0
    force_phase: float = 0.0
    ripple_amplitude: float = 0.0
    ripple_frequency: float = 1.0
    ripple_phase: float = 0.0
    stiffness_amplitude: float = 0.0
    stiffness_frequency: float = 1.0
    stiffness_phase: float = 0.0

    def __post_init__(self) -> None:
        checked_choice("geometry", self.geometry, GEOMETRIES)
        checked_choice("friction", self.friction, FRICTIONS)
        for name, (low, high) in RANGES.items():
            object.__setattr__(self, name, checked_number(name, getattr(self, name), low, high))
        if self.mu_m > self.mu_s and self.friction == "stribeck":
            raise ValueError(f"mu_m must not exceed mu_s = {self.mu_s!r}, got {self.mu_m!r}")
        if self.mu_k > self.mu_s and self.friction in ("coulomb", "exponential"):
            raise ValueError(f"mu_k must not exceed mu_s = {self.mu_s!r}, got {self.mu_k!r}")
        smallest = {"exact": 0.0, "cubic": SMALLEST_ALPHA}.get(self.geometry, self.alpha)
        if self.alpha < SMALLEST_ALPHA and self.alpha != smallest:
            zero = "" if self.geometry == "cubic" else "0 or "
            raise ValueError(f"alpha must be {zero}a finite number in [{SMALLEST_ALPHA:g}, 10], got {self.alpha!r}")

    @classmethod
    def from_physical(
        cls,
        M: float,
        K: float,
        C: float,
        L: float,
        H: float,
        g: float,
        V0: float,
        mu_s: float,
        mu_m: float,
        V_m: float,
        *,
        geometry: Geometry = "exact",
    ) -> Self:
        """Return the dimensionless parameters of a rig given in SI units (the paper's list above Eq. 4).

        Args:
            M: mass, kg. K: spring stiffness, N/m. C: damping coefficient, N s/m. L: free length of the spring, m.
            H: height of its anchor over the belt, m. g: acceleration of gravity, m/s^2. V0: belt speed, m/s.
            mu_s, mu_m: friction coefficients. V_m: relative speed at which friction is least, m/s.
            geometry: as in the class.

        The results' ``time_scale``, ``length_scale`` and ``force_scale`` lead back: t = time_scale tau,
        X = length_scale x, dX/dt = length_scale / time_scale x', F = force_scale u.

        Raises:
            TypeError, ValueError: as the class does; M, K, L, g and V_m must be positive.
        """
        for name, value in {"M": M, "K": K, "L": L, "g": g, "V_m": V_m}.items():
            checked_number(name, value, math.ulp(0.0), 1e12)
        for name, value in {"C": C, "H": H, "V0": V0}.items():
            checked_number(name, value, 0.0, 1e12)
        omega0 = math.sqrt(K / M)
        return cls(
            geometry=geometry,
            alpha=H / L,
            g1=g / (L * omega0 * omega0),
            beta=C / (2.0 * M * omega0),
            mu_s=mu_s,
            mu_m=mu_m,
            v_m=V_m / (L * omega0),
            belt_speed=V0 / (L * omega0),
            time_scale=1.0 / omega0,
            length_scale=L,
            force_scale=K * L,
        )

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed, checked anew."""
        unknown = set(changes) - {field.name for field in dataclasses.fields(self)}
        if unknown:
            names = ", ".join(field.name for field in dataclasses.fields(self))
            raise ValueError(f"unknown parameter {sorted(unknown)[0]!r}; allowed: {names}")
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

    @property
    def geometry_code(self) -> int:
        """The kernel's number of the spring's law."""
        if self.geometry == "exact" and self.alpha == 0.0:
            return kernel.DISCONTINUOUS
        return GEOMETRY_CODES[self.geometry]

    @property
    def beyond(self) -> bool:
        """Whether anything is asked for beyond the paper's laws: then the kernel's general form runs, slower."""
        return (
            self.friction != "stribeck" or self.excited or self.geometry_code in (kernel.DUFFING, kernel.DISCONTINUOUS)
        )

    @property
    def plant(self) -> kernel.Plant:
        """The values that compiled code takes."""
        laws = self.laws(0.0) if self.beyond else None
        return kernel.Plant(self.geometry_code, self.alpha, self.g1, self.beta, self.mu_s, self.k1, self.k3, laws)

    def laws(self, time: float) -> kernel.Laws:
        """Return the values that compiled code takes of what is beyond the paper's laws, at a time."""
        numbers = [getattr(self, name) for name in law_numbers(self.friction)]
        return kernel.Laws._make((0.0, FRICTION_CODES[self.friction], *numbers, time))

    def restoring_force(self, x: float) -> float:
        """Return R(x), at time 0."""
        return float(kernel.spring(self.plant, float(x))[0])

    def normal_force(self, x: float) -> float:
        """Return N(x), at time 0."""
        return float(kernel.spring(self.plant, float(x))[1])

    def friction_coefficient(self, v_rel: float) -> float:
        """Return mu(v_rel); at v_rel = 0, where it is set-valued, 0."""
        mode = (v_rel > 0) - (v_rel < 0)
        return float(kernel.friction_coefficient(self.plant, mode, float(v_rel)))
