"""`pcil film`."""

from pathlib import Path

from pcil.cli import arguments
from pcil.errors import InputError, shown
from pcil.modules import Trust
from pcil.training.config import EnvKwargs


def film(
    folder: Path,
    /,
    out: Path,
    episodes: int = 1,
    seed: int = 0,
    fps: float | None = None,
    size: tuple[int, int] | None = None,
    camera: str | None = None,
    env_kwargs: EnvKwargs | None = None,
    trust: Trust = (),
) -> int:
    """Film a trained policy, without a window or a display.

    The environment must give pictures with render_mode="rgb_array". Tasks of MuJoCo are drawn by the renderer that MUJOCO_GL
    names (egl, osmesa, glfw), by default by EGL where it is installed.

    Args:
        folder: The folder of a run, one with policy.json and policy.safetensors, or a task whose expert ships.
        out: The film; its name ends in .gif or .mp4.
        episodes: The number of episodes, one after the other.
        seed: The seed of the initial states; these are the episodes of pcil evaluate with this seed.
        fps: Pictures per second, at most one for each step; by default 25, or 10 in a GIF. The film shows real time.
        size: Width and height in pixels; by default those of the environment.
        camera: Name or number of the camera, for tasks of DeepMind Control and others that take the argument camera_id.
        env_kwargs: Keyword arguments of the environment, in JSON; by default those of the training.
        trust: Modules that the policy's files may name and whose code is then run, such as my.module.
    """
    from pcil import seeds
    from pcil.report import film
    from pcil.seeds import Stream
    from pcil.training.evaluate import playable

    arguments.within(1, 100, episodes=episodes)
    arguments.within(0, 2**31 - 1, seed=seed)
    if fps is not None and not 0.1 <= fps <= 1000:
        raise InputError(f"--fps is {fps:g}; it must be from 0.1 to 1000.")
    for side in size or ():
        arguments.within(16, 4096, size=side)
    film.check_name(out)
    policy, played = playable(folder, env_kwargs, trust)
    starts, returns = [seeds.episode_seed(seed, Stream.EVALUATE, i) for i in range(episodes)], []
    with film.opened(policy.task, played, size, camera) as env:
        policy.check_fits(env)
        images = lambda every: film.pictures(policy, env, policy.task, starts, every, returns)  # noqa: E731
        count = film.write(images, env, out, fps=fps, size=size)
    paid = "  ".join(f"{value:.1f}" for value in returns)
    print(f"{shown(policy.task)}: {shown(str(out))}, {count} pictures, return {paid}")
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("film", film, argv)
