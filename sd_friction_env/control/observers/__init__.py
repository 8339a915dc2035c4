"""Observers: the state and the hidden parameters, estimated from readings and the actions taken.

An observer knows the nominal plant, the task (ranges of the hidden parameters, how episodes start, the sensor's noise
and delay) and the actions. Of an episode it gets the readings alone. All share two methods::

    belief, memory = observer.correct(observation, memory, episode_start)
    memory = observer.advance(memory, action)

``memory`` is None before the first call. Observations come as the environment returns them, one or a batch; each of a
batch is observed as it would be alone.
"""

from sd_friction_env.control.observers.gains import AlphaBetaFilter, LuenbergerObserver
from sd_friction_env.control.observers.kalman import KalmanFilter
from sd_friction_env.control.observers.observer import Belief, Observer
from sd_friction_env.control.observers.particles import EnsembleKalmanFilter, ParticleFilter

__all__ = [
    "AlphaBetaFilter",
    "Belief",
    "EnsembleKalmanFilter",
    "KalmanFilter",
    "LuenbergerObserver",
    "Observer",
    "ParticleFilter",
]
