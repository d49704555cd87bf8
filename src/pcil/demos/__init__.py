"""Demonstrations: read, checked, recorded and written as Minari datasets (HDF5 + JSON). Nothing is ever downloaded."""

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
from pcil.demos.arrays import episodes_of
from pcil.demos.minari import Stored, read, reason, task_of, write
from pcil.envs.rollout import Rollout
from pcil.errors import InputError, brief
from pcil.types import Episode, Origin, Spec

SHIPPED = Path(__file__).parent.parent / "data" / "demos"  # a Minari root, so that plain Minari can load what ships
ACTION_TOLERANCE = 1e-6  # how far rounding may carry an action out of [-1, 1]
ATTEMPTS_PER_EPISODE = 10  # `record` gives up after so many rollouts for each episode that was asked for


@dataclasses.dataclass(frozen=True, eq=False)
class Demonstrations:
    """Whole episodes of an expert, with flat observations and with actions in [-1, 1].

    `task` is a shipped task's name ("walker_walk") or a Gymnasium id. `info` says where the episodes come from and must
    be JSON; `shipped` shows its keys `expert` (one line: method, frames, seed), `frames` and `seeds_tried`. `origin` is what is
    known of the environment. Without actions (`has_actions`) an episode has rows of no numbers in their place, without rewards
    (`has_rewards`) zeros, and whatever asks for them raises `InputError`.
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
        """Demonstrations of lists with one array for each episode: `obs` [T+1, O], `actions` [T, A] in [-1, 1] (see `clip`),
        `rewards` [T], and whether it `terminated`, True or False (by default none did). Without actions or rewards, methods
        that read none can be trained. `InputError` names the array that does not fit."""
        parts = episodes_of(obs, actions, rewards, terminated)
        made = cls(task, parts, info or {}, has_actions=actions is not None, has_rewards=rewards is not None)
        _check(made, "the arrays", bounded=False)
        return made

    @classmethod
    def load(cls, spec: str | Path, *, bounded: bool = True) -> Demonstrations:
        """The demonstrations that `spec` names; `InputError` says what is wrong with it or with them.

        `spec` is, tried in this order: a shipped task ("walker_walk" or "dmc/walker_walk/expert-v0"), the path of a
        Minari dataset folder (or of the `data` folder in it), the id of a dataset in the user's local Minari root.
        Dict observations are flattened as FlattenObservation does it, and actions brought from the dataset's Box to [-1, 1].
        All that Minari knows of a foreign dataset becomes its `info`. Arrays without the checksum that `save` wrote are
        refused, and actions out of bounds; with `bounded=False` these stay, for `clip`.
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

    @property
    def num_steps(self) -> int:
        """Agent steps in all episodes together; each is one row of `obs` and `action`."""
        return sum(len(episode) for episode in self.episodes)

    @property
    def returns(self) -> Float[np.ndarray, " episodes"]:
        """The undiscounted sum of the environment's rewards, for each episode, in float64."""
        self._must_have("rewards")
        return np.array([episode.total_reward for episode in self.episodes], np.float64)

    @property
    def return_mean(self) -> float | None:
        """The mean return of an episode; None without rewards."""
        return float(self.returns.mean()) if self.has_rewards else None

    @property
    def return_std(self) -> float | None:
        """The population standard deviation of the returns, divided by the number of episodes; None without rewards."""
        return float(self.returns.std()) if self.has_rewards else None

    @property
    def obs(self) -> Float[np.ndarray, "N O"]:
        """All states in which an action was taken, in a new array: each episode's final observation is left out."""
        return np.concatenate([episode.obs[:-1] for episode in self.episodes])

    @property
    def action(self) -> Float[np.ndarray, "N A"]:
        """The actions taken in `obs`, row by row, in a new array."""
        self._must_have("actions")
        return np.concatenate([episode.action for episode in self.episodes])

    @property
    def hash(self) -> str:
        """Hexadecimal SHA-256 of the observations, actions, rewards and terminations; saving and loading keep it."""
        digest = hashlib.sha256(" ".join(self._absent).encode())
        for episode in self.episodes:
            for array, dtype in ((episode.obs, "<f4"), (episode.action, "<f4"), (episode.reward, "<f8")):
                digest.update(f"{array.shape} {bool(episode.terminated)}".encode() + array.astype(dtype).tobytes())
        return digest.hexdigest()

    def validate(self, spec: Spec | None) -> Demonstrations:
        """These demonstrations; `InputError` if there are none, if values are not finite, if actions leave [-1, 1], or if
        shapes differ from those of the environment's `spec` (from the first episode's, if that is None)."""
        _check(self, f"the demonstrations of {self.task}", spec)
        return self

    def clip(self) -> Demonstrations:
        """These demonstrations with each entry of an action clipped to [-1, 1]."""
        parts = (dataclasses.replace(episode, action=np.clip(episode.action, -1, 1)) for episode in self.episodes)
        return dataclasses.replace(self, episodes=tuple(parts))

    def take(self, n: int | None) -> Demonstrations:
        """The first `n` episodes; all of them if `n` is None. `InputError` if there are not as many, or `n` < 1."""
        available = len(self.episodes)
        if n is not None and not 1 <= n <= available:
            raise InputError(f"{n} demonstrations of {self.task} were asked for, but 1 to {available} can be had.")
        return dataclasses.replace(self, episodes=self.episodes[:n])

    def save(self, path: str | Path, *, dataset_id: str | None = None) -> Path:
        """Write a Minari dataset folder at `path`, whole or not at all, and return its absolute path.

        Observations and actions are written as float32, rewards as they are, and NaN for what is absent. Without
        `dataset_id`, the id is the path below the Minari root, or is made of the folder's name. The environment's
        specification goes along if Gymnasium has it registered. `InputError` if something is there already or the place can
        not be written.
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
                files.reserve(Path(scratch), 2 * size + 2**16 * len(self.episodes) + 2**20)  # HDF5 dies on a full disk
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
    """The absolute path of a folder that is still to be made, or is empty; `InputError` where something is there."""
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
    """`episodes` episodes of `policy`, a function of the arguments alone: attempt k is reset with the k-th seed.

    `policy` maps an observation [O] in float32 to an action [A] within the bounds of `env`, which are brought to [-1, 1] in
    what is kept. Episodes that return less than `minimum_return` are dropped and tried again with the next seed. `info` is
    kept; `record_*` keys are added to it.
    """
    if episodes < 1:
        raise InputError(f"{episodes} episodes were asked for, but at least 1 must be recorded.")
    if minimum_return is not None and not minimum_return < math.inf:
        raise InputError(f"The minimum return is {minimum_return}; it must be a number that an episode can reach.")
    env, kept = envs.checked(env), []
    for attempt in range(limit := ATTEMPTS_PER_EPISODE * episodes):
        rollout = Rollout([env], [seeds.episode_seed(seed, seeds.Stream.RECORD, attempt)], [f"recorded episode {attempt + 1}"])
        while rollout.playing:
            with np.errstate(over="ignore"):  # what is too large for float32 becomes infinite here, and is refused as such
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
    """The episode with actions brought from their bounds to [-1, 1]."""
    if not isinstance(space, gymnasium.spaces.Box) or not space.is_bounded():
        raise InputError(f"Demonstrations need actions in a Box with finite bounds; those of the environment are {space}.")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if (low == -1).all() and (high == 1).all():
        return episode
    action = (episode.action - (high + low) / 2) / ((high - low) / 2)
    return dataclasses.replace(episode, action=action.astype(np.float32))


def shipped_tasks() -> list[str]:
    """The names of the tasks whose demonstrations lie in the package."""
    return sorted(path.parents[2].name for path in SHIPPED.glob("dmc/*/expert-v0/data/metadata.json"))


def shipped() -> list[dict[str, Any]]:
    """One row for each shipped dataset, read from the data itself except for what only `info` knows (else None)."""
    rows = []
    for demos in map(Demonstrations.load, shipped_tasks()):
        dims = {"observation_dim": demos.obs.shape[1], "action_dim": demos.action.shape[1]}
        counts = {"episodes": len(demos.episodes), "steps": demos.num_steps}
        returns = {"return_mean": demos.return_mean, "return_std": demos.return_std}
        returns |= {"return_min": float(demos.returns.min()), "return_max": float(demos.returns.max())}
        told = {key: demos.info.get(key) for key in ("expert", "frames", "seeds_tried")}
        rows.append({"task": demos.task, **dims, **counts, **returns, **told, "hash": demos.hash})
    return rows


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The rows of `shipped`, one line a dataset, for people."""
    sizes = f"{'obs':>4}{'act':>4}{'episodes':>9}{'steps':>7}"
    lines = [f"{'task':<18}{sizes}{'return':>15}{'min':>7}{'max':>7}{'tries':>6}  {'hash':<10}expert"]
    for row in rows:
        sizes = f"{row['observation_dim']:>4}{row['action_dim']:>4}{row['episodes']:>9}{row['steps']:>7}"
        returns = f"{row['return_mean']:.1f} +- {row['return_std']:.1f}"
        returns = f"{returns:>15}{row['return_min']:>7.1f}{row['return_max']:>7.1f}"
        tries = "" if row["seeds_tried"] is None else row["seeds_tried"]
        lines.append(f"{row['task']:<18}{sizes}{returns}{tries:>6}  {row['hash'][:8]:<10}{row['expert']}")
    return lines


def _check(demos: Demonstrations, source: str, spec: Spec | None = None, *, bounded: bool = True) -> None:
    """Refuse what `Demonstrations.validate` says, naming `source`."""
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
        where, steps = f"Episode {index} of {source}", len(episode)
        for name, shape in (("obs", (steps + 1, obs_dim)), ("action", (steps, action_dim)), ("reward", (steps,))):
            array = getattr(episode, name)
            if array.shape != shape:
                whose = "in this environment" if spec else "after the first episode"
                raise InputError(f"{where} has {name} of shape {array.shape}, but {whose} it must be {shape}.")
            if not np.isfinite(array).all():
                raise InputError(f"{where} has NaN or infinite values in {name}, but all must be finite.")
        low, high = (float(f(episode.action, initial=0)) for f in (np.min, np.max))
        if bounded and max(-low, high) > 1 + ACTION_TOLERANCE:
            low, high = float(episode.action.min()), float(episode.action.max())
            raise InputError(
                f"{where} has actions from {low:.7g} to {high:.7g}, but their bounds are [-1, 1]; --clip-actions True (or "
                "Demonstrations.clip in Python) clips them."
            )


def _find(spec: str | Path) -> Path:
    """The folder with the `metadata.json` of the dataset that `spec` names."""
    names = shipped_tasks()
    if isinstance(spec, str) and task_of(spec) in names:
        places = [SHIPPED / "dmc" / task_of(spec) / "expert-v0"]
    else:
        places = [_expanded(Path(spec)), _minari_root() / spec]
    for place in places:
        for data in (place / "data", place):
            if (data / "metadata.json").is_file():
                return data
    raise InputError(
        f"There is no Minari dataset (a folder with data/metadata.json) {str(spec)!r}: give a shipped task "
        f"({', '.join(names) or 'none ship'}), the path of such a folder, or an id below {_minari_root()}."
    )


def _minari_root() -> Path:
    """Where Minari looks for datasets; unlike Minari's own function, this does not make the folder."""
    return _expanded(Path(os.environ.get("MINARI_DATASETS_PATH", "~/.minari/datasets")))


def _expanded(path: Path) -> Path:
    """A path with "~" put in, as it is where nobody knows whose home is meant."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path


def _dataset_id(folder: Path) -> str:
    """The path below a Minari root, as Minari wants it; elsewhere the folder's name, made into an id."""
    for root in (SHIPPED.resolve(), _minari_root().resolve()):
        if folder.is_relative_to(root):
            return folder.relative_to(root).as_posix()
    return re.sub(r"[^-\w]+", "_", re.sub(r"-v\d+$", "", folder.name)) + "-v0"
