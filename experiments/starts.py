"""Evaluate the policies of finished runs on 100 starts each: python experiments/starts.py FOLDER ...

A run's own evaluations have ten episodes, so a start in a hundred that fails is mostly unseen. The rows go to
`results/starts.json`; those of other runs are kept, and a run that is there with the same frames and commit is not evaluated
again.
"""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path
from typing import Any

from pcil.cli import exit_code
from pcil.report import tables

ROWS = Path(__file__).parent.parent / "results" / "starts.json"
STARTS, SEED = 100, 1000
NAME = ("task", "method", "variant", "seed", "frames")


def main(*folders: str) -> None:
    """Evaluate what is new."""
    from collect import described, finished, variant  # with JAX, which the table does without

    rows = {tuple(row[name] for name in NAME): row for row in (json.loads(ROWS.read_text()) if ROWS.exists() else [])}
    for folder in finished(folders):
        about = described(folder)
        run, commit = about["run"], about["commit"]
        name = run["task"], run["method"], variant(run), run["seed"], run["frames"]
        if rows.get(name, {}).get("commit") != commit:
            rows[name] = dict(zip(NAME, name, strict=True)) | returns(folder, run["task"]) | {"commit": commit}
            print(
                *name, f"{rows[name]['mean']:.1f}, worst {rows[name]['worst']:.1f}, failing {rows[name]['failing']}", flush=True
            )
            lines = ",\n".join(json.dumps(rows[name]) for name in sorted(rows))
            ROWS.write_text(f"[\n{lines}\n]\n")


def returns(folder: Path, task: str) -> dict[str, Any]:
    """Mean and least return, and the number of starts that fail: that return less than half of the demonstrations' mean."""
    from pcil.demos import Demonstrations
    from pcil.policy import load_policy
    from pcil.training.evaluate import environments_for, evaluate

    expert = Demonstrations.load(task).return_mean
    assert expert is not None
    with environments_for(task, STARTS) as (_, made):
        found = evaluate(load_policy(folder), made, seed=SEED, episodes=STARTS).returns
    failing = int((found < expert / 2).sum())
    return {"mean": round(float(found.mean()), 2), "worst": round(float(found.min()), 2), "failing": failing, "expert": expert}


def table() -> tables.Table:
    """Shares of the demonstrations' return over 100 starts: mean and worst of each seed, averaged over seeds."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in json.loads(ROWS.read_text()):
        groups.setdefault((row["task"], row["method"], row["variant"], row["frames"]), []).append(row)
    rows = []
    for (task, method, named, frames), runs in groups.items():
        mean, worst = (statistics.fmean(run[name] / run["expert"] for run in runs) for name in ("mean", "worst"))
        failing = ", ".join(str(run["failing"]) for run in runs)
        rows.append((task, method, named, mean, worst, failing, len(runs), frames))
    return tables.Table(("task", "method", "variant", "mean", "worst", "failing starts of each seed", "seeds", "frames"), rows)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(*sys.argv[1:])))
