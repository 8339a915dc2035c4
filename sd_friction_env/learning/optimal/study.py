"""The search for an optimum: all grids, beam searches and refinements."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sd_friction_env.learning.optimal.grid import grid_actions, make_grid, value_iteration
from sd_friction_env.learning.optimal.problem import Array, Problem, Progress, silent
from sd_friction_env.learning.optimal.refinement import best_of, improve, refine, settle
from sd_friction_env.learning.optimal.search import beam_actions, greedy_actions


@dataclass(frozen=True)
class Study:
    """An optimum and the stages of its search.

    Attributes:
        actions: the best sequences, shape (n, steps).
        stages: mean return by stage, in order.
        estimates: the value functions' own mean estimates by grid.
    """

    actions: Array
    stages: dict[str, float]
    estimates: dict[str, float]


def find_optimum(
    problem: Problem,
    grids: Sequence[Sequence[int]],
    *,
    beam: int,
    rounds: int,
    known: Array | None = None,
    progress: Progress = silent,
    report: Callable[[str, float], None] = lambda stage, value: None,
) -> Study:
    """Return the best sequences that several grids, beam searches and refinement find.

    Args:
        grids: sizes along x, v_rel and, on belt, v_belt. beam: width of the beam searches. rounds: of exchange.
        known: sequences to start from as well. report: called with each stage's name and mean return.
    """
    stages: dict[str, float] = {}
    estimates: dict[str, float] = {}
    candidates = [np.zeros((len(problem.starts), problem.steps))]

    def note(stage: str, actions: Array) -> None:
        candidates.append(actions)
        stages[stage] = float(problem.returns(actions).mean())
        report(stage, stages[stage])

    note("passive", candidates.pop())
    if known is not None:
        note("stored before", known)
    for sizes in grids:
        name = "x".join(map(str, sizes))
        estimate = np.empty(len(problem.starts))
        greedy, searched = np.empty_like(candidates[0]), np.empty_like(candidates[0])
        plants = list(problem.plants.values())
        for i in progress(range(len(plants)), f"plants on {name}") if len(plants) > 1 else (0,):
            rows = plants[i]
            part = problem.select(rows)
            grid = make_grid(part.frozen, sizes)
            value = value_iteration(part.frozen, grid, grid_actions(part.frozen, grid), progress)
            estimate[rows] = grid.interpolate(value.whole, part.starts)
            greedy[rows] = greedy_actions(part, value, progress)
            if beam:
                searched[rows] = beam_actions(part, value, beam, min(200, problem.steps), progress)
        estimates[name] = float(estimate.mean())
        report(f"value function's estimate {name}", estimates[name])
        note(f"greedy {name}", greedy)
        if beam:
            note(f"beam {beam} {name}", searched)
            note(f"beam {beam} {name}, refined", refine(problem, searched, 30, progress))
    note("best of these per start", best_of(problem, candidates))
    note("ended in velocity feedback where that is better", settle(problem, candidates[-1]))
    note(f"refined, {rounds} rounds of exchange", improve(problem, candidates[-1], rounds, progress=progress))
    return Study(candidates[-1], stages, estimates)
