"""The policy that is kept: of the policy of now and the one kept before, the one that the present reward pays more.

TD7 (Fujimoto et al. 2023) keeps a policy for its true returns. Imitation has none, so the episodes of both policies are
labelled by the reward as it is now. They begin from starts of their own, so an evaluation stays a test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from pcil import envs
from pcil.agents import Actor
from pcil.seeds import Stream
from pcil.training import checkpoint, learner
from pcil.training.config import Algorithm
from pcil.training.evaluate import evaluate
from pcil.training.learner import Learner, on_host
from pcil.types import Episode

PARTS = ("obs", "action", "reward", "terminated")
"""What a checkpoint holds of an episode."""


@dataclass(frozen=True)
class Kept:
    """A policy and what it played when it was new."""

    actor: Actor
    """Its arrays are on the host."""
    episodes: tuple[Episode, ...]
    """As the reward is given them: with absorbing states, where the run has them."""


def played(actor: Actor, environments: Sequence[envs.Checked], *, seed: int, episodes: int) -> tuple[Episode, ...]:
    """Episodes of the actor's mean actions, the same starts for every actor."""
    result = evaluate(lambda obs: actor(obs, np), environments, seed=seed, episodes=episodes, stream=Stream.SELECT, keep=True)
    return result.episodes


def worth(algorithm: Algorithm, trained: Learner, kept: Kept, count: int) -> float:
    """The mean over its episodes of the sum of the present reward; `count` is that of the label's random draw."""
    return float(np.mean([learner.label_episode(algorithm, trained, episode, count).sum() for episode in kept.episodes]))


def better(algorithm: Algorithm, trained: Learner, now: Kept, before: Kept | None, count: int) -> Kept:
    """The policy that the present reward pays more; the newer one if it pays both the same."""
    if before is None or worth(algorithm, trained, now, count) >= worth(algorithm, trained, before, count):
        return now
    return before


def flatten(name: str, kept: Kept | None) -> checkpoint.Arrays:
    """The arrays of a checkpoint, each name beginning with `name`; none where nothing is kept."""
    if kept is None:
        return {}
    arrays = checkpoint.flatten(f"{name}.actor", jax.tree.map(jax.numpy.asarray, kept.actor))
    for i, episode in enumerate(kept.episodes):
        arrays |= {f"{name}.{i}.{part}": np.asarray(getattr(episode, part)) for part in PARTS}
    return arrays


def unflatten(name: str, like: Actor, arrays: checkpoint.Arrays) -> Kept | None:
    """What `flatten` gave under `name`, with an actor like this one; None where there is nothing."""
    episodes = []
    while (first := f"{name}.{len(episodes)}") + ".obs" in arrays:
        obs, action, reward, terminated = (arrays[f"{first}.{part}"] for part in PARTS)
        episodes.append(Episode(obs, action, reward, bool(terminated)))
    return Kept(on_host(checkpoint.unflatten(f"{name}.actor", like, arrays)), tuple(episodes)) if episodes else None
