"""`pcil play`."""

import contextlib
import sys
from pathlib import Path

from pcil.cli import arguments
from pcil.errors import shown
from pcil.modules import Trust
from pcil.training.config import EnvKwargs


def play(folder: Path, /, episodes: int = 10, seed: int = 0, env_kwargs: EnvKwargs | None = None, trust: Trust = ()) -> int:
    """Show a trained policy in a window.

    Tasks of DeepMind Control open MuJoCo's viewer, whose camera the mouse moves; other environments open their own window
    (render_mode="human"). Closing MuJoCo's window or Ctrl-C ends it. Where there is no display, pcil film makes a film.

    Args:
        folder: The folder of a run, one with policy.json and policy.safetensors, or a task whose expert ships.
        episodes: The number of episodes, one after the other.
        seed: The seed of the initial states; these are the episodes of pcil evaluate with this seed.
        env_kwargs: Keyword arguments of the environment, in JSON; by default those of the training.
        trust: Modules that the policy's files may name and whose code is then run, such as my.module.
    """
    from pcil import seeds
    from pcil.envs import window
    from pcil.envs.rollout import Rollout
    from pcil.training.evaluate import playable

    arguments.within(1, 100_000, episodes=episodes)
    arguments.within(0, 2**31 - 1, seed=seed)
    policy, played = playable(folder, env_kwargs, trust)
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr), window.opened(policy.task, played) as (env, refresh):  # it may print
        policy.check_fits(env)
        for number in range(episodes):
            start = seeds.episode_seed(seed, seeds.Stream.EVALUATE, number)
            rollout = Rollout([env], [start], [f"shown episode {number + 1}"], keep=False)
            while (open_still := refresh()) and rollout.playing:
                rollout.step([policy(rollout.obs[0])])
            if not open_still:
                break
            said = f"{shown(policy.task)}: episode {number + 1}, return {rollout.returns[0]:.1f}"
            print(said, file=out, flush=True)
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("play", play, argv)
