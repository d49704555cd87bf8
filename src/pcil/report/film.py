"""Short animations of policies, if the machine can render."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcil import envs, seeds
from pcil.envs.rollout import Rollout
from pcil.report.load import Collection, Track, named, quietly
from pcil.seeds import Stream
from pcil.training.evaluate import playable


def films(found: Collection, trust: Sequence[str] = (), track: Track = quietly) -> dict[str, bytes]:
    """Animations of the first seed of each task, method and variant, by title; one note covers those that can't be made."""
    first = {name[:3]: name for name in sorted(found.sources, reverse=True)}
    made: dict[str, bytes] = {}
    refused: list[str] = []
    for name in track(sorted(first.values()), "Animations"):
        try:
            made[f"{', '.join(name[:3])}, seed {name[3]}"] = film(found.sources[name].folder, trust)
        except Exception as error:  # OpenGL can raise anything where it does not work
            refused.append(named(found.sources[name].folder, error))
    if refused:
        found.notes.append(f"{len(refused)} of {len(first)} animations are left out: {refused[0]}")
    return made


def film(folder: Path, trust: Sequence[str] = (), steps: int = 160, every: int = 4) -> bytes:
    """An animated WebP of the first agent steps of an evaluation episode, with a frame after `every` steps.

    `trust` are the modules that the run's files may name.
    """
    from PIL import Image

    policy, env_kwargs = playable(folder, None, trust)
    with envs.opened(policy.task, render_mode="rgb_array", env_kwargs=env_kwargs) as env:
        policy.check_fits(env)
        rollout = Rollout(
            [env], [seeds.episode_seed(policy.info.get("seed", 0), Stream.EVALUATE, 0)], ["the filmed episode"], keep=False
        )
        frames = []
        while rollout.playing and rollout.lengths[0] < steps:
            if rollout.lengths[0] % every == 0:
                frames.append(Image.fromarray(np.asarray(env.render())))
            rollout.step([policy(rollout.obs[0])])
        milliseconds = round(1000 * every / env.unwrapped.metadata.get("render_fps", 30))
    file = io.BytesIO()
    frames[0].save(file, "WEBP", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, quality=50)
    return file.getvalue()
