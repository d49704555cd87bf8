"""Animations of policies and demonstrations, if the machine can render: short ones for reports, and those of the commands."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcil import envs, seeds
from pcil.envs import dmc
from pcil.envs.rollout import Rollout
from pcil.errors import InputError, brief
from pcil.report.load import Collection, Track, named, quietly
from pcil.seeds import Stream
from pcil.training.evaluate import playable
from pcil.types import Episode

if TYPE_CHECKING:
    from PIL.Image import Image

KINDS = (".gif", ".mp4")
"""What the name of a film may end in."""


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
    policy, env_kwargs = playable(folder, None, trust)
    with envs.opened(policy.task, render_mode="rgb_array", env_kwargs=env_kwargs) as env:
        policy.check_fits(env)
        start = seeds.episode_seed(policy.info.get("seed", 0), Stream.EVALUATE, 0)
        file = io.BytesIO()
        shown = pictures(policy, env, policy.task, [start], every)
        _save(itertools.islice(shown, -(-steps // every)), file, "WEBP", every / _rate(env))
    return file.getvalue()


@contextlib.contextmanager
def opened(
    task: str, env_kwargs: dict[str, Any], size: tuple[int, int] | None = None, camera: str | None = None
) -> Iterator[envs.Checked]:
    """The environment of a task with `render_mode` "rgb_array", without a display. A task of DeepMind Control draws pictures of
    `size` (width, height); `camera` is the argument `camera_id`, a name or a number. What it prints goes to standard error."""
    looks: dict[str, Any] = {} if camera is None else {"camera_id": int(camera) if camera.isdecimal() else camera}
    if envs.gymnasium_id(task).startswith("dmc/"):
        looks |= {"width": size[0], "height": size[1]} if size else {}
    elif not os.environ.get("MUJOCO_GL") and dmc.renderer() == "egl":
        os.environ["MUJOCO_GL"] = "egl"  # Gymnasium's own environments of MuJoCo would look for a display
    with contextlib.redirect_stdout(sys.stderr), envs.opened(task, "rgb_array", env_kwargs=env_kwargs | looks) as env:
        yield env


def write(
    images_every: Callable[[int], Iterator[Image]],
    env: envs.Checked,
    out: Path,
    *,
    fps: float | None = None,
    size: tuple[int, int] | None = None,
) -> int:
    """Write a film of what `images_every(N)` gives, a picture of `env` for every N-th agent step.

    The film shows real time, with about `fps` pictures a second, by default 25, or 10 in a GIF, at most one an agent step.
    Pictures that are not of `size` (width, height) are scaled. Returns the number of pictures. `InputError` if the environment
    gives no pictures; then there is no file.
    """
    from PIL.Image import Dither

    fps = (10.0 if out.suffix == ".gif" else 25.0) if fps is None else fps
    every, count = max(1, round(_rate(env) / fps)), 0

    def counted(images: Iterator[Image]) -> Iterator[Image]:
        nonlocal count
        for count, image in enumerate(images, start=1):  # noqa: B007
            image = image if size in (None, image.size) else image.resize(size)
            yield image.quantize(128, dither=Dither.NONE) if out.suffix == ".gif" else image  # smaller than dithered

    images = counted(images_every(every))
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{os.getpid()}.{out.name}")
    try:
        if out.suffix == ".gif":
            _save(images, partial, "GIF", every / _rate(env))
        else:
            _save_mp4(images, partial, _rate(env) / every)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return count


def check_name(out: Path) -> None:
    """`InputError` if a film can't be written under this name: because of its ending, or of a package that is missing."""
    if out.suffix not in KINDS or out.is_dir():
        raise InputError(f"The film can't be written to {out}; give a file whose name ends in {' or '.join(KINDS)}.")
    try:
        import PIL.Image  # noqa: F401

        if out.suffix == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        gif = "" if out.suffix == ".gif" else ", and a film whose name ends in .gif needs only Pillow"
        raise InputError(f"A film needs {error.name}, which pip install '.[film]' in a clone brings{gif}.") from error


def pictures(
    policy: Callable[[np.ndarray], np.ndarray],
    env: envs.Checked,
    task: str,
    starts: Sequence[int],
    every: int,
    returns: list[float] | None = None,
) -> Iterator[Image]:
    """A picture before each `every`-th agent step of an episode from each of the seeds; `returns` is given their returns."""
    for number, start in enumerate(starts, start=1):
        rollout = Rollout([env], [start], [f"filmed episode {number}"], keep=False)
        while rollout.playing:
            if rollout.lengths[0] % every == 0:
                yield _picture(env, task)
            rollout.step([policy(rollout.obs[0])])
        if returns is not None:
            returns.append(float(rollout.returns[0]))


def replayed(episodes: Sequence[Episode], env: envs.Checked, task: str, every: int, told: list[str]) -> Iterator[Image]:
    """Pictures of recorded episodes, whose actions are repeated from the seeds of their resets.

    Where the environment leaves the recorded states, as it may on another processor or with another version, the episode ends
    and `told` is given a sentence.
    """
    for number, episode in enumerate(episodes):
        if episode.seed is None:
            raise InputError(f"Episode {number} has no seed, so its first state can't be made again for a film.")
        rollout, length = Rollout([env], [episode.seed], [f"filmed episode {number}"], keep=False), len(episode)
        for step in range(length):
            if not np.allclose(rollout.obs[0], episode.obs[step], rtol=0.01, atol=0.01):
                told.append(
                    f"Episode {number} is filmed until step {step} of {length}, where {task} leaves the recorded states."
                )
                break
            if step % every == 0:
                yield _picture(env, task)
            if not rollout.playing:
                break
            rollout.step([episode.action[step]])


def _picture(env: envs.Checked, task: str) -> Image:
    from PIL import Image

    try:
        picture = env.render()
    except Exception as error:  # OpenGL can raise anything where it does not work
        why = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(".")
        raise InputError(
            f"The environment {task!r} can't be drawn ({why}); where it is MuJoCo's, pcil doctor says whether this machine can "
            "render, and MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses another renderer."
        ) from error
    array = np.asarray(picture)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
        raise InputError(
            f"The environment {task!r} gave {brief(picture)} as a picture; with render_mode='rgb_array' it must give an array "
            "[height, width, 3] of uint8."
        )
    return Image.fromarray(array)


def _rate(env: envs.Checked) -> float:
    """Agent steps in a second of the environment's time, as its metadata says; 30 where it does not."""
    rate = (env.unwrapped.metadata or {}).get("render_fps")
    return float(rate) if isinstance(rate, int | float) and rate > 0 else 30.0


def _save(images: Iterable[Image], file: Any, kind: str, seconds: float) -> None:
    """An animation with so many seconds for each picture, which is repeated for ever."""
    images = iter(images)
    first = next(images)
    options = {"quality": 50} if kind == "WEBP" else {}
    first.save(file, kind, save_all=True, append_images=images, duration=round(1000 * seconds), loop=0, **options)


def _save_mp4(images: Iterator[Image], file: Path, fps: float) -> None:
    """An H.264 film, by the ffmpeg of imageio-ffmpeg. Its own writer would fork this process, in which JAX has threads."""
    from imageio_ffmpeg import get_ffmpeg_exe

    first = next(images)
    width, height = (length - length % 2 for length in first.size)  # two by two pixels have one colour in H.264
    given = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -".split()
    wanted = ["-an", "-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [get_ffmpeg_exe(), "-loglevel", "error", "-y", *given, *wanted, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended, and says why
            for image in itertools.chain([first], images):
                process.stdin.write(np.asarray(image)[:height, :width].tobytes())
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        said = process.stderr.read().decode(errors="replace")
    if process.returncode:
        raise InputError(f"The film {file.name} can't be written (ffmpeg: {' '.join(said.split()) or process.returncode}).")
