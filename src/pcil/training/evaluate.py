"""Deterministic rollouts: all episodes in lockstep, one batched call of the policy for each step."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from pcil import envs, modules
from pcil.envs.checked import real_numbers
from pcil.envs.rollout import Rollout
from pcil.errors import InputError
from pcil.policy import Policy, load_policy
from pcil.seeds import Stream, episode_seed, rng
from pcil.types import Episode

LOCKSTEP = 32
"""Maximum number of episodes that are played at once."""


@dataclass(frozen=True)
class Evaluation:
    """The results of an evaluation: rollouts of the mean action."""

    returns: np.ndarray
    """Undiscounted return of each episode, float64."""
    lengths: np.ndarray
    """Number of agent steps of each episode."""
    seconds: float
    """Wall-clock time of the evaluation."""
    info: dict[str, np.ndarray] = field(default_factory=dict)
    """The numbers in the environment's last `info` of each episode, by name; only those that every episode reports."""
    episodes: tuple[Episode, ...] = ()
    """The steps of each episode, where they were asked for."""

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def success(self) -> list[float] | None:
        """1 where an episode ended in success, 0 elsewhere, where the environment reports `is_success`; else None."""
        return self.info["is_success"].tolist() if "is_success" in self.info else None


def playable(
    folder: Path, env_kwargs: dict[str, Any] | None, trust: Sequence[str], task: str | None = None
) -> tuple[Policy, dict[str, Any]]:
    """The policy of a folder and the keyword arguments of the environment to play in: `task` with `env_kwargs`, by default that
    of the training.

    `InputError` where the policy's files name a module that is not among those to `trust`.
    """
    policy = load_policy(folder, trust)
    if task is None:
        modules.admit(f"The policy in {folder}", modules.of_task(policy.task, env_kwargs is None and policy.env_kwargs), trust)
    else:
        modules.admit("--env", modules.of_task(task), None)
    modules.admit("--env-kwargs", modules.of_task("", env_kwargs), None)
    known = policy.env_kwargs if task is None else {}
    return policy, known if env_kwargs is None else env_kwargs


@contextlib.contextmanager
def environments_for(
    task: Any,
    episodes: int,
    env_kwargs: dict[str, Any] | None = None,
    *,
    training: int = 0,
    single: bool = False,
) -> Iterator[tuple[list[envs.Checked], list[envs.Checked]]]:
    """So many environments for `training`, and those that `evaluate` plays so many episodes in, closed at the end: one each,
    but at most `LOCKSTEP`, for each takes memory. Where it must be `single`, there is one for everything.
    """
    with contextlib.ExitStack() as stack:
        number = 1 if single else min(episodes, LOCKSTEP) + training
        made = [stack.enter_context(envs.opened(task, env_kwargs=env_kwargs)) for _ in range(number)]
        if len({id(env.unwrapped) for env in made}) < number:
            raise InputError(
                f"The {envs.task_name(task)} returned the same environment twice; let it make a new one each time, or set "
                "single_environment."
            )
        yield (made, made) if single else (made[:training], made[training:])


def evaluate(
    act: Callable[[np.ndarray], np.ndarray],
    environments: Sequence[gymnasium.Env],
    *,
    seed: int,
    episodes: int | None = None,
    noise: float = 0.0,
    stream: Stream = Stream.EVALUATE,
    keep: bool = False,
) -> Evaluation:
    """So many episodes, by default one in each of `environments`, as many at once as there are of these.

    `act` maps observations `[k, obs]` of a block of episodes to `[k, action]`; rows of episodes that are over, or are not being
    played yet, mean nothing. A matrix product of other shape may differ in the last bit, so the block is the same whether its
    episodes are played all at once or one by one.

    Episode `i` starts from a seed that depends on `seed` and `i` alone, so every evaluation of a run meets the same starts.
    So does the `noise` of its actions: Gaussian with this standard deviation, after which they are clipped to [-1, 1]. Another
    `stream` gives other starts, and `keep` keeps the steps.
    """
    begin = time.perf_counter()
    checked = [envs.checked(env) for env in environments]
    episodes = len(checked) if episodes is None else episodes
    returns, lengths, infos, kept = np.zeros(episodes), np.zeros(episodes, np.int64), [], []
    size = max(LOCKSTEP, len(checked))
    for first in range(0, episodes, size):
        block = range(first, min(first + size, episodes))
        for start in range(first, block.stop, len(checked)):
            numbers = range(start, min(start + len(checked), block.stop))
            rows, part = np.zeros((len(block), envs.spec(checked[0]).obs_dim), np.float32), slice(start - first, None)
            starts = [episode_seed(seed, stream, i) for i in numbers]
            names = [f"evaluation episode {i + 1}" for i in numbers]
            rollout, rngs = (
                Rollout(checked[: len(numbers)], starts, names, keep=keep),
                [rng(seed, Stream.NOISE, i) for i in numbers],
            )
            while rollout.playing:
                rows[part][: len(numbers)] = rollout.obs
                if len(actions := act(rows)) != len(rows):
                    raise ValueError(f"{len(actions)} actions for {len(rows)} observations")
                actions = actions[part][: len(numbers)]
                for i in rollout.playing if noise else ():
                    actions[i] = np.clip(actions[i] + noise * rngs[i].normal(size=actions[i].shape), -1, 1)
                rollout.step(actions)
            returns[start : numbers.stop], lengths[start : numbers.stop] = rollout.returns, rollout.lengths
            infos += map(_scalars, rollout.info)
            kept += rollout.episodes() if keep else []
    return Evaluation(returns, lengths, time.perf_counter() - begin, _columns(infos), tuple(kept))


def _scalars(info: dict[str, Any]) -> dict[str, float]:
    """The entries that are a single real number, copied: the environment may use the dict again."""
    arrays = {name: real_numbers(value) for name, value in info.items() if isinstance(name, str)}
    return {name: float(array.item()) for name, array in arrays.items() if array is not None and array.size == 1}


def _columns(infos: Sequence[dict[str, float]]) -> dict[str, np.ndarray]:
    """The numbers that every episode has, by name."""
    names = [name for name in infos[0] if all(name in info for info in infos)]
    return {name: np.array([info[name] for info in infos]) for name in names}
