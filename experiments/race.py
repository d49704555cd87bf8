"""Race PCIL against other libraries, each on one core: python experiments/race.py [--minutes 30] [--only NAME] [--tasks TASK]

Every competitor gets the same demonstrations, is evaluated on the same ten starts, and is measured in minutes of processor
time, with imports and compilation and without evaluations. Rows go to `results/race.csv`, with processor time as their seconds;
what is already there is not run again. `--costs` measures the time of an update and the installed size instead, into
`results/race-costs.json`. The peers run in `.race`, an environment of their own (`make race`).

Tables and figure are made of the rows alone, so JAX is imported only where something runs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt

from pcil.bench import SINGLE_THREAD
from pcil.report import figures, stats, tables
from pcil.report.load import Collection, EvalRow, by_variant, read_rows, sort_key, write_rows

ROOT = Path(__file__).parent.parent
PEERS, ROWS, COSTS = ROOT / "experiments" / "peers", ROOT / "results" / "race.csv", ROOT / "results" / "race-costs.json"
MINUTES = (1, 3, 10, 30)
TASKS = ("walker_walk", "cheetah_run", "finger_spin")
OURS = {"PCIL": "pcil", "DAC": "dac"}
COMPETITORS = {
    **dict.fromkeys(OURS, "race.py"),
    "eager PCIL": "peers/eager.py",
    **dict.fromkeys(("imitation BC", "imitation GAIL", "imitation AIRL", "SB3 SAC", "SB3 TD3"), "peers/peers.py"),
}
"""The script of each competitor; those of Stable-Baselines3 (SB3) are given the task's reward."""
SETTINGS = {"eager PCIL": "paper, T=1", **dict.fromkeys(("imitation BC", "imitation GAIL", "imitation AIRL"), "seals/Walker2d")}
"""The settings of those that do not have their library's defaults."""
PACKAGES = {"PCIL": ["pcil"], "imitation GAIL": ["imitation"], "SB3 SAC": ["stable-baselines3"], "eager PCIL": ["torch"]}


def main() -> int:
    """Run what is missing, a competitor at a time."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30, help="core-minutes of each competitor on each task")
    parser.add_argument("--only", nargs="*", default=list(COMPETITORS), choices=COMPETITORS, help="these competitors")
    parser.add_argument("--tasks", nargs="*", default=TASKS, help="these tasks")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--costs", action="store_true", help="measure an update, memory and size instead")
    parser.add_argument("--compete", action="store_true", help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.compete:
        return compete(json.load(sys.stdin))
    if words.costs:
        return remember(**measured_costs())
    for task in words.tasks:
        for name in words.only:
            rows = read_rows(ROWS) if ROWS.exists() else []
            before = [row for row in rows if (row.task, row.method, row.seed) == (task, name, words.seed)]
            if not before:
                write_rows(ROWS, sorted([*rows, *run(name, task, words.seed, words.minutes)], key=sort_key))
    return 0


def python(script: str) -> list[str]:
    """The command for a script, in the environment that it needs."""
    own = [] if script.startswith("peers/") else ["--compete"]
    return [sys.executable if own else str(ROOT / ".race" / "bin" / "python"), str(ROOT / "experiments" / script), *own]


def one_core() -> dict[str, str]:
    """The environment variables of a process that is to use one core; `.race` finds the package's environment in src."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    flags = {"XLA_FLAGS": SINGLE_THREAD}
    return {**os.environ, **one, **flags, "PYTHONPATH": str(ROOT / "src"), "MUJOCO_GL": "disabled", "CUDA_VISIBLE_DEVICES": ""}


def run(name: str, task: str, seed: int, minutes: float) -> list[EvalRow]:
    """The rows of one competitor; it prints each as it is measured."""
    from pcil.demos import Demonstrations
    from pcil.seeds import Stream, episode_seed
    from pcil.training.runs import commit

    demos = Demonstrations.load(task)
    with tempfile.TemporaryDirectory() as place:
        pairs: dict[str, Any] = {f"obs_{i}": episode.obs for i, episode in enumerate(demos.episodes)}
        pairs |= {f"action_{i}": episode.action for i, episode in enumerate(demos.episodes)}
        np.savez(Path(place) / "demos.npz", **pairs)
        starts = [episode_seed(seed, Stream.EVALUATE, i) for i in range(10)]
        request = {"competitor": name, "task": task, "seed": seed, "minutes": minutes, "starts": starts}
        request |= {"demos": f"{place}/demos.npz", "out": f"{place}/run"}
        errors, pipe = Path(place) / "errors.txt", subprocess.PIPE
        command, source = python(COMPETITORS[name]), commit(ROOT / "experiments") or ""
        with (
            errors.open("w") as said,
            subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=said, text=True, env=one_core(), cwd=place) as child,
        ):
            assert child.stdin and child.stdout
            child.stdin.write(json.dumps(request))
            child.stdin.close()
            rows, memory = [], 0
            for line in child.stdout:
                if not line.startswith("{"):
                    continue
                got = json.loads(line)
                returns, memory = got["returns"], got["memory_mb"]
                seen = got["frames"], statistics.fmean(returns), min(returns), max(returns), demos.return_mean
                variant = SETTINGS.get(name, "default")
                rows.append(EvalRow(task, name, variant, seed, *seen, source, round(got["seconds"], 1)))
                print(
                    f"{name:15} {task:12} {got['seconds'] / 60:6.2f} min {got['frames']:9,} frames  {rows[-1].return_mean:7.1f}"
                )
        if child.returncode:
            raise SystemExit(f"{name} on {task} ended with exit code {child.returncode}: {errors.read_text()[-2000:]}")
        remember(memory_mb={name: memory})
    return rows


def compete(request: dict[str, Any]) -> int:
    """Train one of our methods until its time is over."""
    from pcil.training.callbacks import Callback
    from pcil.training.loop import Stopped
    from pcil.training.runs import train

    class Shown(Callback):
        """Prints each evaluation with the processor time until it began, and stops the run when its time is over."""

        def __init__(self, seconds: float) -> None:
            self._limit, self._evaluating, self._before = seconds, 0.0, time.process_time()

        def episode(self, row: dict[str, Any]) -> None:
            self._before = time.process_time()

        def evaluation(self, frames: int, seconds: float, result: Any) -> None:
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            row = {"seconds": self._before - self._evaluating, "frames": frames, "returns": result.returns.tolist()}
            print(json.dumps(row | {"memory_mb": memory}), flush=True)
            self._evaluating += time.process_time() - self._before

        def stop(self) -> bool:
            return time.process_time() - self._evaluating > self._limit

    method, shown = OURS[request["competitor"]], Shown(60 * request["minutes"])
    settings = {"seed": request["seed"], "frames": 10_000_000, "evaluate_every": 5000, "checkpoint_seconds": 1e9}
    with contextlib.suppress(Stopped):
        train(request["task"], method=method, out=request["out"], callbacks=[shown], **settings)
    return 0


def measured_costs() -> dict[str, Any]:
    """The least of three medians of an update of the paper's sizes, in turns, and the size of each installation."""
    ours = "import json, pcil.bench.parts as p; from pcil import envs; from pcil.training import presets\n"
    ours += "run = presets.make('walker_walk', 'pcil', 'paper')\n"
    ours += "with envs.opened('walker_walk') as env: setup = p.Setup(run, envs.spec(env))\n"
    ours += "print(json.dumps(p.medians({'update_ms': setup.update}, seconds=10)))"
    race, size = str(ROOT / ".race" / "bin" / "python"), str(PEERS / "size.py")
    updates = {"PCIL": [sys.executable, "-c", ours], "eager PCIL": [race, str(PEERS / "eager.py"), "--updates", "500"]}
    took = [{name: json.loads(_said(words))["update_ms"] for name, words in updates.items()} for _ in range(3)]
    sizes = {name: int(_said([sys.executable if name in OURS else race, size, *what])) for name, what in PACKAGES.items()}
    return {"update_ms": {name: round(min(each[name] for each in took), 2) for name in updates}, "installed_mb": sizes}


def remember(**costs: dict[str, float]) -> int:
    """Add to the file of costs."""
    known = json.loads(COSTS.read_text()) if COSTS.exists() else {}
    COSTS.write_text(
        json.dumps(known | {name: known.get(name, {}) | values for name, values in costs.items()}, indent=1) + "\n"
    )
    return 0


def table(found: Collection) -> tables.Table:
    """Returns of the competitors after so many minutes of one core, and the minutes to 90% of the demonstrations' return."""
    rows = []
    for (task, name, settings), runs in by_variant(found.rows).items():
        given = "the task's reward" if name.startswith("SB3") else "demonstrations"
        reached = [row.seconds for run in runs if (row := stats.first_reach(run, 0.9)) and row.seconds]
        soonest = statistics.median(reached) / 60 if len(reached) == len(runs) else None
        returns = [[_return_after(run, minutes) for run in runs] for minutes in MINUTES]
        cells = [None if None in each else np.mean(np.array(each, np.float64)) for each in returns]
        rows.append((task, name, settings, given, *cells, soonest, min(run[-1].frames for run in runs)))
    return tables.Table(
        ("task", "competitor", "settings", "learns from", *(f"{m} min" for m in MINUTES), "min to 90%", "frames"), rows
    )


def _return_after(run: list[EvalRow], minutes: float) -> float | None:
    """The return of the last evaluation until then, a tenth late at most; None if the run ended before."""
    until = [row.return_mean for row in run if (row.seconds or 0) <= 66 * minutes]
    return until[-1] if until and (run[-1].seconds or 0) >= 54 * minutes else None


def costs_table() -> tables.Table:
    """What the competitors cost: an update, memory at its highest, and what is installed."""
    known = json.loads(COSTS.read_text())
    names = [name for name in COMPETITORS if any(name in values for values in known.values())]
    rows = [(name, *(known.get(cost, {}).get(name) for cost in ("update_ms", "memory_mb", "installed_mb"))) for name in names]
    return tables.Table(("competitor", "update, ms", "peak memory, MB", "installed, MB"), rows)


def draw(found: Collection, path: Path) -> None:
    """Return against core-minutes, a panel for each task, without the evaluation before training."""
    names = [name for name in COMPETITORS if any(row.method == name for row in found.rows)]
    tasks = [task for task in TASKS if any(row.task == task for row in found.rows)]
    figure, axes = plt.subplots(1, len(tasks), figsize=(4.4 * len(tasks), 3.4), layout="constrained", squeeze=False)
    for axis, task in zip(axes[0], tasks, strict=True):
        for name in names:
            run = [row for row in found.rows if (row.task, row.method) == (task, name) and row.seconds]
            minutes, style = [(row.seconds or 0) / 60 for row in run], {"linestyle": ":" if name.startswith("SB3") else "-"}
            colour, bold = f"C{names.index(name)}", 2.5 if name == "PCIL" else 1.2
            axis.plot(minutes, [row.return_mean for row in run], label=name, color=colour, linewidth=bold, **style)
        axis.axhline(
            next(row.expert_return for row in found.rows if row.task == task), color="grey", linestyle="--", label="demos"
        )
        axis.set(
            title=task, xlabel="core-minutes", ylabel="return", xscale="log", ylim=(0, None), xticks=MINUTES, xlim=(0.25, None)
        )
        axis.set_xticklabels([str(minutes) for minutes in MINUTES])
        axis.minorticks_off()
        axis.spines[["top", "right"]].set_visible(False)
    figures.save(figure, path)


def _said(words: list[str]) -> str:
    return subprocess.run(words, env=one_core(), capture_output=True, text=True, check=True).stdout.strip().splitlines()[-1]


if __name__ == "__main__":
    sys.exit(main())
