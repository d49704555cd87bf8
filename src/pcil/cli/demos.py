"""`pcil demos`."""

import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from pcil.cli import arguments
from pcil.cli.arguments import Json
from pcil.errors import InputError, shown
from pcil.files import expanded, room_for
from pcil.modules import Trust


def demos(
    path: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DEMOS]")] = None,
    env: str | None = None,
    env_kwargs: str = "{}",
    score: Path | None = None,
    plot: Path | None = None,
    film: Path | None = None,
    film_episodes: int = 1,
    trust: Trust = (),
    json_output: Json = False,
) -> int:
    """List the demonstrations that ship, or say what a dataset holds.

    Args:
        path: A shipped task, the folder of a Minari dataset, or the id of a local one; without it, what ships is listed.
        env: Also say what does not fit this task or Gymnasium id; --film shows the episodes in it.
        env_kwargs: Keyword arguments of that environment, in JSON.
        score: Also rank the episodes by the learned reward of this run, the worst first.
        plot: Also draw returns, observations and actions in this file (.png or .pdf).
        film: Also film episodes in this file (.gif or .mp4): the recorded actions, from the recorded seeds, by default in the
            environment of the dataset.
        film_episodes: The number of episodes that are filmed.
        trust: Modules that the run's files may name and whose code is then run, such as my.module.
        json_output: Print one JSON list, or one JSON object of a dataset, and nothing else.
    """
    from pcil.demos import Demonstrations
    from pcil.demos.inspect import lines, shipped, summary, table

    if path is None:
        if env or score or plot or film:
            raise InputError("--env, --score, --plot and --film are about one dataset; name it, as in pcil demos walker_walk.")
        print(json.dumps(shipped()) if json_output else "\n".join(table(shipped())))
        return 0
    arguments.within(1, 100, film_episodes=film_episodes)
    held = Demonstrations.load(path, bounded=False)
    about: dict[str, Any] = summary(held)
    told = lines(about)
    if env is not None:
        about["misfits"] = _misfits(held, env, env_kwargs)
        told += [f"misfit: {text}" for text in about["misfits"]] or [f"The demonstrations fit {env}."]
    if score is not None:
        from pcil.training.score import scores

        about["scores"] = scores(expanded(score), held, trust).tolist()
        told.append(f"learned reward per step, by the run in {score}, the worst first:")
        for i in sorted(range(about["episodes"]), key=lambda i: about["scores"][i]):
            paid = f"   return {held.returns[i]:.4g}" if held.has_rewards else ""
            told.append(f"  episode {i:<4}{about['scores'][i]:>10.4f}{paid}")
    if plot is not None:
        told.append(f"Picture: {_draw(held, expanded(plot))}")
    if film is not None:
        told += _film(held, expanded(film), env or held.task, env_kwargs, film_episodes)
    print(json.dumps(about) if json_output else "\n".join(map(shown, told)))
    return 0


def _misfits(held: Any, task: str, env_kwargs: str) -> list[str]:
    """What a run of PCIL on the task would say about the demonstrations, or why it would refuse them."""
    from pcil import envs, modules
    from pcil.errors import json_object
    from pcil.training import fit, presets

    run = presets.make(envs.task_name(task), demos=held.task, env_kwargs=json_object("--env-kwargs", env_kwargs))
    modules.admit("--env", modules.of_task(run.task, run.env_kwargs), None)
    told: list[str] = []
    with envs.opened(run.task, env_kwargs=run.env_kwargs) as environment:
        try:
            fit.fitted(run, held, environment, told.append)
        except InputError as error:
            told.append(str(error))
    return told


def _film(held: Any, out: Path, task: str, env_kwargs: str, episodes: int) -> list[str]:
    """Film the first episodes, and say what came of it."""
    from pcil import envs, modules
    from pcil.errors import json_object
    from pcil.report import film

    film.check_name(out)
    if not held.has_actions:
        raise InputError("These demonstrations have no actions, so they can't be repeated for a film.")
    kwargs = json_object("--env-kwargs", env_kwargs) or held.origin.kwargs or {}
    kwargs = {} if envs.gymnasium_id(task).startswith("dmc/") else kwargs
    modules.admit("--env", modules.of_task(task, kwargs), None)
    told: list[str] = []
    with film.opened(task, kwargs) as env:
        some = held.episodes[:episodes]
        count = film.write(lambda every: film.replayed(some, env, task, every, told), env, out)
    return [*told, f"Film: {out}, {count} pictures of {len(some)} of {len(held.episodes)} episodes"]


def _draw(held: Any, path: Path) -> Path:
    try:
        from pcil.report.demos import draw
    except ImportError as error:
        raise InputError(f"A picture needs {error.name}, which pip install '.[report]' in a clone brings.") from error
    with room_for(f"Drawing {path}"):
        return draw(held, path)


def main(argv: list[str]) -> int:
    return arguments.call("demos", demos, argv)
