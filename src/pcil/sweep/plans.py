"""The runs of a sweep's file, each checked as `pcil train` does, and the state of each run as read from its folder."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pcil import envs, files, modules
from pcil.errors import InputError, brief, json_object
from pcil.report.load import read_evaluations
from pcil.training import presets, runs
from pcil.training.config import REGISTRIES, Run, renamed

PRODUCT: dict[str, Any] = {
    "tasks": ["walker_walk"],
    "methods": ["pcil"],
    "seeds": [1, 2],
    "preset": "default",
    "frames": 200_000,
    "settings": {},
    "variants": {"name": {}},
}
"""The valid keys of a product of runs with example values; for the file itself and for each of its [[runs]]."""
FILE = PRODUCT | {"cores": 1, "gpus": 0.5, "runs": [{}]}


@dataclass
class Job:
    """One run of a sweep, and its state."""

    name: str
    folder: Path
    run: Run
    trust: tuple[str, ...]
    """The user's modules that the run names."""
    log: Path
    """The file with the run's output."""
    state: str = "waiting"
    """waiting, running, done or failed."""
    frames: int = 0
    rate: float = 0.0
    """Frames per second."""
    last_return: float = 0.0
    """The mean return of the last evaluation."""
    deaths: int = 0
    """The number of times that its process was killed."""

    @property
    def argv(self) -> list[str]:
        """The arguments of `pcil train` that train this run."""
        trust = ["--trust", *self.trust] if self.trust else []
        return ["--settings", json.dumps(self.run.to_json()), "--out", str(self.folder), *trust]

    def look(self) -> None:
        """Update the state from the run's folder; files that are missing or incomplete are ignored."""
        if runs.finished(self.folder, self.run):
            self.state = "done"
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
            with files.open_regular(self.folder / "train.jsonl") as file:
                file.seek(max(file.seek(0, os.SEEK_END) - 10_000, 0))
                last = files.parse_json(file.read().split(b"\n")[-2])
            self.frames, self.rate = last["frames"], last["frames_per_second"]
            table = read_evaluations(self.folder)
            self.last_return = float(table["return"][table["frames"] == table["frames"][-1]].mean())


class Plan(NamedTuple):
    """The runs of a sweep, and the cores and GPUs of each."""

    jobs: list[Job]
    cores: int
    gpus: float | int


def read(file: Path, out: Path, trust: Sequence[str] = ()) -> Plan:
    """The runs of a file and their states, each checked as `pcil train` does. Nothing is written.

    `trust` are the modules that the file may name.
    """
    try:
        table = files.read_toml(file)
    except (OSError, ValueError) as error:
        raise InputError(f"{file} can't be read as TOML ({error}).") from error
    _check(str(file), table, FILE)
    return of_table(str(file), table, out, trust)


def of_table(source: str, table: dict[str, Any], out: Path, trust: Sequence[str] | None) -> Plan:
    """`read` for the content of a file. `trust` is None if the user typed it on the command line."""
    plan = Plan([], table.get("cores", 1), table.get("gpus", 0))
    if not (1 <= plan.cores <= 10_000 and 0 <= plan.gpus <= 10_000):
        given = f"{brief(plan.cores)} cores and {brief(plan.gpus)} GPUs"
        raise InputError(f"{source} gives a run {given}; it needs 1 to 10,000 cores and 0 to 10,000 GPUs.")
    read_once, taken = functools.cache(runs.read_demonstrations), set()
    with _Environment() as environment:
        for where, product in _products(source, table):
            for name, settings in _combinations(where, product):
                if name in taken:
                    raise InputError(f"{where} has the run {name} a second time; give one of them a name under variants.")
                taken.add(name)
                folder = out.absolute() / name
                try:
                    if isinstance(given := settings.get("env_kwargs"), str):
                        settings["env_kwargs"] = json_object("env_kwargs", given)
                    named = [("The task", modules.of_task(settings["task"], settings.get("env_kwargs")))]
                    named += [(f"--{part}", modules.of_class(settings.get(part), REGISTRIES[part])) for part in REGISTRIES]
                    for option, names in named:
                        modules.admit(option, names, trust)
                    run = presets.make(**settings)
                    run = dataclasses.replace(run, task=envs.task_name(run.task))
                    runs.check(run, folder, read_once, environment.of(run))
                except InputError as error:
                    raise InputError(f"{where}, {name}: {error}") from error
                own = tuple(dict.fromkeys(name for _, names in named for name in names))
                plan.jobs.append(Job(name, folder, run, own, folder.with_name(f"{folder.name}.log")))
                plan.jobs[-1].look()
    if not plan.jobs:
        raise InputError(f"{source} has no runs; give it tasks, methods and seeds, or [[runs]] with them.")
    return plan


class _Environment(contextlib.ExitStack):
    """The environment of one run after another: runs of the same one share it, and it is closed before another is made."""

    _whose: tuple[str, str] | None = None

    def of(self, run: Run) -> envs.Checked:
        """The environment of a run."""
        whose = run.task, json.dumps(run.env_kwargs)
        if whose != self._whose:
            self._whose = None
            self.close()
            self._environment = self.enter_context(envs.opened(run.task, env_kwargs=run.env_kwargs))
            self._whose = whose
        return self._environment


def _products(file: str, table: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The product at the top level of the file, if it has tasks, and its [[runs]], which inherit keys from the top level."""
    if "tasks" in table:
        yield file, table
    shared = {key: table[key] for key in PRODUCT if key in table and key != "variants"}
    for number, product in enumerate(table.get("runs", []), start=1):
        where = f"{file}, [[runs]] {number}"
        _check(where, product, PRODUCT)
        yield where, {**shared, **product, "settings": _flat(shared.get("settings", {})) | _flat(product.get("settings", {}))}


def _combinations(where: str, product: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The name and the settings of each run: variants x methods x tasks x seeds. A variant may set its own method instead."""

    def axis(key: str) -> list[Any]:
        if not product.get(key):
            raise InputError(f"{where} gives no {key}.")
        return product[key]

    base = {key: product[key] for key in ("preset", "frames") if key in product} | _flat(product.get("settings", {}))
    for variant, changes in (product.get("variants") or {"": {}}).items():
        settings = base | _flat(changes)
        for key in {"task", "seed", "out", "help"} & settings.keys():
            raise InputError(f"{where} has {key!r} among its settings; there are the lists tasks and seeds, and --out.")
        own = settings.get("reward", settings.get("method"))
        for method, task, seed in itertools.product([own] if own else axis("methods"), axis("tasks"), axis("seeds")):
            arm = variant if own and variant else f"{method}-{variant}" if variant else method
            name = "/".join(re.sub(r"[^\w-]+", "-", part) for part in (envs.task_name(task), arm, str(seed)))
            yield name, {"method": method if "reward" not in settings else "pcil", **settings, "task": task, "seed": seed}


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by their dotted field names. In TOML, a dotted name without quotes is a nested table, and names may have dashes
    as on the command line."""
    return renamed({name.replace("-", "_"): None if value == "None" else value for name, value in files.flat(settings).items()})


def _check(where: str, table: dict[str, Any], examples: dict[str, Any]) -> None:
    for key, value in table.items():
        if key not in examples:
            raise InputError(f"{where} has {key!r}, which means nothing here; it may have {', '.join(examples)}.")
        if not _alike(value, examples[key]):
            raise InputError(f"{where} has {key} = {value!r}; it must look like {examples[key]!r}.")


def _alike(value: Any, example: Any) -> bool:
    """Whether two TOML values and their elements have the same types; an integer is accepted as a float."""
    if type(value) is not type(example):
        return (type(value), type(example)) == (int, float)
    value, example = ([*v.values()] if isinstance(v, dict) else v for v in (value, example))
    return not isinstance(example, list) or not example or all(_alike(part, example[0]) for part in value)
