"""Train, select and record the experts of experts.toml; run again, it resumes: python experiments/experts.py [TASK ...]"""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from pcil import demos, envs, runs
from pcil.errors import InputError
from pcil.policy import load_policy
from pcil.report.load import read_run, write_points

HERE = Path(__file__).parent
RUNS = Path("runs/experts")
POLICIES = demos.SHIPPED.parent / "policies"
RESULTS = HERE.parent / "results" / "experts"
EPISODES = 10


def main(wanted: list[str]) -> None:
    """Every task of the file, or those that are wanted."""
    plan = tomllib.loads((HERE / "experts.toml").read_text())
    for task in wanted or plan:
        if task not in plan:
            raise InputError(f"experts.toml has no {task}; it has {', '.join(plan)}.")
        settings = dict(plan[task])
        how = {name: settings.pop(name) for name in ("wanted", "tries")}
        ship(task, seed=settings.pop("record_seed", 0), **how, folder=best(task, settings))


def best(task: str, settings: dict[str, Any]) -> Path:
    """The run folder of the seed with the highest final return; whatever is not finished is trained first."""
    seeds = settings.pop("seeds")
    del settings["reason"]
    options = [word for name, value in settings.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    finished = {}
    for seed in seeds:
        folder = RUNS / f"{task}-{seed}"
        command = ["train", task, "--method", "expert", "--seed", str(seed), *options, "--out", str(folder)]
        subprocess.run([sys.executable, "-m", "pcil", *command], check=True)
        finished[folder] = runs.read_done(folder)
    return max(finished, key=lambda folder: finished[folder])


def ship(task: str, *, folder: Path, wanted: float, tries: int, seed: int) -> None:
    """Ten deterministic episodes and the policy into the package, in place of what was there, and its curve into results."""
    policy = load_policy(folder)
    command = f"python experiments/experts.py {task}"
    info = runs.provenance(folder, policy, command) | {"seeds_tried": tries}
    recorded = demos.record(policy, envs.make(task), EPISODES, task=task, seed=seed, info=info)
    if recorded.return_mean < wanted:
        recorded.info["expert"] += f"; below the wanted {wanted}"
    target = demos.SHIPPED / "dmc" / task / "expert-v0"
    fresh = target.with_name("fresh")
    recorded.save(fresh, dataset_id=f"dmc/{task}/expert-v0")
    shutil.rmtree(target, ignore_errors=True)
    fresh.rename(target)
    dataclasses.replace(policy, info=policy.info | info).save(POLICIES / task)
    write_points(RESULTS / f"{task}.csv", read_run(folder))
    print(f"{task}: {recorded.return_mean:.1f} +- {recorded.return_std:.1f} from {folder}")


if __name__ == "__main__":
    main(sys.argv[1:])
