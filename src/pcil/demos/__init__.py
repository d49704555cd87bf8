"""Demonstrations: load, check, record and save them as Minari datasets (HDF5 and JSON). Nothing is ever downloaded."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float

from pcil import envs, files, seeds
from pcil.demos.arrays import episodes_of, to_unit_box
from pcil.demos.minari import Stored, read, reason, task_of, write
from pcil.envs.rollout import Rollout
from pcil.errors import InputError, brief
from pcil.types import Episode, Origin, Spec

SHIPPED = Path(__file__).parent.parent / "data" / "demos"  # laid out as a Minari root, so that Minari can load it too
ACTION_TOLERANCE = 1e-6  # how far outside [-1, 1] rounding may put an action
ATTEMPTS_PER_EPISODE = 10  # `record` gives up after this many attempts per requested episode


@dataclasses.dataclass(frozen=True, eq=False)
class Demonstrations:
    """Complete episodes of an expert, with flat observations and with actions in [-1, 1].

    `task` is the name of a shipped task ("walker_walk") or a Gymnasium id. `info` describes where the episodes come from and
    must be serialisable as JSON; `shipped` shows its keys `expert` (one line: method, frames, seed), `frames` and
    `seeds_tried`. `origin` describes the environment as far as it is known. If `has_actions` is False, the action arrays have
    shape `[T, 0]`; if `has_rewards` is False, the rewards are 0. Properties that need what is missing raise `InputError`.
    """

    task: str
    episodes: tuple[Episode, ...]
    info: dict[str, Any]
    origin: Origin = dataclasses.field(default_factory=Origin)
    has_actions: bool = True
    has_rewards: bool = True

    @classmethod
    def from_arrays(
        cls,
        obs: Any,
        actions: Any = None,
        rewards: Any = None,
        terminated: Any = None,
        *,
        task: str = "arrays",
        info: dict[str, Any] | None = None,
    ) -> Demonstrations:
        """Create demonstrations from lists with one entry per episode.

        `obs` are [T+1, O], `actions` [T, A] in [-1, 1] (see `clip`) and `rewards` [T]; `terminated` are True or False (by
        default False for all). Without actions or rewards, only methods that do not read them can be trained. `InputError`
        names the first invalid array.
        """
        parts = episodes_of(obs, actions, rewards, terminated)
        made = cls(task, parts, info or {}, has_actions=actions is not None, has_rewards=rewards is not None)
        _check(made, "the arrays", bounded=False)
        return made

    @classmethod
    def load(cls, spec: str | Path, *, bounded: bool = True) -> Demonstrations:
        """Load the demonstrations that `spec` names; `InputError` if there are none or if they are invalid.

        `spec` is one of the following, tried in this order: a shipped task ("walker_walk" or "dmc/walker_walk/expert-v0"), the
        path of a Minari dataset folder (or of its `data` folder), or the id of a dataset in the local Minari root.
        Dict observations are flattened in the order of Gymnasium's FlattenObservation, and actions are rescaled from the
        dataset's Box to [-1, 1]. The Minari metadata of a dataset that `save` did not write becomes its `info`. Arrays that do
        not match the checksum written by `save` are refused. So are actions out of bounds, unless `bounded` is False.
        """
        data = _find(spec)
        stored = read(data, trusted=data.is_relative_to(SHIPPED))
        loaded = cls(*stored[:-1])
        _check(loaded, str(data), bounded=bounded)
        if stored.hash not in (None, loaded.hash):
            raise InputError(
                f"{data} does not hold what was saved there: its checksum is {loaded.hash}, and metadata.json says "
                f"{brief(stored.hash)} (pcil, hash); copy it again, or delete that key if you changed the arrays yourself."
            )
        return loaded

    def __repr__(self) -> str:
        paid = f", return {self.return_mean:.1f} +- {self.return_std:.1f}" if self.has_rewards and self.episodes else ""
        return f"Demonstrations({self.task!r}: {len(self.episodes)} episodes, {self.num_steps} steps{paid})"

    @property
    def num_steps(self) -> int:
        """The total number of agent steps, which is the number of rows of `obs` and `action`."""
        return sum(len(episode) for episode in self.episodes)

    @property
    def returns(self) -> Float[np.ndarray, " episodes"]:
        """The undiscounted return of each episode, in float64."""
        self._must_have("rewards")
        return np.array([episode.total_reward for episode in self.episodes], np.float64)

    @property
    def return_mean(self) -> float | None:
        """The mean return; None without rewards."""
        return float(self.returns.mean()) if self.has_rewards else None

    @property
    def return_std(self) -> float | None:
        """The population standard deviation of the returns (with divisor N, not N - 1); None without rewards."""
        return float(self.returns.std()) if self.has_rewards else None

    @property
    def obs(self) -> Float[np.ndarray, "N O"]:
        """The observations of all steps in a new array, without each episode's final observation."""
        return np.concatenate([episode.obs[:-1] for episode in self.episodes])

    @property
    def action(self) -> Float[np.ndarray, "N A"]:
        """The actions of all steps in a new array; row `i` was taken in row `i` of `obs`."""
        self._must_have("actions")
        return np.concatenate([episode.action for episode in self.episodes])

    @property
    def hash(self) -> str:
        """The hexadecimal SHA-256 of observations, actions, rewards and terminations; saving and loading keep it."""
        digest = hashlib.sha256(" ".join(self._absent).encode())
        for episode in self.episodes:
            for array, dtype in ((episode.obs, "<f4"), (episode.action, "<f4"), (episode.reward, "<f8")):
                digest.update(f"{array.shape} {bool(episode.terminated)}".encode() + array.astype(dtype).tobytes())
        return digest.hexdigest()

    def validate(self, spec: Spec | None) -> Demonstrations:
        """Return these demonstrations; `InputError` if there are no episodes, if values are not finite, if actions are outside
        [-1, 1], or if shapes differ from those of the environment's `spec` (of the first episode if `spec` is None)."""
        _check(self, f"the demonstrations of {self.task}", spec)
        return self

    def clip(self) -> Demonstrations:
        """These demonstrations with each entry of an action clipped to [-1, 1]."""
        parts = (dataclasses.replace(episode, action=np.clip(episode.action, -1, 1)) for episode in self.episodes)
        return dataclasses.replace(self, episodes=tuple(parts))

    def take(self, n: int | None) -> Demonstrations:
        """The first `n` episodes, or all of them if `n` is None; `InputError` if `n` < 1 or if there are fewer than `n`."""
        available = len(self.episodes)
        if n is not None and not 1 <= n <= available:
            raise InputError(f"{n} demonstrations of {self.task} were asked for, but 1 to {available} can be had.")
        return dataclasses.replace(self, episodes=self.episodes[:n])

    def at_least(self, minimum_return: float | int) -> Demonstrations:
        """The episodes of this return or a higher one; `InputError` if there are none."""
        return self._picked(np.flatnonzero(self.returns >= minimum_return), f"a return of at least {minimum_return:g}")

    def best(self, n: int) -> Demonstrations:
        """The `n` episodes of the highest returns, in their order here; `InputError` if there are fewer, or if `n` < 1."""
        self.take(n)
        return self._picked(np.sort(np.argsort(-self.returns, kind="stable")[:n]), "a high return")

    def choose(self, n: int, seed: int) -> Demonstrations:
        """A random choice of `n` episodes, in their order here; `InputError` if there are fewer, or if `n` < 1."""
        self.take(n)
        return self._picked(np.sort(np.random.default_rng(seed).permutation(len(self.episodes))[:n]), "luck")

    def _picked(self, indices: np.ndarray, what: str) -> Demonstrations:
        if not len(indices):
            raise InputError(f"No episode of the demonstrations of {self.task} has {what}.")
        return dataclasses.replace(self, episodes=tuple(self.episodes[i] for i in indices))

    def save(self, path: str | Path, *, dataset_id: str | None = None) -> Path:
        """Write a Minari dataset folder at `path`, completely or not at all, and return its absolute path.

        Observations and actions are written as float32, rewards with their own dtype, and missing actions or rewards as NaN.
        The default `dataset_id` is the path relative to the Minari root, or is derived from the folder's name. The dataset
        includes the environment's specification if it is registered with Gymnasium. `InputError` if `path` exists already or
        can not be written.
        """
        self.validate(None)
        folder = free_folder(path)
        dataset_id = dataset_id or _dataset_id(folder)
        if not re.fullmatch(r"([-\w]+/)*[-\w]+-v\d+", dataset_id):
            raise InputError(f"{dataset_id!r} is no Minari dataset id: it must look like namespace/name-v0.")
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as scratch:
                unfinished = Path(scratch) / "dataset"
                size = sum(e.obs.nbytes + e.action.nbytes + e.reward.nbytes for e in self.episodes)
                files.reserve(Path(scratch), 2 * size + 2**16 * len(self.episodes) + 2**20)  # HDF5 crashes if the disk is full
                write(unfinished / "data", dataset_id, Stored(*(getattr(self, name) for name in Stored._fields)))
                unfinished.rename(folder)
        except (OSError, TypeError, ValueError) as error:
            why = f"{folder} can not be written ({reason(error)}): the place must be writable, the info JSON."
            raise InputError(why) from error
        return folder

    @property
    def _absent(self) -> list[str]:
        return [name for name in ("actions", "rewards") if not getattr(self, f"has_{name}")]

    def _must_have(self, name: str) -> None:
        if name in self._absent:
            raise InputError(f"The demonstrations of {self.task} have no {name}.")


def free_folder(path: str | Path) -> Path:
    """The absolute path of a folder that does not exist yet or is empty; `InputError` if it holds anything."""
    folder = _expanded(Path(path)).resolve()
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} exists already: give a path where there is nothing yet.")
    except OSError as error:
        raise InputError(f"{folder} can not be written ({reason(error)}): the place must be writable.") from error
    return folder


def record(
    policy: Callable[[np.ndarray], Any],
    env: gymnasium.Env,
    episodes: int,
    *,
    task: str,
    seed: int,
    minimum_return: float | None = None,
    info: dict[str, Any],
) -> Demonstrations:
    """Record `episodes` episodes of `policy`. The result depends on the arguments alone: attempt k is reset with the k-th seed.

    `policy` maps a float32 observation [O] to an action [A] within the bounds of `env`; the recorded actions are rescaled to
    [-1, 1]. An episode whose return is below `minimum_return` is discarded and replaced by one with the next seed. The
    demonstrations have `info` and some additional `record_*` keys.
    """
    if episodes < 1:
        raise InputError(f"{episodes} episodes were asked for, but at least 1 must be recorded.")
    if minimum_return is not None and not minimum_return < math.inf:
        raise InputError(f"The minimum return is {minimum_return}; it must be a number that an episode can reach.")
    env, kept = envs.checked(env), []
    for attempt in range(limit := ATTEMPTS_PER_EPISODE * episodes):
        rollout = Rollout([env], [seeds.episode_seed(seed, seeds.Stream.RECORD, attempt)], [f"recorded episode {attempt + 1}"])
        while rollout.playing:
            with np.errstate(over="ignore"):  # values too large for float32 become infinite and are refused by `step`
                action = env.checked_action(policy(rollout.obs[0])).astype(np.float32)
            rollout.step([action])
        (episode,) = rollout.episodes()
        if minimum_return is None or episode.total_reward >= minimum_return:
            kept.append(_in_unit_box(episode, env.action_space))
        if len(kept) == episodes:
            made = {"record_seed": seed, "record_attempts": attempt + 1, "record_minimum_return": minimum_return}
            return Demonstrations(task, tuple(kept), info | made, envs.origin(env)).validate(None)
    raise InputError(
        f"Only {len(kept)} of {limit} episodes of {task} returned at least {minimum_return}, but {episodes} were "
        f"asked for: lower the minimum return or record a better policy."
    )


def _in_unit_box(episode: Episode, space: gymnasium.Space) -> Episode:
    """The episode with its actions rescaled from the bounds of `space` to [-1, 1]."""
    if not isinstance(space, gymnasium.spaces.Box) or not space.is_bounded():
        raise InputError(f"Demonstrations need actions in a Box with finite bounds; those of the environment are {space}.")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if (low == -1).all() and (high == 1).all():
        return episode
    return dataclasses.replace(episode, action=to_unit_box(episode.action, low, high).astype(np.float32))


def shipped_tasks() -> list[str]:
    """The names of the tasks whose demonstrations ship with the package, those of DeepMind Control first."""
    return list(_shipped_places())


def _shipped_places() -> dict[str, Path]:
    """The dataset of each such task, `<suite>/<task>/expert-v0`."""
    return {path.parents[2].name: path.parents[1] for path in sorted(SHIPPED.glob("*/*/expert-v0/data/metadata.json"))}


def _check(demos: Demonstrations, source: str, spec: Spec | None = None, *, bounded: bool = True) -> None:
    """Raise the `InputError` of `Demonstrations.validate`, with `source` in its message."""
    episodes = demos.episodes
    if not episodes:
        raise InputError(f"There are no episodes in {source}, but at least one is needed.")
    first = episodes[0]
    if (
        min(first.obs.ndim, first.action.ndim) < 2
        or not first.obs.shape[1]
        or (demos.has_actions and not first.action.shape[1])
    ):
        shapes = f"observations of shape {first.obs.shape} and actions of shape {first.action.shape}"
        raise InputError(f"Episode 0 of {source} has {shapes}; each must be rows of at least one number.")
    obs_dim, action_dim = (spec.obs_dim, spec.action_dim) if spec else (first.obs.shape[-1], first.action.shape[-1])
    action_dim = action_dim if demos.has_actions else first.action.shape[-1]
    for index, episode in enumerate(episodes):
        where = f"Episode {index} of {source}"
        for name, row in (("obs", (obs_dim,)), ("action", (action_dim,)), ("reward", ())):  # `Episode` has checked the lengths
            array = getattr(episode, name)
            if array.shape != (shape := (len(array), *row)):
                whose = "in this environment" if spec else "after the first episode"
                raise InputError(f"{where} has {name} of shape {array.shape}, but {whose} it must be {shape}.")
            if not np.isfinite(array).all():
                raise InputError(f"{where} has NaN or infinite values in {name}, but all must be finite.")
        if bounded and np.abs(episode.action).max(initial=0) > 1 + ACTION_TOLERANCE:
            low, high = float(episode.action.min()), float(episode.action.max())
            raise InputError(
                f"{where} has actions from {low:.7g} to {high:.7g}, but their bounds are [-1, 1]; --clip-actions True (or "
                "Demonstrations.clip in Python) clips them."
            )


def _find(spec: str | Path) -> Path:
    """The folder that holds `metadata.json` of the dataset that `spec` names."""
    shipped = _shipped_places()
    if isinstance(spec, str) and task_of(spec) in shipped:
        places = [shipped[task_of(spec)]]
    else:
        places = [_expanded(Path(spec)), _minari_root() / spec]
    for place in places:
        for data in (place / "data", place):
            if (data / "metadata.json").is_file():
                return data
    raise InputError(
        f"There is no Minari dataset (a folder with data/metadata.json) {str(spec)!r}: give a shipped task "
        f"({', '.join(shipped) or 'none ship'}), the path of such a folder, or an id below {_minari_root()}."
    )


def _minari_root() -> Path:
    """The folder in which Minari looks for datasets; unlike Minari's own function, this does not create it."""
    return _expanded(Path(os.environ.get("MINARI_DATASETS_PATH", "~/.minari/datasets")))


def _expanded(path: Path) -> Path:
    """The path with "~" expanded; unchanged if the home directory can't be determined."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path


def _dataset_id(folder: Path) -> str:
    """The path relative to a Minari root, as Minari requires it; outside of one, an id derived from the folder's name."""
    for root in (SHIPPED.resolve(), _minari_root().resolve()):
        if folder.is_relative_to(root):
            return folder.relative_to(root).as_posix()
    return re.sub(r"[^-\w]+", "_", re.sub(r"-v\d+$", "", folder.name)) + "-v0"
