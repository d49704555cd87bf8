"""All randomness is a function of `(seed, stream, counter)`, so no generator state is ever saved.

A new consumer takes a new stream and shifts no other; a resumed run continues with the counters it had reached.
"""

from __future__ import annotations

import enum
from typing import Any

import numpy as np


class Stream(enum.IntEnum):
    """Who draws. The numbers are part of every result: add new ones at the end, never renumber."""

    INIT_AGENT = 0
    INIT_REWARD = 1
    EPISODE = 2
    """Resets of the training environment; the counter is the episode."""
    ACT = 3
    """Exploration; the counter is the episode."""
    SAMPLE = 4
    """Draws from the replay and from the demonstrations; the counter is the episode."""
    UPDATE = 5
    """Inside the compiled step; the counter is the update."""
    LABEL = 6
    """Labelling a finished episode; the counter is the episode."""
    EVALUATE = 7
    """Resets of the evaluation environments; the counter is the index of the evaluation episode."""
    RECORD = 8
    """Resets while demonstrations are recorded; the counter is the attempt."""


def key(root: Any, stream: Stream, counter: Any) -> Any:
    """The JAX key of one draw, from the run's root key; `counter` may be traced."""
    import jax  # here: what reads demonstrations and draws figures needs no JAX

    return jax.random.fold_in(jax.random.fold_in(root, int(stream)), counter)


def rng(seed: int, stream: Stream, counter: int) -> np.random.Generator:
    """The NumPy generator of one episode's draws."""
    return np.random.default_rng(np.random.SeedSequence((seed, int(stream), counter)))


def episode_seed(seed: int, stream: Stream, counter: int) -> int:
    """A 31-bit seed for `env.reset`, so that an episode is a function of it and of the actions alone."""
    return int(np.random.SeedSequence((seed, int(stream), counter)).generate_state(1)[0] >> 1)
