"""Controllers on plants that they were not made for, unchanged: other geometry, speeds, and laws of friction."""

from collections.abc import Mapping, Sequence
from typing import Any

from sd_friction_env import Table
from sd_friction_env.control.policies import Policy, ZeroPolicy
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.protocol import Checked

# Changes of the nominal plant, one each, with which it still squeals with stick (verified by the tests). Coulomb's law
# does so only with a larger drop of friction: v_b0 is 0.217 with these numbers, 0.099 with those of the package.
PLANTS: dict[str, dict[str, Any]] = {
    "alpha 0.6": {"alpha": 0.6},
    "alpha 0.7": {"alpha": 0.7},
    "alpha 0.9": {"alpha": 0.9},
    "alpha 0.95": {"alpha": 0.95},
    "belt speed -20%": {"belt_speed": 0.16},
    "belt speed -10%": {"belt_speed": 0.18},
    "belt speed +10%": {"belt_speed": 0.22},
    "belt speed +20%": {"belt_speed": 0.24},
    "mu_m 0.03": {"mu_m": 0.03},
    "mu_m 0.1": {"mu_m": 0.1},
    "mu_s 0.25": {"mu_s": 0.25},
    "exponential friction": {"friction": "exponential"},
    "hyperbolic friction": {"friction": "hyperbolic"},
    "Coulomb friction, 0.3 and 0.05": {"friction": "coulomb", "mu_s": 0.3, "mu_k": 0.05},
    "cubic spring": {"geometry": "cubic"},
}


def evaluate_off_nominal(
    policies: Mapping[str, Policy],
    env_id: str,
    seeds: Sequence[int] = evaluation.EVALUATION_SEEDS[:50],
    plants: Mapping[str, Mapping[str, Any]] = PLANTS,
) -> Table:
    """Return the suppressed share and the mean return of each policy on each plant, from the same starts.

    Scales of observations stay those of the nominal plant, so that they do not show the change.

    Args:
        policies: by name. env_id: of an environment. seeds: of the episodes on each plant. plants: the parameters that
            each changes, by name.

    Returns:
        A table with the columns plant, controller, suppressed and return.
    """
    rows = []
    for plant, change in plants.items():
        options = {"parameters": dict(change)}
        passive = evaluation.run_episodes(ZeroPolicy(), env_id, seeds, options=options)
        for name, policy in policies.items():
            checked = Checked(policy, name, env_id)
            table = evaluation.metrics(evaluation.run_episodes(checked, env_id, seeds, options=options), passive)
            rows.append((plant, name, float(table["suppressed"].mean()), float(table["return"].mean())))
    columns = zip(("plant", "controller", "suppressed", "return"), zip(*rows, strict=True), strict=True)
    return Table(dict(columns), {"env_id": env_id, "episodes": len(seeds)})


def as_markdown(table: Table) -> str:
    """Return a table of :func:`evaluate_off_nominal` as Markdown: a line for each plant, share and return for each
    controller, and on how many plants each suppresses all episodes.
    """
    names = list(dict.fromkeys(table["controller"].tolist()))
    lines = [f"| plant | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    found = {(row["plant"], row["controller"]): row for row in table.rows()}
    plants = dict.fromkeys(table["plant"].tolist())
    for plant in plants:
        rows = [found[plant, name] for name in names]
        cells = [f"{row['suppressed']:.0%}, {row['return']:.1f}" for row in rows]
        lines.append(f"| {' | '.join([plant, *cells])} |")
    whole = [sum(found[plant, name]["suppressed"] == 1.0 for plant in plants) for name in names]
    cells = [f"{count} of {len(plants)}" for count in whole]
    lines.append(f"| {' | '.join(['all suppressed', *cells])} |")
    return "\n".join(lines)
