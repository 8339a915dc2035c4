"""Results of a study: the best trials as a table, and the best hyperparameters as a file for training."""

from pathlib import Path

import optuna
import yaml
from optuna.trial import TrialState

from sd_friction_env.learning.evaluation import aligned
from sd_friction_env.learning.settings import zoo_settings
from sd_friction_env.learning.tuning.study import best_trials, check_trials, finished_trials, stored_configuration
from sd_friction_env.storage import StoredFileError, atomic_file, read_text

OUT_HEADER = "# The best hyperparameters of a study by sd-friction tune, in RL Zoo's format."


def format_trials(study: optuna.Study, most: int = 10) -> str:
    """Return the best trials as an aligned text table, one parameter a column, and a line that counts all trials."""
    finished, best = finished_trials(study), best_trials(study)
    names = list(dict.fromkeys(name for trial in best for name in trial.params))
    cells = [["trial", "credited", "return", "suppressed", "steps", "seconds", *names]]
    for trial in best[:most]:
        about = trial.user_attrs["best"]
        row = [f"{trial.number}", f"{trial.value:.2f}", f"{about['mean_return']:.2f}", f"{about['suppressed']:.0%}"]
        row += [f"{about['steps']:,}", f"{trial.duration.total_seconds() if trial.duration else 0.0:.0f}"]
        values = (trial.params.get(name, "-") for name in names)
        cells.append([*row, *(f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)])
    count = {state: sum(trial.state == state for trial in finished) for state in TrialState}
    return (
        f"{aligned(cells)}\n{len(finished)} trials: {count[TrialState.COMPLETE]} complete, "
        f"{count[TrialState.PRUNED]} pruned, {count[TrialState.FAIL]} failed"
    )


def check_out(path: Path) -> None:
    """Raise unless :func:`write_best` may write a file: an existing one must have been written by it.

    Raises:
        ValueError: if it may not.
    """
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"out must be a file in a folder that exists, got {str(path)!r}")
    try:
        is_ours = not path.exists() or read_text(path).startswith(OUT_HEADER)
    except StoredFileError:
        is_ours = False
    if not is_ours:
        raise ValueError(f"out {str(path)!r} exists and was not written by this program: choose another name")


def write_best(study: optuna.Study, path: Path) -> None:
    """Write the best trial's hyperparameters for ``sd-friction train --hyperparameters``, whole or not at all.

    Raises:
        ValueError: if no trial is complete, or as :func:`check_out`. OSError: if it cannot be written.
    """
    check_out(path)
    check_trials(study)
    best = best_trials(study)
    if not best:
        raise ValueError(f"study {study.study_name!r} has no complete trial")
    about = stored_configuration(study)
    content = {about["env_id"]: zoo_settings(best[0].user_attrs["hyperparameters"])}
    value, suppressed = best[0].value, best[0].user_attrs["best"]["suppressed"]
    lines = [
        OUT_HEADER,
        f"# Study {study.study_name!r}, {about['algo']}: trial {best[0].number} of {len(finished_trials(study))},",
        f"# credited return {value:.2f}, suppressed {suppressed:.0%} of {about['eval_episodes']} validation episodes.",
        yaml.safe_dump(content, sort_keys=False, width=110),
    ]
    with atomic_file(path) as file:
        file.write("\n".join(lines))
