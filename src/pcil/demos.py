"""Demonstrations: read, checked, recorded and written as Minari datasets (HDF5 + JSON). Nothing is ever downloaded."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, registry
from jaxtyping import Float

from pcil import envs, seeds
from pcil.errors import InputError
from pcil.minari_files import read, reason, task_of
from pcil.types import Episode, Spec

SHIPPED = Path(__file__).parent / "data" / "demos"  # a Minari root, so that plain Minari can load what ships
ACTION_TOLERANCE = 1e-6  # how far rounding may carry an action out of [-1, 1]
ATTEMPTS_PER_EPISODE = 10  # `record` gives up after so many rollouts for each episode that was asked for


@dataclasses.dataclass(frozen=True, eq=False)
class Demonstrations:
    """Whole episodes of an expert, with flat observations and with actions in [-1, 1].

    `task` is a shipped task's name ("walker_walk") or a Gymnasium id. `info` says where the episodes come from and must
    be JSON; `shipped` shows its keys `expert` (one line: method, frames, seed), `frames` and `seeds_tried`.
    """

    task: str
    episodes: tuple[Episode, ...]
    info: dict[str, Any]

    @classmethod
    def load(cls, spec: str | Path) -> Demonstrations:
        """The demonstrations that `spec` names; `InputError` says what is wrong with it or with them.

        `spec` is, tried in this order: a shipped task ("walker_walk" or "dmc/walker_walk/expert-v0"), the path of a
        Minari dataset folder (or of the `data` folder in it), the id of a dataset in the user's local Minari root.
        Dict observations are flattened as FlattenObservation does it, and actions are brought from the dataset's Box to
        [-1, 1] as RescaleAction does it. All that Minari knows of a foreign dataset becomes its `info`.
        """
        data = _find(spec)
        task, episodes, info = read(data)
        _check(episodes, str(data))
        return cls(task, tuple(episodes), info)

    @property
    def num_steps(self) -> int:
        """Agent steps in all episodes together; each is one row of `obs` and `action`."""
        return sum(len(episode) for episode in self.episodes)

    @property
    def returns(self) -> Float[np.ndarray, " episodes"]:
        """The undiscounted sum of the environment's rewards, for each episode, in float64."""
        return np.array([episode.total_reward for episode in self.episodes], np.float64)

    @property
    def return_mean(self) -> float:
        """The mean return of an episode."""
        return float(self.returns.mean())

    @property
    def return_std(self) -> float:
        """The population standard deviation of the returns (divided by the number of episodes; 0 for one episode)."""
        return float(self.returns.std())

    @property
    def obs(self) -> Float[np.ndarray, "N O"]:
        """All states in which an action was taken, in a new array: each episode's final observation is left out."""
        return np.concatenate([episode.obs[:-1] for episode in self.episodes])

    @property
    def action(self) -> Float[np.ndarray, "N A"]:
        """The actions taken in `obs`, row by row, in a new array."""
        return np.concatenate([episode.action for episode in self.episodes])

    @property
    def hash(self) -> str:
        """Hexadecimal SHA-256 of the observations, actions, rewards and terminations; saving and loading keep it."""
        digest = hashlib.sha256()
        for episode in self.episodes:
            for array, dtype in ((episode.obs, "<f4"), (episode.action, "<f4"), (episode.reward, "<f8")):
                digest.update(f"{array.shape} {bool(episode.terminated)}".encode() + array.astype(dtype).tobytes())
        return digest.hexdigest()

    def validate(self, spec: Spec | None) -> Demonstrations:
        """These demonstrations; `InputError` if there are none, if values are not finite, if actions leave [-1, 1], or
        if shapes differ from those of the environment's `spec` (from the first episode's, if that is None)."""
        _check(self.episodes, f"the demonstrations of {self.task}", spec)
        return self

    def take(self, n: int | None) -> Demonstrations:
        """The first `n` episodes; all of them if `n` is None. `InputError` if there are not as many, or `n` < 1."""
        available = len(self.episodes)
        if n is not None and not 1 <= n <= available:
            raise InputError(f"{n} demonstrations of {self.task} were asked for, but 1 to {available} can be had.")
        return dataclasses.replace(self, episodes=self.episodes[:n])

    def save(self, path: str | Path, *, dataset_id: str | None = None) -> Path:
        """Write a Minari dataset folder at `path`, whole or not at all, and return its absolute path.

        Observations and actions are written as float32, rewards as they are. Without `dataset_id`, the id is the path
        below the Minari root, or is made of the folder's name. The environment's specification goes along if
        Gymnasium has it registered. `InputError` if something is there already or the place can not be written.
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
                self._write(unfinished / "data", dataset_id)
                unfinished.rename(folder)
        except (OSError, TypeError, ValueError) as error:
            raise InputError(
                f"{folder} can not be written ({reason(error)}): the place must be writable, the info JSON."
            ) from error
        return folder

    def _write(self, data: Path, dataset_id: str) -> None:
        """Write `metadata.json` and `main_data.hdf5` into the new folder `data`, by Minari's own hand."""
        import minari
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage

        data.mkdir(parents=True)
        box, first = gymnasium.spaces.Box, self.episodes[0]
        observation_space = box(-np.inf, np.inf, first.obs.shape[1:], np.float32)
        action_space = box(-1.0, 1.0, first.action.shape[1:], np.float32)
        storage = MinariStorage.new(data, observation_space, action_space, _env_spec(self.task))
        known = {"dataset_id": dataset_id, "minari_version": minari.__version__}
        described = {"description": f"Demonstrations of {self.task} by {self.info.get('expert', 'an unknown expert')}."}
        storage.update_metadata(known | described | {"pcil": {"task": self.task, "info": self.info}})
        for episode in self.episodes:
            last = np.arange(len(episode)) == len(episode) - 1
            buffer = EpisodeBuffer(
                seed=episode.seed,
                observations=list(episode.obs.astype(np.float32)),
                actions=list(episode.action.astype(np.float32)),
                rewards=list(episode.reward),
                terminations=list(last & episode.terminated),
                truncations=list(last & (not episode.terminated)),
            )
            storage.update_episodes([buffer])


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

    `policy` maps an observation [O] in float32 to an action [A] in [-1, 1]. Episodes that return less than
    `minimum_return` are dropped and tried again with the next seed. `info` is kept; `record_*` keys are added to it.
    """
    if episodes < 1:
        raise InputError(f"{episodes} episodes were asked for, but at least 1 must be recorded.")
    if minimum_return is not None and not minimum_return < math.inf:
        raise InputError(f"The minimum return is {minimum_return}; it must be a number that an episode can reach.")
    env, kept = envs.checked(env), []
    for attempt in range(limit := ATTEMPTS_PER_EPISODE * episodes):
        env.episode = f"recorded episode {attempt + 1}"
        episode = _rollout(policy, env, seeds.episode_seed(seed, seeds.Stream.RECORD, attempt))
        if minimum_return is None or episode.total_reward >= minimum_return:
            kept.append(episode)
        if len(kept) == episodes:
            made = {"record_seed": seed, "record_attempts": attempt + 1, "record_minimum_return": minimum_return}
            return Demonstrations(task, tuple(kept), info | made).validate(None)
    raise InputError(
        f"Only {len(kept)} of {limit} episodes of {task} returned at least {minimum_return}, but {episodes} were "
        f"asked for: lower the minimum return or record a better policy."
    )


def _rollout(policy: Callable[[np.ndarray], Any], env: envs.Checked, seed: int) -> Episode:
    observations, actions, rewards = [env.reset(seed=seed)[0]], [], []
    terminated = truncated = False
    while not (terminated or truncated):
        with np.errstate(over="ignore"):  # what is too large for float32 becomes infinite here, and is refused as such
            action = env.checked_action(policy(observations[-1])).astype(np.float32)
        obs, reward, terminated, truncated, _ = env.step(action)
        observations.append(obs)
        actions.append(action)
        rewards.append(reward)
    return Episode(np.stack(observations), np.stack(actions), np.array(rewards), terminated, seed)


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
        told = {key: demos.info.get(key) for key in ("expert", "frames", "seeds_tried")}
        rows.append({"task": demos.task, **dims, **counts, **returns, **told, "hash": demos.hash})
    return rows


def _check(episodes: Sequence[Episode], source: str, spec: Spec | None = None) -> None:
    """Refuse what `Demonstrations.validate` says, naming `source`."""
    if not episodes:
        raise InputError(f"There are no episodes in {source}, but at least one is needed.")
    first = episodes[0]
    obs_dim, action_dim = (spec.obs_dim, spec.action_dim) if spec else (first.obs.shape[-1], first.action.shape[-1])
    for index, episode in enumerate(episodes):
        where, steps = f"Episode {index} of {source}", len(episode)
        for name, shape in (("obs", (steps + 1, obs_dim)), ("action", (steps, action_dim)), ("reward", (steps,))):
            array = getattr(episode, name)
            if array.shape != shape:
                whose = "in this environment" if spec else "after the first episode"
                raise InputError(f"{where} has {name} of shape {array.shape}, but {whose} it must be {shape}.")
            if not np.isfinite(array).all():
                raise InputError(f"{where} has NaN or infinite values in {name}, but all must be finite.")
        low, high = float(episode.action.min()), float(episode.action.max())
        if max(-low, high) > 1 + ACTION_TOLERANCE:
            raise InputError(f"{where} has actions from {low:.7g} to {high:.7g}, but their bounds are [-1, 1].")


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


def _env_spec(task: str) -> EnvSpec | None:
    """What Gymnasium has registered for `task`, with the wrappers that make it flat and its actions [-1, 1]."""
    known = next((registry[name] for name in (f"dmc/{task}-v0", task.rpartition(":")[2]) if name in registry), None)
    if known is None or not isinstance(known.entry_point, str):
        return None
    if known.namespace in ("dmc", "toy"):  # these are so by themselves
        return known
    flatten = gymnasium.wrappers.FlattenObservation.wrapper_spec()
    rescale = gymnasium.wrappers.RescaleAction.wrapper_spec(min_action=-1.0, max_action=1.0)
    return dataclasses.replace(known, additional_wrappers=(flatten, rescale))


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
