"""Run folders with chosen numbers, which hold only the files that a report reads."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MINUTES_EACH = 0.5
"""Wall-clock time between two evaluations of a fake run."""


def fake_run(
    folder: Path,
    returns: Sequence[float] | Mapping[int, float],
    task: str = "walker_run",
    method: str = "pcil",
    seed: int = 1,
    *,
    expert: float | None = 800.0,
    correlation: Sequence[float] = (),
    done: bool = True,
    **settings: Any,
) -> Path:
    """A run whose evaluations, every 1000 frames, have these mean returns, with one episode 10 below and one 10 above the mean.

    One training episode ends at each evaluation except the first, and has the next of the given correlations.
    """
    table = returns if isinstance(returns, Mapping) else {1000 * i: value for i, value in enumerate(returns)}
    folder.mkdir(parents=True, exist_ok=True)
    run = {"task": task, "method": method, "preset": "default", "seed": seed, "frames": 5000, "agent": {"gamma": 0.99}}
    demos = None if expert is None else {"return_mean": expert, "episodes": 10, "hash": "f00"}
    about = {"run": run | settings, "demos": demos, "commit": "0123456789abcdef"}
    (folder / "run.json").write_text(json.dumps(about))
    rows = ["frames,episode,return,length,seconds"]
    for i, (frames, value) in enumerate(table.items()):
        rows += [f"{frames},{k},{value + move!r},500,{60 * MINUTES_EACH * i!r}" for k, move in enumerate((-10.0, 10.0))]
    (folder / "eval.csv").write_text("\n".join(rows) + "\n")
    lines = [{"frames": f, "return": 0.0, "correlation": c} for f, c in zip(list(table)[1:], correlation, strict=False)]
    (folder / "train.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if done:
        (folder / "DONE").write_text('{"final_return": 0.0}\n')
    return folder


def fake_sweep(root: Path) -> Path:
    """PCIL and DAC on two tasks with three seeds each; PCIL ends at 100, 200, 300 and 700, 800, 900, DAC at half of these."""
    for task, expert, finals in (("hopper_stand", 400.0, (100.0, 200.0, 300.0)), ("walker_run", 1000.0, (700.0, 800.0, 900.0))):
        for method, share in (("pcil", 1.0), ("dac", 0.5)):
            for seed, final in enumerate(finals, 1):
                folder = root / task / f"{method}-{seed}"
                returns = [0.0, 0.5 * share * final, share * final]
                fake_run(folder, returns, task, method, seed, expert=expert, correlation=[0.2 * share, 0.4 * share + seed / 10])
    return root
