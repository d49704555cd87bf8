"""`pcil evaluate`."""

import contextlib
import json
import math
import sys
from pathlib import Path

from pcil.cli import arguments
from pcil.cli.arguments import Json
from pcil.errors import InputError, shown
from pcil.modules import Trust
from pcil.training.config import EnvKwargs


def evaluate(
    folder: Path,
    /,
    episodes: int = 10,
    seed: int = 0,
    env: str | None = None,
    env_kwargs: EnvKwargs | None = None,
    noise: float = 0.0,
    single_environment: bool = False,
    trust: Trust = (),
    json_output: Json = False,
) -> int:
    """Roll out the policy of a run, without exploration.

    Args:
        folder: The folder of a run, one with policy.json and policy.safetensors, or a task whose expert ships.
        episodes: The number of episodes.
        seed: The seed of the initial states.
        env: Another environment than that of the training, with observations and actions of equal sizes.
        env_kwargs: Keyword arguments of the environment, in JSON; by default those of the training, or none with --env.
        noise: Standard deviation of Gaussian noise that is added to actions in [-1, 1], which are then clipped.
        single_environment: Run the episodes one after the other in one environment: slower, with the same results.
        trust: Modules that the policy's files may name and whose code is then run, such as my.module.
        json_output: Print one JSON object and nothing else.
    """
    from pcil import envs
    from pcil.training.evaluate import environments_for, playable
    from pcil.training.evaluate import evaluate as roll_out

    arguments.within(1, 100_000, episodes=episodes)
    arguments.within(0, 2**31 - 1, seed=seed)
    if not 0 <= noise < math.inf:
        raise InputError(f"--noise is {noise}; it must be at least 0.")
    policy, env_kwargs = playable(folder, env_kwargs, trust, env)
    task = envs.task_name(env or policy.task)
    copies = environments_for(task, episodes, env_kwargs, single=single_environment)
    with contextlib.redirect_stdout(sys.stderr), copies as (_, made):  # environments may print
        policy.check_fits(made[0])
        result = roll_out(policy, made, seed=seed, episodes=episodes, noise=noise)
    row = {"task": task, "episodes": episodes, "seed": seed, "return_mean": result.mean}
    row |= {"return_std": float(result.returns.std()), "return_min": float(result.returns.min())}
    row |= {"returns": result.returns.tolist()}
    row |= {"trained_on": policy.task} if env else {}
    row |= {"noise": noise} if noise else {}
    if result.success:
        row["success_rate"] = sum(result.success) / episodes
    if json_output:
        print(json.dumps(row))
    else:
        print(f"{shown(task)}: return {result.mean:.1f} +- {row['return_std']:.1f} over {episodes} episodes")
        if result.success:
            print(f"  success in {sum(result.success):.0f} of {episodes}")
        print("  " + "  ".join(f"{value:.1f}" for value in result.returns))
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("evaluate", evaluate, argv)
