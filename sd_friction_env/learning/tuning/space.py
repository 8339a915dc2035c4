"""The search space: hyperparameters as parameters of a study, around the files in agents/hyperparameters."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from optuna.trial import BaseTrial

from sd_friction_env.learning.models import make_callbacks
from sd_friction_env.learning.settings import CALLBACK, WRAPPER, reward_scaling


def _significant(value: float, digits: int = 4) -> float:
    """Return a value rounded as a file shows it, so that the file holds exactly what was tried."""
    return float(f"{value:.{digits}g}")


# From a parameter of the study to the hyperparameter, and back.
_FORMS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "same": (lambda value: value, lambda setting: setting),
    "number": (_significant, float),
    "falling": (lambda value: f"lin_{value:.4g}", lambda setting: float(setting.removeprefix("lin_"))),
    "horizon": (lambda value: round(1.0 - 1.0 / value, 6), lambda setting: _significant(1.0 / (1.0 - setting))),
    "power of two": (lambda value: 2**value, lambda setting: round(math.log2(setting))),
    "layers": (lambda value: [int(width) for width in value.split("-")], lambda setting: "-".join(map(str, setting))),
}


@dataclass(frozen=True)
class Dimension:
    """One hyperparameter that is searched.

    Attributes:
        name: of the parameter in the study.
        setting: of the hyperparameter; "policy_kwargs.NAME" for one of the policy, "reward.scale", "reward.power",
            "callback.start" and "callback.end" for arguments of the reward's wrapper and of the annealed exploration.
        form: conversion between the two, a key of ``_FORMS``.
        low, high: ends of its range, both included; the search is over whole numbers if both are whole numbers.
        log: whether the search is on a logarithmic scale. choices: instead of a range.
    """

    name: str
    setting: str
    form: str = "number"
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[str, ...] = ()

    def suggest(self, trial: BaseTrial) -> Any:
        """Return the parameter's value in a trial."""
        if self.choices:
            return trial.suggest_categorical(self.name, self.choices)
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(self.name, self.low, self.high, log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)

    def put(self, settings: dict[str, Any], value: Any) -> None:
        """Set the hyperparameter in ``settings`` from a value of the parameter."""
        part, _, name = self.setting.rpartition(".")
        setting = _FORMS[self.form][0](value)
        if part == "reward":
            settings["env_wrapper"] = [{WRAPPER: _nested(settings, part) | {name: setting}}]
        elif part == "callback":
            settings["callback"] = [{CALLBACK: _nested(settings, part) | {name: setting}}]
        else:
            (settings.setdefault(part, {}) if part else settings)[name] = setting

    def value(self, settings: Mapping[str, Any]) -> Any:
        """Return the parameter's value for the hyperparameter in ``settings``; None if the space does not hold it."""
        part, _, name = self.setting.rpartition(".")
        setting = _nested(settings, part).get(name)
        forward, back = _FORMS[self.form]
        try:
            value = back(setting)
            # "lin_2e-3" may be written in other ways too; everything else must be the very same.
            is_kept = back(forward(value)) == value if self.form == "falling" else forward(value) == setting
            is_held = value in self.choices if self.choices else self.low <= value <= self.high
        except (AttributeError, TypeError, ValueError, ZeroDivisionError):  # missing, or another kind of value
            return None
        return value if is_kept and is_held else None


def _nested(settings: Mapping[str, Any], part: str) -> dict[str, Any]:
    """Return the part of ``settings`` that a dimension belongs to."""
    if part == "reward":
        return dict(zip(("scale", "power"), reward_scaling(settings), strict=True))
    if part == "callback":
        return {name: getattr(made, name) for made in make_callbacks(settings) for name in ("start", "end")}
    return dict(settings.get(part, {}) if part else settings)


_NETS = ("32-32", "64-64", "128-128", "256-256", "64-64-64")
_COMMON = (
    Dimension("net", "policy_kwargs.net_arch", "layers", choices=_NETS),
    Dimension("activation", "policy_kwargs.activation_fn", "same", choices=("Tanh", "ReLU")),
    Dimension("reward_power", "reward.power", low=0.3, high=1.0),
)
_OFF_POLICY = (
    Dimension("learning_rate", "learning_rate", "falling", low=1e-4, high=5e-3, log=True),
    Dimension("horizon", "gamma", "horizon", low=20.0, high=500.0, log=True),
    Dimension("tau", "tau", low=2e-3, high=5e-2, log=True),
    Dimension("log2_batch_size", "batch_size", "power of two", low=6, high=9),
    Dimension("log2_gradient_steps", "gradient_steps", "power of two", low=2, high=6),
    Dimension("reward_scale", "reward.scale", low=0.02, high=1.0, log=True),
    *_COMMON,
)
# PPO's rewards need no scale: its advantages are normalised.
SPACES: dict[str, tuple[Dimension, ...]] = {
    "ppo": (
        Dimension("learning_rate", "learning_rate", "falling", low=2e-4, high=1e-2, log=True),
        Dimension("horizon", "gamma", "horizon", low=20.0, high=500.0, log=True),
        Dimension("gae_lambda", "gae_lambda", low=0.8, high=0.99),
        Dimension("log2_n_steps", "n_steps", "power of two", low=5, high=9),
        Dimension("log2_batch_size", "batch_size", "power of two", low=8, high=12),
        Dimension("n_epochs", "n_epochs", "same", low=4, high=16),
        Dimension("log_std_init", "policy_kwargs.log_std_init", low=-1.5, high=0.5),
        *_COMMON,
    ),
    "sac": _OFF_POLICY,
    "td3": (*_OFF_POLICY, Dimension("noise_std", "noise_std", low=0.05, high=0.5)),
    "tqc": (*_OFF_POLICY, Dimension("quantiles_dropped", "top_quantiles_to_drop_per_net", "same", low=0, high=5)),
}
# Annealed exploration starts at log_std_start, which then takes the place of log_std_init.
_ANNEALING = (
    Dimension("log_std_start", "callback.start", low=-1.5, high=0.5),
    Dimension("log_std_end", "callback.end", low=-4.0, high=-1.5),
)
_FRAMES = Dimension("frame_stack", "frame_stack", "same", low=2, high=32)


def search_space(algorithm: str, settings: Mapping[str, Any], fixed: Sequence[str] = ()) -> tuple[Dimension, ...]:
    """Return the dimensions that are searched for an algorithm.

    Args:
        settings: hyperparameters around which the search is; if they stack frames or anneal exploration, the number of
            frames and the ends of the annealing are searched too.
        fixed: names of hyperparameters that are not searched.
    """
    space = SPACES[algorithm] + ((_FRAMES,) if settings.get("frame_stack", 1) > 1 else ())
    if "callback" in settings:
        space = tuple(dimension for dimension in space if dimension.name != "log_std_init") + _ANNEALING
    held = {"reward" if name == "env_wrapper" else name for name in fixed}
    return tuple(dimension for dimension in space if dimension.setting.partition(".")[0] not in held)
