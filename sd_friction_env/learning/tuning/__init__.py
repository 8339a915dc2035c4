"""A search for hyperparameters with Optuna: a study in a database, any number of workers, continued at any time.

A trial trains one model near the hyperparameters of a file. Its value is the best credited return that it reached on
the validation seeds (never the evaluation seeds), by which training chooses its best model (:func:`training.validate`).
Trial 0 is the file itself if the search space holds it. A trial whose process died or was interrupted is run again with
the same hyperparameters and seed.
"""

from sd_friction_env.learning.tuning.results import check_out, format_trials, write_best
from sd_friction_env.learning.tuning.space import SPACES, Dimension, search_space
from sd_friction_env.learning.tuning.study import (
    PRUNERS,
    Search,
    StudyError,
    best_trials,
    finished_trials,
    make_search,
    open_study,
)
from sd_friction_env.learning.tuning.trial import run_plan
from sd_friction_env.learning.tuning.workers import InterruptedStudyError, WorkersDiedError, tune, work
