"""All randomness is a function of `(seed, stream, counter)`, so no generator state needs to be saved.

A new consumer gets a new stream, which changes no other one. A resumed run continues with its saved counters.
"""

from __future__ import annotations

import enum
from typing import Any

import numpy as np


class Stream(enum.IntEnum):
    """The consumers of random numbers. Results depend on these integers: add new ones at the end, and never renumber."""

    INIT_AGENT = 0
    INIT_REWARD = 1
    EPISODE = 2
    """Resets of the training environment; the counter is the episode."""
    ACT = 3
    """Exploration; the counter is the episode."""
    SAMPLE = 4
    """Samples from the replay and from the demonstrations; the counter is the episode."""
    UPDATE = 5
    """Inside the compiled step; the counter is the update."""
    LABEL = 6
    """Labelling a finished episode; the counter is the episode."""
    EVALUATE = 7
    """Resets of the evaluation environments; the counter is the index of the evaluation episode."""
    RECORD = 8
    """Resets while demonstrations are recorded; the counter is the attempt."""
    CLONE = 9
    """Samples for behavioural cloning before the first update; the counter is 0."""
    NOISE = 10
    """Noise of an evaluation; the counter is the index of the evaluation episode."""
    SELECT = 11
    """Resets of the episodes by which a policy is kept; the counter is the index of the episode."""


def key(root: Any, stream: Stream, counter: Any) -> Any:
    """A JAX key, derived from the run's root key; `counter` may be traced."""
    import jax  # imported here: reading demonstrations and drawing figures need no JAX

    return jax.random.fold_in(jax.random.fold_in(root, int(stream)), counter)


def rng(seed: int, stream: Stream, counter: int) -> np.random.Generator:
    """A NumPy generator."""
    return np.random.default_rng(np.random.SeedSequence((seed, int(stream), counter)))


def episode_seed(seed: int, stream: Stream, counter: int) -> int:
    """A 31-bit seed for `env.reset`, so that an episode depends on this seed and the actions alone."""
    return int(np.random.SeedSequence((seed, int(stream), counter)).generate_state(1)[0] >> 1)
