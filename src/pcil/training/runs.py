"""Run folders: `run.json`, locks, `DONE`; and `train`, which starts or resumes a run."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium

from pcil import compilation, envs, files
from pcil.demos import Demonstrations
from pcil.errors import InputError, RunError, brief
from pcil.files import flat
from pcil.policy import Policy, load_policy
from pcil.training import fit, loop, presets, progress, state
from pcil.training.callbacks import LOGS, Callback, Callbacks
from pcil.training.config import Run, differences, renamed

FREE = ("demos", "frames", "until")
"""Settings in which a command may differ from the `run.json` of its folder, in some ways (see `_before`)."""
PACKAGES = ("pcil", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "dm-control", "mujoco")


@dataclass(frozen=True)
class Result:
    """A finished run."""

    folder: Path
    final_return: float
    """Mean return of the last evaluation."""
    demos_return: float | None
    """Mean return of the demonstrations; None without demonstrations or without their rewards."""
    own_modules: tuple[str, ...] = ()
    """The modules of an agent and a reward that are not part of this package."""

    @property
    def policy(self) -> Policy:
        """The trained policy."""
        return load_policy(self.folder, self.own_modules)


def train(
    task: Any,
    *,
    out: Any,
    method: Any = "pcil",
    preset: Any = "default",
    demos: Any = None,
    callbacks: Any = (),
    **changes: Any,
) -> Result:
    """Train a policy in the folder `out`, or resume the run that is there.

    `task` is a task's name, a function that makes a new environment at each call, or an environment, which is then the run's
    single one and is not closed. `demos` are `Demonstrations`, or the name or path of some. `callbacks` are told how the run
    goes, and may stop it. `changes` are fields of `Run` (`seed=1`, `frames=200_000`).

    Raises `InputError` where something given is wrong, `RunError` where the environment fails or training diverges, and
    `loop.Stopped` where a callback asks to stop. The first Ctrl-C ends the run after the episode at hand and saves it before
    `KeyboardInterrupt` is raised; a second one raises it at once.
    """
    if not isinstance(out, (str, os.PathLike)):
        raise InputError(f"out is {brief(out)}; it must be the path of a folder.")
    if demos is not None and not isinstance(demos, (str, os.PathLike, Demonstrations)):
        raise InputError(
            f"demos is {brief(demos)}; it must be a shipped task, the path or id of a Minari dataset, or pcil.Demonstrations."
        )
    if not isinstance(callbacks, Sequence) or not all(isinstance(callback, Callback) for callback in callbacks):
        raise InputError(f"callbacks is {brief(callbacks)}; it must be a list of objects of subclasses of pcil.Callback.")
    given = demos if isinstance(demos, Demonstrations) else None
    named = brief(demos) if isinstance(demos, Demonstrations) else demos and os.fspath(demos)
    changes = {name: value for name, value in {**changes, "demos": named}.items() if value is not None}
    if isinstance(task, gymnasium.Env):
        changes["single_environment"] = True
    run = presets.make(envs.task_name(task), method, preset, **changes)
    with progress.Signals(lambda: None, ["SIGINT"]) as signals:
        try:
            result = execute(run, Path(out), [*callbacks, _StopOn(signals)], task=task, given=given)
        except loop.Stopped:
            if signals.number is None:
                raise
            raise KeyboardInterrupt from None
    if signals.number is not None:
        raise KeyboardInterrupt
    return result


class _StopOn(Callback):
    """Stops the run after a signal."""

    def __init__(self, signals: progress.Signals) -> None:
        self._signals = signals

    def stop(self) -> bool:
        return self._signals.number is not None


def execute(
    run: Run, folder: Path, callbacks: Sequence[Callback] = (), *, task: Any = None, given: Demonstrations | None = None
) -> Result:
    """Start or resume exactly this run in `folder`, or go on with a finished one that is given more frames or no `until` any
    longer; a folder with another run is refused with the difference.

    `task` and `given` stand in for what `run.task` and `run.demos` name. What an environment raises goes to `error.txt`.
    """
    compilation.use_cache()
    folder, say = files.expanded(folder), Callbacks(callbacks).message
    run, demos, why = prepared(run, say, task=task, read=lambda source: given or read_demonstrations(source))
    with _claimed(folder), files.room_for(f"The run in {folder}"), _withdrawn_if_refused(folder):
        before = _before(run, folder, demos)
        if (folder / "DONE").exists() and (why_not := state.unfinished(folder, run, read_done(folder))):
            say(why_not)
            (folder / "DONE").unlink()
        _describe(folder, run, demos, before, say)
        if not (folder / "DONE").exists():
            say(f"Absorbing state: {'on' if run.agent.absorbing else 'off'}; {why}.")
            (folder / "error.txt").unlink(missing_ok=True)
            with _traceback_kept(folder / "error.txt"):
                episodes, paid = (demos.episodes, demos.return_mean) if demos else ((), None)
                ended = loop.train_loop(run, folder, episodes, callbacks, task=task, demos_return=paid)
                final = ended.counters.final_return
            files.write_text(folder / "DONE", json.dumps({"final_return": final}) + "\n")
        return Result(folder, read_done(folder), demos.return_mean if demos else None, run.own_modules)


@contextlib.contextmanager
def _traceback_kept(path: Path) -> Iterator[None]:
    """Where an environment raises, its traceback goes to a file that the error names."""
    try:
        yield
    except RunError as error:
        if error.__cause__ is None:
            raise
        path.write_text("".join(traceback.format_exception(error.__cause__)))
        raise RunError(
            f"{str(error).removesuffix('.')}; its traceback is in {path}, and the same command goes on from the episode before."
        ) from error.__cause__


def read_done(folder: Path) -> float:
    """The final return of a finished run: the mean of its last evaluation."""
    try:
        return float(files.read_json(folder / "DONE")["final_return"])
    except (OSError, ValueError, LookupError, TypeError, ArithmeticError) as error:
        raise InputError(
            f"{folder / 'DONE'} can't be read ({type(error).__name__}: {error}); delete it, and the same command ends the run."
        ) from error


def read_demonstrations(source: str) -> Demonstrations:
    """The demonstrations that `source` names, with actions that may be out of bounds: a run may clip them."""
    return Demonstrations.load(source, bounded=False)


def demonstrations(run: Run) -> Demonstrations | None:
    """What the run imitates, checked against its environment, or None where it needs no demonstrations."""
    return prepared(run)[1]


def prepared(
    run: Run,
    say: Callable[[str], None] = lambda text: None,
    *,
    task: Any = None,
    read: Callable[[str], Demonstrations] = read_demonstrations,
) -> tuple[Run, Demonstrations | None, str]:
    """The run with `agent.absorbing` and `agent.cloning` decided, its demonstrations as they fit, and why the absorbing state
    is on or off.

    `task` stands in for `run.task`; `read` gives the demonstrations by their name. `say` is told what a user should know.
    """
    with envs.opened(run.task if task is None else task, env_kwargs=run.env_kwargs) as environment:
        demos = _fitted(run, environment, say, read)
        if run.until is not None and not (demos and demos.return_mean and demos.return_mean > 0):
            found = f"their mean return is {demos.return_mean}" if demos else f"{run.method} needs none here"
            raise InputError(f"--until is a share of the demonstrations' mean return, which must be positive, but {found}.")
        run, why = fit.with_absorbing_decided(run, demos, envs.ends_early(environment))
        run = fit.with_cloning_decided(run, demos, say)
    return run, demos, why


def _fitted(
    run: Run, environment: envs.Checked, say: Callable[[str], None], read: Callable[[str], Demonstrations]
) -> Demonstrations | None:
    limit = environment.spec and environment.spec.max_episode_steps
    if limit and limit >= run.replay_steps:
        raise InputError(
            f"The replay has {run.replay_steps} rows, and an episode of {run.task} may take {limit + 1}; enlarge it."
        )
    if not run.needs_demos:
        return None
    source = run.task if run.demos is None else run.demos
    demos = fit.fitted(run, read(source).take(run.num_demos), environment, say)
    steps = max(run.reward.span if run.reward.batch_size else 1, run.agent.n_step if run.agent.offline else 1)
    if all(len(episode) < steps and not episode.terminated for episode in demos.episodes):
        raise InputError(
            f"The demonstrations of {run.task} are all shorter than the {steps} steps that an update draws in a row."
        )
    return demos


@contextlib.contextmanager
def _claimed(folder: Path) -> Iterator[None]:
    """The folder, created if necessary, locked for this process."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        strangers = sorted(path.name for path in folder.iterdir() if path.name != ".lock" and path.suffix != ".tmp")
        if strangers and "run.json" not in strangers:
            raise InputError(f"The folder {folder} holds something else ({strangers[0]}); give --out a new or empty folder.")
    except OSError as error:
        raise InputError(f"The folder {folder} can't be written ({error.strerror}); give --out another one.") from error
    with files.locked(folder / ".lock") as free:
        if not free:
            raise InputError(f"Another process is training in {folder}; wait for it or give --out another folder.")
        yield


def check(run: Run, folder: Path, read: Callable[[str], Demonstrations] = read_demonstrations, task: Any = None) -> None:
    """Raise `InputError` where this run can't be done in `folder`: its demonstrations don't fit, or another run is there.

    `read` and `task` are those of `prepared`.
    """
    run, demos, _ = prepared(run, read=read, task=task)
    _before(run, folder, demos)


def finished(folder: Path, run: Run) -> bool:
    """Whether `run` has nothing left to do in its folder, as far as `DONE` and `run.json` say; another run may be there."""
    if not (folder / "DONE").exists():
        return False
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        before = files.read_json(folder / "run.json")["run"]
        return before["frames"] >= run.frames and before.get("until") == run.until
    return True


def described(run: Run, demos: Demonstrations | None) -> dict[str, Any]:
    """What a `run.json` says of the run, as JSON gives it back."""
    about = demos and {"hash": demos.hash, "episodes": len(demos.episodes), "return_mean": demos.return_mean}
    return {"run": run.to_json(), "demos": about}


def _describe(
    folder: Path, run: Run, demos: Demonstrations | None, before: dict[str, Any] | None, say: Callable[[str], None]
) -> None:
    """Write `run.json`, or bring the settings up to date in the one that was there `before`."""
    description = described(run, demos)
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):  # DeepMind Control may be absent
            versions[name] = metadata.version(name)
    updated = differences(before.get("versions", {}), versions) if before else []
    if updated and not (folder / "DONE").exists():
        say(f"Versions changed since this run began, so it may not continue exactly: {'; '.join(updated)}.")
    now = {**before, **description} if before else {**description, "versions": versions, "commit": commit()}
    if not before or any(before["run"].get(name) != now["run"][name] for name in FREE):
        files.write_text(folder / "run.json", json.dumps(now, indent=2) + "\n")


def _before(run: Run, folder: Path, demos: Demonstrations | None) -> dict[str, Any] | None:
    """What the folder's `run.json` holds, None if there is none; `InputError` with the difference where that is another run.

    It is the same run with more frames, without its `until`, and with demonstrations that have moved.
    """
    if not (folder / "run.json").exists():
        return None
    description = described(run, demos)
    try:
        before = files.read_json(folder / "run.json")
        settings, about = _completed(before["run"], run), before["demos"] or {}
        found = differences(about, description["demos"] or {}, "demos.")
        same = {"demos": not found, "frames": settings.get("frames", 0) <= run.frames, "until": run.until is None}
        now = {name: value for name, value in flat(description["run"]).items() if not same.get(name)}
        found = differences({name: value for name, value in settings.items() if not same.get(name)}, now) + found
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"The folder {folder} holds a run.json that can't be read ({error}); give --out a new folder."
        ) from error
    if found:
        raise InputError(f"The folder {folder} holds another run: {'; '.join(found)}; use its settings or another --out.")
    return before


def _completed(settings: dict[str, Any], run: Run) -> dict[str, Any]:
    """The flat settings of a `run.json`, with those that it lacks; as they are where they make no run like this one."""
    classes = {f"{type(part).__module__}:{type(part).__qualname__}": type(part) for part in (run.agent, run.reward)}
    try:
        return flat(Run.from_json(settings, classes).to_json())
    except InputError:
        return renamed(flat(settings))


def commit(*more: Path) -> str | None:
    """The commit of the source tree that is running, with "+" where its files, or those of `more`, differ from it; None outside
    a repository."""
    here = Path(__file__).parent.parent

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if not git("ls-files", "__init__.py"):
            return None
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", ".", *map(str, more)) else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def provenance(folder: Path, policy: Policy, command: str) -> dict[str, Any]:
    """Where demonstrations recorded from a policy come from; the settings are those of its run, where they are known."""
    frames, seed = policy.info.get("frames"), policy.info.get("seed")
    path = folder / "run.json"
    try:
        trained = files.read_json(path) if path.exists() else {}
        known = {name: trained.get(name) for name in ("commit", "run", "versions")}
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path} can't be read ({error}), so nobody could say where the demonstrations are from.") from error
    return {
        "expert": f"{policy.info.get('method', 'policy')}, {frames} frames, seed {seed}",
        "command": command,
        "frames": frames,
        "seed": seed,
        **known,
    }


@contextlib.contextmanager
def _withdrawn_if_refused(folder: Path) -> Iterator[None]:
    """A run that is refused before its first step leaves no `run.json`, so its folder is free for another."""
    before = (folder / "run.json").exists()
    try:
        yield
    except BaseException:
        if not before and not (folder / LOGS[0]).exists():
            (folder / "run.json").unlink(missing_ok=True)
        raise
