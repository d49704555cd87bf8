"""`pcil record`."""

import json
from pathlib import Path
from typing import Any

from pcil.cli import arguments
from pcil.errors import shown
from pcil.modules import Trust
from pcil.training.config import EnvKwargs


def record(
    folder: Path,
    /,
    out: Path,
    episodes: int = 10,
    seed: int = 0,
    minimum_return: float | None = None,
    env_kwargs: EnvKwargs | None = None,
    trust: Trust = (),
) -> int:
    """Record demonstrations from a trained policy, as a Minari dataset.

    Args:
        folder: The folder of a run, one with policy.json and policy.safetensors, or a task whose expert ships.
        out: The dataset's folder; it must not exist.
        episodes: The number of episodes.
        seed: The seed of the initial states.
        minimum_return: Keep only episodes with at least this return.
        env_kwargs: Keyword arguments of the environment, as a JSON object; by default those of the training.
        trust: Modules that the policy's files may name and whose code is then run, such as my.module.
    """
    from pcil import demos, envs
    from pcil.training import evaluate, runs

    arguments.within(1, 100_000, episodes=episodes)
    arguments.within(0, 2**31 - 1, seed=seed)
    demos.free_folder(out)
    policy, played = evaluate.playable(folder, env_kwargs, trust)
    least = "" if minimum_return is None else f" --minimum-return {minimum_return:g}"
    least += "" if env_kwargs is None else f" --env-kwargs '{json.dumps(env_kwargs)}'"
    least += f" --trust {' '.join(trust)}" if trust else ""
    info = runs.provenance(folder, policy, f"pcil record {folder} --episodes {episodes} --seed {seed}{least} --out {out}")
    asked: Any = {"task": policy.task, "seed": seed, "minimum_return": minimum_return, "info": info}
    with envs.opened(policy.task, env_kwargs=played) as env:
        policy.check_fits(env)
        recorded = demos.record(policy, env, episodes, **asked)
    path = recorded.save(out)
    returns = f"{recorded.return_mean:.1f} +- {recorded.return_std:.1f}"
    print(f"{episodes} episodes of {shown(policy.task)}, return {returns}: {shown(str(path))}")
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("record", record, argv)
