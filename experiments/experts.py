"""Train, select and record the experts of experts.toml; repeated, it resumes: python experiments/experts.py [TASK ...]

With --record before the tasks nothing is trained: the included policies are recorded again. Included demonstrations that still
satisfy the rule of experts.toml keep their episodes; only their metadata are updated. What is not included in the package
(`include = false`) is written below runs/experts/demos.
"""

from __future__ import annotations

import dataclasses
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

from pcil import cli, demos, envs
from pcil.card import card
from pcil.errors import InputError
from pcil.policy import Policy, load_policy
from pcil.report.load import read_run, write_rows
from pcil.training import runs

HERE = Path(__file__).parent
RUNS = Path("runs/experts")
POLICIES = demos.SHIPPED.parent / "policies"
RESULTS = HERE.parent / "results" / "experts"
EPISODES = 10
MINIMUM_RETURN = 100.0
"""Episodes with a smaller return are not included; the authors' release keeps those above 100."""


def main(wanted: list[str]) -> None:
    """Process every task of the file, or the given ones."""
    plan = tomllib.loads((HERE / "experts.toml").read_text())
    again = "--record" in wanted
    for task in [word for word in wanted if word != "--record"] or plan:
        if task not in plan:
            raise InputError(f"experts.toml has no {task}; it has {', '.join(plan)}.")
        settings = dict(plan[task])
        how = {name: settings.pop(name) for name in ("wanted", "tries")} | {"include": settings.pop("include", True)}
        how |= {"seed": settings.pop("record_seed", 0), "minimum_return": settings.pop("minimum_return", MINIMUM_RETURN)}
        if again:
            record_again(task, how["seed"], how["minimum_return"])
        else:
            ship(task, **how, folder=best(task, settings))


def best(task: str, settings: dict[str, Any]) -> Path:
    """The run folder of the seed with the highest final return; unfinished runs are trained first."""
    seeds = settings.pop("seeds")
    del settings["reason"]
    options = [word for name, value in settings.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    finished = {}
    for seed in seeds:
        folder = RUNS / f"{task}-{seed}"
        words = f"train {task} --method expert --preset reward-only --seed {seed}".split()
        if code := cli.main([*words, *options, "--out", str(folder)]):
            sys.exit(code)
        finished[folder] = runs.read_done(folder)
    return max(finished, key=lambda folder: finished[folder])


def record(task: str, policy: Policy, seed: int, minimum_return: float, info: dict[str, Any]) -> demos.Demonstrations:
    """Record ten deterministic episodes that satisfy the rule."""
    env = envs.make(task)
    return demos.record(policy, env, EPISODES, task=task, seed=seed, minimum_return=minimum_return, info=info)


def place(task: str, recorded: demos.Demonstrations, root: Path = demos.SHIPPED) -> None:
    """Save the recorded dataset below a Minari root. If it has the episodes that are there, only their metadata change."""
    suite = "dmc" if envs.gymnasium_id(task).startswith("dmc/") else "gymnasium"
    name = f"{suite}/{task}/expert-v0"
    target, fresh = root / name, root / suite / task / "fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    recorded.save(fresh, dataset_id=name)
    if target.exists() and demos.Demonstrations.load(target).hash == recorded.hash:
        shutil.copy(fresh / "data" / "metadata.json", target / "data" / "metadata.json")
        shutil.rmtree(fresh)
    else:
        shutil.rmtree(target, ignore_errors=True)
        fresh.rename(target)


def record_again(task: str, seed: int, minimum_return: float) -> None:
    """Record the included policy again; the information about its training is kept."""
    shipped = demos.Demonstrations.load(task)
    info = {key: value for key, value in shipped.info.items() if not key.startswith("record_")}
    info["record_command"] = f"python experiments/experts.py --record {task}"
    recorded = record(task, load_policy(POLICIES / task), seed, minimum_return, info)
    said = f"{recorded.return_mean:.1f} +- {recorded.return_std:.1f}, least {recorded.returns.min():.1f}"
    least, same = shipped.returns.min(), recorded.hash == shipped.hash
    if not same and least >= minimum_return:
        print(f"{task}: {said}, not the included arrays, which satisfy the rule ({least:.1f}) and are kept")
        return
    place(task, recorded)
    replaced = f"replacing the old ones ({shipped.return_mean:.1f}, least {least:.1f})"
    print(f"{task}: {said}, {'the same arrays as the included ones' if same else replaced}")


def ship(task: str, *, folder: Path, wanted: float, tries: int, include: bool, seed: int, minimum_return: float) -> None:
    """Put ten deterministic episodes and the policy into the package, replacing the old ones, and the curve into results.

    Without `include`, the episodes are written below `RUNS` instead, and the policy stays in its run.
    """
    policy = load_policy(folder)
    command = f"python experiments/experts.py {task}"
    info = runs.provenance(folder, policy, command) | {"seeds_tried": tries}
    recorded = record(task, policy, seed, minimum_return, info)
    if recorded.returns.mean() < wanted:
        recorded.info["expert"] += f"; below the wanted {wanted}"
    place(task, recorded, demos.SHIPPED if include else RUNS / "demos")
    if include:
        info = policy.info | info
        dataclasses.replace(policy, info=info).save(POLICIES / task)
        (POLICIES / task / "README.md").write_text(card(task, info, "mit", task))
    write_rows(RESULTS / f"{task}.csv", read_run(folder))
    print(f"{task}: {recorded.return_mean:.1f} +- {recorded.return_std:.1f} from {folder}")


if __name__ == "__main__":
    sys.exit(cli.exit_code(lambda: main(sys.argv[1:])))
