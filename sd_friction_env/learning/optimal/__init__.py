"""Optimal control: the returns that define a score of 1, computed on the environment's own step.

An optimum is found in three stages, over the whole episode and without discount:

1. dynamic programming on a grid (:func:`value_iteration`): the best action in every state, up to interpolation;
2. greedy rollouts on the true dynamics (:func:`greedy_actions`), one per grid: a feasible action sequence per start;
3. local refinement of the best sequence per start (:func:`refine`: differential dynamic programming on derivatives of
   the event-exact step), restarted from sequences of neighbouring starts until nothing improves.

Every number of the reference is the return of an action sequence that the environment executes, hence a lower bound on
the true optimum. The sequences are stored with the returns, so that anyone can replay them.

On the randomised tier every episode has its own plant, and the optimum knows it: an upper bound for controllers that do
not. The sensed tier has the plant, starts and reward of the nominal one, hence its optimum, which sees the state: again
an upper bound. So have the open tiers "blind" and "blind-late" those of the randomised one. Where a plant
changes during an episode, stage 1 is that of the plant at the start, and the later stages know the changes to come.
"""

from sd_friction_env.learning.optimal.grid import ValueFunction, grid_actions, make_grid, value_iteration
from sd_friction_env.learning.optimal.policy import OptimalPolicy, save_value
from sd_friction_env.learning.optimal.problem import OPEN, RANDOMISED, SENSED, TASKS, Problem, make_problem
from sd_friction_env.learning.optimal.refinement import refine, settle
from sd_friction_env.learning.optimal.search import greedy_actions
from sd_friction_env.learning.optimal.stored import (
    ACTION_LEVELS,
    OPTIMUM_DIRECTORY,
    DamagedStudyError,
    fingerprint,
    optimal_actions,
    save_optimum,
    stored_returns,
    stored_study,
)
from sd_friction_env.learning.optimal.study import find_optimum
from sd_friction_env.learning.versions import versions
