"""Random numbers by counting: each depends on nothing but a key, an episode, a step and a slot.

32-bit arithmetic in 64-bit signed integers: the low 32 bits of a product are the same whether it wraps (compiled) or
not (interpreted). The finaliser is that of MurmurHash3.
"""

import math

import numpy as np

from sd_friction_env.kernel.compilation import compiled, entry

_LOW_32 = 0xFFFFFFFF


@compiled
def _mix(h, word):
    h = ((h ^ (word & _LOW_32)) * 0x9E3779B1 + 0x7F4A7C15) & _LOW_32
    h ^= h >> 16
    h = (h * 0x85EBCA6B) & _LOW_32
    h ^= h >> 13
    h = (h * 0xC2B2AE35) & _LOW_32
    return h ^ (h >> 16)


@entry
def random_uniform(key, episode, step, slot):
    """Return a number in [0, 1) that depends on nothing but a key (below 2^62), an episode, a step and a slot."""
    base = _mix(_mix(_mix(_mix(_mix(0x2545F491, key), key >> 32), episode), step), slot)
    high = _mix(base, 1)
    low = _mix(base ^ 0x5BD1E995, high)
    return ((high >> 5) * 67108864 + (low >> 6)) * (1.0 / 9007199254740992.0)


@entry
def random_uniforms(keys, episodes, step, slot):
    """Return :func:`random_uniform` for arrays of keys and episodes, both (n,)."""
    numbers = np.empty(len(keys))
    for i in range(len(keys)):
        numbers[i] = random_uniform(int(keys[i]), int(episodes[i]), step, slot)
    return numbers


@entry
def random_normal(key, episode, step, slot):
    """Return a standard normal number by Box and Muller's formula, from slots 2 slot and 2 slot + 1."""
    radius = math.sqrt(-2.0 * math.log(1.0 - random_uniform(key, episode, step, 2 * slot)))
    return radius * math.cos(2.0 * math.pi * random_uniform(key, episode, step, 2 * slot + 1))
