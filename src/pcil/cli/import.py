"""`pcil import`."""

from pathlib import Path
from typing import Annotated

import tyro

from pcil.cli import arguments
from pcil.errors import InputError, shown
from pcil.files import expanded, room_for


def import_(
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE ...", help_behavior_hint="")],
    out: Path,
    task: str | None = None,
    obs_keys: tuple[str, ...] = (),
    action_keys: tuple[str, ...] = (),
    reward_key: str | None = None,
    episode_key: str | None = None,
    action_bounds: tuple[float, float] | None = None,
    clip_actions: Annotated[bool, tyro.conf.FlagConversionOff] = False,
    time_step: float | None = None,
    minimum_return: float | None = None,
    best: int | None = None,
    choose: int | None = None,
    seed: int = 0,
) -> int:
    """Make a dataset of demonstrations from other files: NumPy, CSV, D4RL, robomimic, LeRobot or Minari.

    Args:
        sources: Files, folders of files with an episode each, or datasets; several become one dataset.
        out: The folder of the new dataset, in Minari's format.
        task: The name of the task, or the Gymnasium id of the environment.
        obs_keys: The columns that are the observation, in this order; by default they are found by their names.
        action_keys: The columns that are the action.
        reward_key: The column that is the reward.
        episode_key: The column with the number of the episode.
        action_bounds: The bounds of the environment's own actions; by default those that the source says, or -1 and 1.
        clip_actions: Clip actions that are out of these bounds.
        time_step: The seconds that a step takes, if the source does not say.
        minimum_return: Leave out episodes of a lower return.
        best: Keep the episodes of the highest returns, this many.
        choose: Keep a random choice of episodes, this many.
        seed: The seed of the random choice.
    """
    from pcil.demos import importers
    from pcil.demos.importers.tables import Keys

    if time_step is not None and not 0 < time_step < 1e6:
        raise InputError(f"--time-step is {time_step}; it must be a positive number of seconds.")
    keys = Keys(obs_keys, action_keys, reward_key, episode_key)
    found = importers.load(
        [expanded(source) for source in sources],
        keys,
        task=task,
        bounds=action_bounds,
        clip=clip_actions,
        step_seconds=time_step,
    )
    demos = found.demos
    demos = demos if minimum_return is None else demos.at_least(minimum_return)
    demos = demos if best is None else demos.best(best)
    demos = demos if choose is None else demos.choose(choose, seed)
    with room_for(f"The dataset in {out}"):
        path = demos.save(expanded(out))
    kept = f" ({len(demos.episodes)} of {len(found.demos.episodes)} episodes)" if demos is not found.demos else ""
    print("\n".join(map(shown, [*found.told, f"Dataset: {path}{kept}; pcil demos {path} says more."])))
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("import", import_, argv)
