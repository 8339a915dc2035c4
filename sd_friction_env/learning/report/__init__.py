"""The report: every controller on every task and tier, other plants, learning curves and histories.

Everything is computed into tables first (:class:`Report`), then drawn, then written: CSV, PNG, and one HTML page with
its pictures in it. Needs matplotlib and Jinja2 (extra "report").
"""

from sd_friction_env.environments.ids import TASKS, TIERS
from sd_friction_env.learning.report.agents import ENV_IDS, Agent, Key, Row, find_agents
from sd_friction_env.learning.report.comparison import (
    FULL,
    QUICK,
    Comparison,
    Effort,
    Replay,
    compare,
    over_runs,
    over_tasks,
)
from sd_friction_env.learning.report.curves import (
    SWEEPS,
    history,
    learning_curves,
    sweep_plants,
    swept_parameters,
    training_times,
)
from sd_friction_env.learning.report.document import Report
