"""The speed of each part compared with a lower bound, measured in one process on one thread (`pcil bench`).

The floor of an update is the time of its matrix products alone. They are taken from the jaxpr of the update, so both always
have the same products of the same shapes.
"""

from __future__ import annotations

import os

SINGLE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
KEYS = (
    "update_ms",
    "floor_ms",
    "agent_update_ms",
    "agent_floor_ms",
    "env_step_us",
    "physics_us",
    "act_us",
    "sample_us",
    "loop_update_share",
    "frames_per_second",
)


def use_one_thread() -> None:
    """Limit XLA and BLAS to one thread; this has an effect only before JAX is imported."""
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {SINGLE_THREAD}".strip()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"


def measure(task: str, preset: str, seconds: float) -> dict[str, float]:
    """Measure the values of `KEYS`. Parts alternate in short blocks, and a value is the median over its blocks."""
    use_one_thread()
    from pcil import compilation, envs, modules
    from pcil.bench.environment import measure_env
    from pcil.bench.parts import Setup, medians, time_loop
    from pcil.training import learner, presets

    compilation.start()
    environment = measure_env(task)
    modules.admit("The command", modules.of_task(task), None)
    with envs.opened(task) as env:
        spec = envs.spec(env)
    imitation, alone = (Setup(presets.make(task, method, preset), spec) for method in ("pcil", "expert"))
    parts = {"update_ms": imitation.update, "floor_ms": imitation.floor}
    parts |= {"agent_update_ms": alone.update, "agent_floor_ms": alone.floor}
    parts |= {"act_us": imitation.act, "sample_us": imitation.sample}
    figures = environment | medians(parts, seconds / 2)
    loop = time_loop(imitation.run, seconds / 2, [(learner, "update")])
    figures["loop_update_share"] = loop.inside["update"] / loop.seconds
    figures["frames_per_second"] = loop.frames / loop.seconds
    return {name: float(figures[name]) for name in KEYS}


def table(figures: dict[str, float]) -> str:
    """The measurements as plain text, with their ratios."""
    f = figures
    return "\n".join(
        [
            f"PCIL update      {f['update_ms']:8.2f} ms   its matrix products alone {f['floor_ms']:8.2f} ms   "
            f"ratio {f['update_ms'] / f['floor_ms']:.2f}",
            f"agent's update   {f['agent_update_ms']:8.2f} ms   its matrix products alone {f['agent_floor_ms']:8.2f} ms   "
            f"ratio {f['agent_update_ms'] / f['agent_floor_ms']:.2f}",
            f"environment step {f['env_step_us']:8.1f} us   the bare physics          {f['physics_us']:8.1f} us   "
            f"ratio {f['env_step_us'] / f['physics_us']:.2f}",
            f"acting           {f['act_us']:8.1f} us   a share of the environment step of {f['act_us'] / f['env_step_us']:.2f}",
            f"sampling         {f['sample_us']:8.1f} us   a share of the update of {f['sample_us'] / f['update_ms'] / 1e3:.3f}",
            f"the loop         {f['loop_update_share']:8.1%} of its time in the update, {f['frames_per_second']:,.0f} frames/s",
        ]
    )
