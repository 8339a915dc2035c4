"""What a law must offer, and how compiled code finds it by the law's type.

A law is a NamedTuple class with the methods below. ``plant.friction.coefficient(mode, v_rel)`` is plain Python when
interpreted; compiled, it is resolved by the class, so that every law gets machine code of its own. The functions of
this file are the protocol: their names, arguments and docstrings.
"""

import inspect
from collections.abc import Callable
from typing import Any

from numba import types
from numba.core.typing.templates import (
    infer,
    infer_getattr,
    infer_global,
    make_overload_method_template,
    make_overload_template,
)

from sd_friction_env.kernel.tuples import zeros_of

# As what stands in lanes: without a call left, a loop over lanes becomes vector instructions.
_OPTIONS: Any = {
    "error_model": "numpy",
    "nogil": True,
    "forceinline": True,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
SPRING: dict[str, Callable[..., Any]] = {}
FRICTION: dict[str, Callable[..., Any]] = {}
EXCITATION: dict[str, Callable[..., Any]] = {}
OPTIONAL: dict[str, Callable[..., Any]] = {}  # what spring_law and friction_law add to a class that lacks it


def _method_of(protocol: dict[str, Callable[..., Any]]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    def add(described: Callable[..., Any]) -> Callable[..., Any]:
        name = described.__name__

        def resolve(*arguments: Any) -> Any:
            return getattr(arguments[0].instance_class, name, None)

        resolve.__signature__ = inspect.signature(described)  # type: ignore[attr-defined]

        class OfLaws(make_overload_method_template(types.BaseNamedTuple, name, resolve, "never")):  # type: ignore[misc]
            """overload_method, but other NamedTuples keep their fields of this name."""

            def _resolve(self, typ: Any, attr: str) -> Any:
                return (
                    super()._resolve(typ, attr) if inspect.isfunction(getattr(typ.instance_class, attr, None)) else None
                )

        class Once(make_overload_template(resolve, resolve, _OPTIONS, True, "never")):  # type: ignore[misc]
            """overload, but compiled once for all callers, whatever options they are compiled with."""

            def _get_impl(self, args: Any, kws: Any) -> Any:
                key = self.context, tuple(args), tuple(kws.items())
                return self._impl_cache.get(key) or self._build_impl(key, args, kws)

        infer_getattr(OfLaws)
        infer_global(resolve, types.Function(infer(Once)))
        protocol[name] = described
        return described

    return add


_spring, _friction, _excitation = _method_of(SPRING), _method_of(FRICTION), _method_of(EXCITATION)


def _law_class(kind: str, protocol: dict[str, Callable[..., Any]], law: type) -> type:
    fields: tuple[str, ...] = getattr(law, "_fields", ())
    if not (issubclass(law, tuple) and fields):
        raise TypeError(f"a {kind} law must be a NamedTuple class with at least one field, got {law!r}")
    for name, described in protocol.items():
        method = getattr(law, name, None)
        wanted = inspect.signature(described)
        if method is None and name in OPTIONAL:
            if name == "breakaway_coefficient" and "mu_s" not in fields:
                raise TypeError(f"the {kind} law {law.__name__} lacks the field mu_s or the method {name}{wanted}")
            setattr(law, name, OPTIONAL[name])
            continue
        if not inspect.isfunction(method):
            text = (described.__doc__ or "").strip()
            raise TypeError(f"the {kind} law {law.__name__} lacks the method {name}{wanted}: {text}")
        if list(inspect.signature(method).parameters) != list(wanted.parameters):
            raise TypeError(f"{law.__name__}.{name} must have the arguments {wanted}, got {inspect.signature(method)}")
    _tell_classes_apart(law)
    return law


def _tell_classes_apart(law: Any) -> None:
    """Make a law unequal to one of another class with the same numbers, which tuples would be: caches go by it."""
    if law.__eq__ is tuple.__eq__:
        law.__eq__ = lambda self, other: type(self) is type(other) and tuple.__eq__(self, other)
        law.__hash__ = lambda self: hash((type(self), *self))
    law.__ne__ = lambda self, other: not self == other


def friction_law(law: type) -> Any:
    """Declare a NamedTuple class to be a friction law, and give it the methods that it may lack.

    Raises:
        TypeError: if a method lacks, or has other arguments.
    """
    return _law_class("friction", FRICTION, law)


def spring_law(law: type) -> Any:
    """Declare a NamedTuple class to be a spring, and give it the methods that it may lack.

    Raises:
        TypeError: if a method lacks, or has other arguments.
    """
    return _law_class("spring", SPRING, law)


def _default(method: Callable[..., Any]) -> Callable[..., Any]:
    OPTIONAL[method.__name__] = method
    return method


# Friction: the coefficient mu(v_rel), its sign frozen to the mode (-1 or 1): smooth across v_rel = 0 ------------------


@_friction
def coefficient(self, mode, v_rel):
    """Return mu(v_rel)."""


@_friction
def slope(self, mode, v_rel):
    """Return mu'(v_rel)."""


@_friction
def curvature(self, mode, v_rel):
    """Return mu''(v_rel)."""


@_friction
def third_derivative(self, mode, v_rel):
    """Return mu'''(v_rel)."""


@_default
@_friction
def breakaway_coefficient(self, mode):
    """Return the coefficient up to which stick holds against slip in this mode."""
    return self.mu_s


@_default
@_friction
def coefficient_gradient(self, mode, v_rel):
    """Return the derivatives of mu(v_rel) by the law's numbers, a tuple in their order."""
    return zeros_of(self)


@_default
@_friction
def breakaway_gradient(self, mode):
    """Return the derivatives of the breakaway coefficient by the law's numbers, a tuple in their order."""
    return zeros_of(self)


@_default
@_friction
def layer_width(self, mode):
    """Return over which v_rel friction changes where it changes over less than a step does, or 0."""
    return 0.0


@_default
@_friction
def may_be_steep(self):
    """Whether forces may grow so large that rounding hides the error estimate."""
    return True


# Springs: the restoring force R(x), the normal force N(x) of a weight, and the potential of R -------------------------


@_spring
def restoring_force(self, x):
    """Return R(x)."""


@_spring
def restoring_slope(self, x):
    """Return R'(x)."""


@_spring
def restoring_curvature(self, x):
    """Return R''(x)."""


@_spring
def potential(self, x):
    """Return the integral of R from 0 to x."""


@_default
@_spring
def normal_force(self, weight, x):
    """Return N(x)."""
    return weight


@_default
@_spring
def normal_slope(self, x):
    """Return N'(x)."""
    return 0.0


@_default
@_spring
def normal_curvature(self, x):
    """Return N''(x)."""
    return 0.0


@_default
@_spring
def normal_weight_slope(self, x):
    """Return the derivative of N(x) by the weight."""
    return 1.0


@_default
@_spring
def restoring_gradient(self, x):
    """Return the derivatives of R(x) by the law's numbers, a tuple in their order."""
    return zeros_of(self)


@_default
@_spring
def normal_gradient(self, weight, x):
    """Return the derivatives of N(x) by the law's numbers, a tuple in their order."""
    return zeros_of(self)


@_default
@_spring
def length_scale(self):
    """Return the distance over which R bends."""
    return 1.0


@_default
@_spring
def may_be_stiff(self):
    """Whether forces may grow so large that rounding hides the error estimate."""
    return True


@_default
@_spring
def switches(self):
    """Whether x = 0 switches the field."""
    return False


@_default
@_spring
def side(self):
    """Return the side of x = 0 to which the field is frozen: -1, 1, or 0 (none)."""
    return 0.0


@_default
@_spring
def select_field(self, x, v):
    """Return the spring with its field frozen to the side on which a mass is, or, from 0, to which it moves."""
    return self


@_default
@_spring
def on_side(self, side):
    """Return the spring with its field frozen to a side."""
    return self


# Excitation, of :mod:`sd_friction_env.kernel.excitation`. With a ripple on the belt's speed, slip and stick are
# computed in the frame that moves with it, where the belt's motion is the plain one: the belt's frame.


@_excitation
def acts(self):
    """Whether this is an excitation."""


@_excitation
def modulates_spring(self):
    """Whether the spring's force is modulated."""


@_excitation
def has_power(self):
    """Whether a force or a modulated spring is there to do work; the ripple's is the contact's."""


@_excitation
def at_time(self, t):
    """Advance the clock by t."""


@_excitation
def with_clock_at_zero(self):
    """Move the time into the phases: small phases are rounded less while a motion is followed."""


@_excitation
def lab_position(self, x):
    """Return where a mass at x in the belt's frame is."""


@_excitation
def lab_velocity(self, v):
    """Return the velocity of a mass of velocity v in the belt's frame."""


@_excitation
def lab_acceleration(self, a):
    """Return the acceleration of a mass of acceleration a in the belt's frame."""


@_excitation
def to_belt_frame(self, x, v, v_belt):
    """Return x and v in the belt's frame; v is the belt's speed exactly where it cannot be told from it."""


@_excitation
def belt_frame_velocity(self, v):
    """Return v in the belt's frame."""


@_excitation
def belt_frame_origin(self):
    """Return x = 0 in the belt's frame."""


@_excitation
def v_rel_zero(self, v_belt):
    """Return which relative velocities cannot be told from zero where a state is left and taken up again."""


@_excitation
def drive_force(self, u):
    """Return the sum of a control force, the exciting force and the frame's inertial force."""


@_excitation
def modulated(self, force):
    """Return a spring's force, modulated."""


@_excitation
def modulated_normal(self, weight, normal):
    """Return the normal force, the spring's part of it modulated."""


@_excitation
def drive_force_rate(self):
    """Return the rate of change of the exciting and the inertial force."""


@_excitation
def stiffness_rate(self):
    """Return the rate of change of the factor of the spring's force."""


@_excitation
def lab_gap(self, side, gap, slope, curvature):
    """Turn a gap between v in the belt's frame and zero into one between the lab's v and zero."""


@_excitation
def shortened(self, angle, duration):
    """Return a duration, or less: that in which the fastest excitation goes through this angle."""


@_excitation
def ripple_speed(self):
    """Return the greatest speed of the ripple."""


@_excitation
def roundoff(self):
    """Return a measure of what rounding the phases changes in the forces."""


@_excitation
def power(self, velocity, potential):
    """Return the power of the excitation."""


@_excitation
def gradient(self, force, position, velocity, inertia, spring):
    """Return the derivatives by the excitation's numbers of a sum: ``force`` times the exciting force, ``position``,
    ``velocity`` and ``inertia`` times the ripple's displacement, speed and acceleration, ``spring`` times the factor of
    the spring's force."""


@_excitation
def phases(self):
    """Return the cosines and sines of the phases of force, ripple and stiffness, in pairs."""
