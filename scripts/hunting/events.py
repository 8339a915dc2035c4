"""Event lists of ``simulate`` under different sampling, and its energy balance."""

import functools
import math
from collections.abc import Mapping
from typing import Any

from scripts.hunting import draws
from scripts.hunting.steps import grade
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, Trajectory, simulate
from sd_friction_env.physics.simulation import Event

END = 5.0
STEPS = (1.0, 0.1, 0.01)  # times between samples, held against one piece
SAME_TIME = 1e-9
MOVED = 1e-10  # what the start is moved by, to see how much event times depend on it
MARGIN = 10.0
ENERGY = 1e-7


def listed(history: Trajectory) -> str:
    """Return an event list in a few words."""
    shown = ", ".join(f"{event.kind} {event.time:.12g}" for event in history.events[:8])
    return f"{len(history.events)} ({history.status}): {shown}"


def first_difference(a: tuple[Event, ...], b: tuple[Event, ...]) -> int | None:
    """Return the place of the first event whose kind differs, or that one list lacks; None if there is none."""
    for i in range(max(len(a), len(b))):
        if i >= min(len(a), len(b)) or a[i].kind != b[i].kind:
            return i
    return None


class Reference:
    """A history in one piece, and how much its events depend on the start."""

    def __init__(self, parameters: OscillatorParameters, x: float, v: float, held: Mapping[str, float]) -> None:
        self.arguments: dict[str, Any] = {"t_end": END, **held}
        self.parameters, self.x, self.v = parameters, x, v
        self.history = self.run(dt=1e3)

    def run(self, moved: tuple[float, float] = (0.0, 0.0), damped: float = 0.0, **arguments: Any) -> Trajectory:
        """Return the history with other arguments, from a start that is moved, or with other damping."""
        x, v = (max(-10.0, min(10.0, value + by)) for value, by in zip((self.x, self.v), moved, strict=True))
        p = self.parameters.replace(beta=self.parameters.beta + damped)
        return simulate(p, x, v, **{**self.arguments, **arguments})

    @functools.cached_property
    def near(self) -> list[Trajectory]:
        """Histories from starts (one on the belt stays there) and under forces close by, and damped a little more:
        a stick forgets the start, and an undamped motion comes back to the belt's speed whatever the force."""
        scale = MOVED * max(1.0, abs(self.x), abs(self.v))
        ways = [(scale, 0.0), (-scale, 0.0)]
        ways += [] if self.v == self.parameters.first_belt_speed else [(0.0, scale), (0.0, -scale)]
        near = [self.run(moved, dt=1e3) for moved in ways]
        near += [self.run(dt=1e3, force=self.arguments["force"] + by) for by in (scale, -scale)]
        return [*near, self.run(dt=1e3, damped=MOVED if self.parameters.beta < 1.0 else -MOVED)]

    def decided(self, place: int) -> bool:
        """Whether histories from close by have the same events up to this place."""
        differences = [first_difference(self.history.events, near.events) for near in self.near]
        return all(difference is None or difference > place for difference in differences)

    def check(self, other: Trajectory, how: str) -> float:
        """Check another history's events against this one's: the same kinds, and times as equal as the start's errors
        let them be. Return the largest gap of the times."""
        mine, its = self.history.events, other.events
        place = first_difference(mine, its)
        if place is not None and self.decided(place):
            kind = f"events: {how.split()[0]}"
            raise Failure(kind, f"one piece has {listed(self.history)}; {how} has {listed(other)}")
        worst = 0.0
        for i in range(len(mine) if place is None else place):
            gap = abs(mine[i].time - its[i].time)
            if gap <= SAME_TIME:
                worst = max(worst, gap)
            elif self.decided(i):
                times = [near.events[i].time for near in self.near]
                bound = SAME_TIME + MARGIN * max(abs(time - mine[i].time) for time in times)
                if gap > bound:
                    words = f"{mine[i].kind} {i} is at {mine[i].time!r} in one piece, at {its[i].time!r} with {how}"
                    raise Failure("event times", f"{words}: {gap:.3g} apart, {bound:.3g} is allowed")
        if place is not None:
            raise SetAside("a graze or a breakaway that the last bits of the start decide")
        return worst


def drawn(seed: int, index: int) -> Reference:
    """Return the history of a trial."""
    rng = draws.generator(seed, index)
    p = draws.plant(rng)
    at = draws.start(rng, p, 0.1)
    v = p.first_belt_speed if rng.random() < 0.25 else at.v
    v = min(10.0, max(-10.0, v))
    held = {"force": at.u if rng.random() < 0.5 else 0.0}
    # Slow belts too: those along which a stuck mass rides for long.
    held["belt_acceleration"] = draws.signed(rng, 1.0) if rng.random() < 0.5 else 0.0
    x = at.x
    if rng.random() < 0.3:
        x, held["force"] = float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.1, 0.1))
    return Reference(p, x, v, held)


def described(seed: int, index: int) -> str:
    """Return the call that gives the history in one piece."""
    reference = drawn(seed, index)
    words = draws.keywords({"x": reference.x, "v": reference.v, **reference.arguments, "dt": 1e3})
    return f"simulate({draws.described(reference.parameters)}, {words})"


def trial(seed: int, index: int) -> Mapping[str, float]:
    """Check the events of one history under samplings that are even, and that end where an event lies."""
    reference = drawn(seed, index)
    history = reference.history
    if history.status in ("step limit", "event limit"):
        raise SetAside(history.status)
    others: dict[str, dict[str, Any]] = {f"dt = {dt}": {"dt": dt} for dt in STEPS}
    held = {name: reference.arguments[name] for name in ("force", "belt_acceleration")}
    for event in history.events[:6]:
        for ulps in (-4, -2, -1, 0, 1, 2, 3):
            time = event.time + ulps * math.ulp(event.time)
            if 1e-3 < time < END:
                twice = {name: [value] * (math.ceil(END / time) + 1) for name, value in held.items()}
                others[f"dt = {time!r}"] = {"dt": time}
                others[f"hold = {time!r}"] = {"dt": 1e3, "hold": time, **twice}
    gap = max(reference.check(reference.run(**arguments), how) for how, arguments in others.items())
    balance = history.energy
    # Where forces in balance do little work the sum of the works is small: energies count as well.
    works = (balance.damping, balance.contact, balance.control, balance.excitation, balance.change)
    residual = abs(balance.residual) / (sum(map(abs, works)) + 0.5 * reference.v**2 + 1e-3)
    if not residual <= ENERGY:
        words = f"the energy balance of simulate misses by {residual:.3g} of the works: {balance}"
        raise Failure(grade("energy", residual), words)
    return {"largest gap of event times": gap, "largest residual of simulate's energy balance": residual}


CHECK = Check(
    "events",
    "event lists of simulate: the same whatever the sampling and the holding",
    trial,
    drawn=described,
    patience=60.0,
    share=2.0,
)
