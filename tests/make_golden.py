"""Regenerate `golden.json` beside this file: numbers of five updates of every method, on narrow networks and synthetic data.

    .venv/bin/python tests/make_golden.py

Run it after a change that is meant to change numbers, and check the difference before committing it: `git diff --stat` shows
how many methods have changed.
"""

from __future__ import annotations

import os

if __name__ == "__main__":
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")  # as in the tests

import dataclasses
import importlib.metadata
import json
import platform
import re
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pcil.agents import BC, DrQV2
from pcil.compilation import use_cache
from pcil.rewards import REWARDS
from pcil.training import checkpoint, learner, presets
from pcil.training.config import Run
from pcil.training.state import start
from pcil.types import Episode, Spec
from small import POINT_MASS, narrow, small_run

GOLDEN = Path(__file__).with_name("golden.json")
COMMAND = "python tests/make_golden.py"
SPEC = Spec(2, 2, 1)
UPDATES = 5
LABELS = ("sampled", "stored")
"""A method that rewards whole episodes has only the second."""


def cases() -> dict[str, Run]:
    """Every method with every label setting that it allows, and settings that run other code."""
    found = {f"{method}, {label}": (method, {"label": label}) for method in presets.METHODS for label in LABELS}
    found = {name: case for name, case in found.items() if "stored" in name or not of_episodes(case[0])}
    runs = {name: small_run(method, **changes) for name, (method, changes) in found.items()}
    settings = {"penalty_every": 3, "stages": 2}
    runs["pcil-gail with stages and a lazy penalty, stored"] = small_run("pcil-gail", label="stored", reward=settings)
    runs["tcn with negatives of the rollout, sampled"] = small_run("tcn", reward={"negatives": "rollout", "margin": 5})
    for name, changes in (
        ("pcil with absorbing states, sampled", {"absorbing": True}),
        ("pcil with cloning, sampled", {"cloning": True}),
        ("expert with the paper's agent, sampled", {}),
    ):
        agent = narrow(presets.make(POINT_MASS, preset="default" if changes else "paper").agent, **changes)
        runs[name] = dataclasses.replace(small_run(name.split()[0]), agent=agent)
    return runs


def of_episodes(method: str) -> bool:
    return presets.make(POINT_MASS, method).reward.scope == "episode"


def episodes(seed: int, lengths: tuple[int, ...]) -> list[Episode]:
    """Random walks in the square with random actions and rewards; the first of them terminates."""
    rng = np.random.default_rng(seed)
    made = []
    for steps in lengths:
        walk = rng.uniform(-1, 1, (1, 2)) + np.cumsum(rng.normal(0, 0.1, (steps + 1, 2)), axis=0)
        action, reward = rng.uniform(-1, 1, (steps, 2)), rng.normal(0, 1, steps)
        made.append(Episode(walk.astype(np.float32), action.astype(np.float32), reward, not made))
    return made


def five_updates(run: Run) -> dict[str, Any]:
    """Metrics, and two sums of an episode's labels and of each part of the learned state.

    For the concatenated arrays of a part, these are `sum |x_i|` and `sum x_i cos(i)`, in which every entry has another weight.
    """
    state = start(run, SPEC, episodes(1, (30, 41, 25)))
    for episode in episodes(2, (37, 30, 45, 28)):
        kept = episode.absorbed(run.agent.n_step) if run.agent.absorbing else episode
        state.replay.add(kept, kept.reward)
    rng = np.random.default_rng(3)
    source = state.expert if run.agent.offline else state.replay
    assert source is not None and state.expert is not None
    rows, span = run.reward.batch_size, run.reward.span
    for _ in range(UPDATES if run.agent.clones else 0):
        window, cloned = source.sample(rng, run.agent.batch_size, 1), state.expert.sample(rng, run.agent.batch_size, 1)
        state.learner = learner.clone(run.learner, state.learner, window, cloned)
    for i in range(UPDATES):
        window = source.sample(rng, run.agent.batch_size, run.agent.n_step)
        expert = state.expert.sample(rng, rows, span) if rows else None
        seen = source.sample(rng, rows, span) if span > run.agent.n_step else None
        cloned = state.expert.sample(rng, run.agent.batch_size, 1) if run.agent.clones else None
        count, step = np.int32(i), np.int32(150 * i)
        state.learner, _ = learner.update(run.learner, state.learner, window, expert, seen, step, count, cloned)
    metrics = {
        name: float(total) / UPDATES for name, total in state.learner.totals.items() if name not in ("updates", "finite")
    }
    (last,) = episodes(4, (33,))
    last = last.absorbed(run.agent.n_step) if run.agent.absorbing else last
    labels = learner.label_episode(run.learner, learner.close_episode(run.learner, state.learner, last, 0), last, 0)

    parts: dict[str, list[np.ndarray]] = defaultdict(list, labels=[labels.astype(np.float64)])
    for path, array in checkpoint.flatten("", state.learner).items():
        if found := re.match(r"\.((?:agent|reward)\.\w+)", path):
            parts[found[1]].append(array.ravel().astype(np.float64))
    flat = {name: np.concatenate(arrays) for name, arrays in sorted(parts.items())}
    sums = {name: [float(np.abs(x).sum()), float(x @ np.cos(np.arange(len(x))))] for name, x in flat.items()}
    return {"metrics": metrics, "sums": sums}


def defaults() -> dict[str, Any]:
    """Every setting's default, by class, which older `run.json` files rely on (`pcil.training.config:Run.plain`)."""
    kinds = dict.fromkeys([DrQV2, BC, *REWARDS.values()])
    return {kind.__name__: dataclasses.asdict(kind()) for kind in kinds}


def made_by() -> dict[str, Any]:
    """The commit, versions and processor that produced the numbers, to explain a difference."""
    root = Path(__file__).parent.parent
    git = ["git", "-C", str(root)]
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain", "--", "src"], capture_output=True, text=True).stdout
    models = re.findall(r"model name\s*:\s*(.*)", info.read_text()) if (info := Path("/proc/cpuinfo")).exists() else []
    versions = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "equinox", "optax", "numpy", "pot")}
    return {
        "command": COMMAND,
        "commit": commit + "+" * bool(changed),
        "versions": {"python": platform.python_version(), **versions},
        "processor": (models or [platform.processor()])[0],
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def rounded(tree: Any) -> Any:
    """Round to eight digits, more than a float32 has."""
    if isinstance(tree, dict):
        return {name: rounded(value) for name, value in tree.items()}
    return [rounded(value) for value in tree] if isinstance(tree, list) else float(f"{tree:.8g}")


def main() -> None:
    use_cache()
    numbers = {name: rounded(five_updates(run)) for name, run in cases().items()}
    lines = [f"{json.dumps(name)}: {json.dumps(numbers[name])}" for name in numbers]
    settings = [f"{json.dumps(name)}: {json.dumps(values)}" for name, values in defaults().items()]
    text = '{"made by": ' + json.dumps(made_by()) + ',\n"cases": {\n' + ",\n".join(lines) + "\n},\n"
    text += '"defaults": {\n' + ",\n".join(settings) + "\n}}\n"
    GOLDEN.write_text(text)


if __name__ == "__main__":
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    main()
