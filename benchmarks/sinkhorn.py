"""POT's and OTT's Sinkhorn solvers, in processor time on one thread: `python benchmarks/sinkhorn.py`.

OTT is not a dependency of this package: `pip install ott-jax==0.6.0`.
"""

from __future__ import annotations

import shared  # isort: skip
import functools
import importlib
import itertools
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import ot

from pcil import envs
from pcil.bench import parts
from pcil.demos import Demonstrations
from pcil.nets.transport import sinkhorn_plan
from pcil.rewards import sil
from pcil.training import learner, presets

ITERATIONS, PADDING, PROBLEMS, BLOCKS = 100, 20, 5, 7


def ott_plan(cost: Any, x_weight: Any, y_weight: Any, epsilon: float, *, log_domain: bool) -> Any:
    """OTT's plan in float32, with POT's number of iterations and stopping criterion."""
    names = "solvers.linear.sinkhorn", "problems.linear.linear_problem", "geometry.geometry"
    solvers, problems, geometries = (importlib.import_module(f"ott.{name}") for name in names)
    cost = jnp.where((x_weight > 0)[:, None] & (y_weight > 0)[None], cost, 0.0)
    options = {"threshold": 1e-9, "norm_error": 2, "inner_iterations": 10, "max_iterations": ITERATIONS}
    solver = solvers.Sinkhorn(lse_mode=log_domain, **options)
    geometry = geometries.Geometry(cost_matrix=cost, epsilon=epsilon)
    return solver(problems.LinearProblem(geometry, a=x_weight, b=y_weight)).matrix


def pot_log_plan(cost: Any, x_weight: Any, y_weight: Any, epsilon: float) -> np.ndarray:
    """POT's plan in float64 and the log domain, called from Python: the reference."""
    held = np.ix_(x_weight > 0, y_weight > 0)
    x, y = (np.asarray(weight, np.float64)[weight > 0] for weight in (x_weight, y_weight))
    options: dict[str, Any] = {"method": "sinkhorn_log", "numItermax": ITERATIONS, "stopThr": 1e-9, "warn": False}
    inside: Any = ot.sinkhorn(x / x.sum(), y / y.sum(), np.asarray(cost, np.float64)[held], epsilon, **options)
    plan = np.zeros(cost.shape)
    plan[held] = inside
    return plan


IN_JAX: dict[str, Callable[..., Any]] = {
    "POT (ours)": functools.partial(sinkhorn_plan, iterations=ITERATIONS),
    "OTT, log domain": functools.partial(ott_plan, log_domain=True),
    "OTT, kernel": functools.partial(ott_plan, log_domain=False),
}


def problem(size: int, seed: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cosine costs of random features and uniform weights; the last rows and columns are padding of weight 0."""
    rng = np.random.default_rng(seed)
    x, y = (rng.standard_normal((size, 30), dtype=np.float32) + np.float32(shift) for shift in (0, 0.5))
    weight = jnp.asarray((np.arange(size) < size - PADDING).astype(np.float32) / (size - PADDING))
    return sil.cosine_cost(jnp.asarray(x), jnp.asarray(y)), weight, weight


def compare(size: int, epsilon: float) -> None:
    """Print each solver's largest difference from the reference and its median time; the solvers take turns."""
    solvers = {name: jax.jit(solve, static_argnums=3) for name, solve in IN_JAX.items()} | {"POT, log domain": pot_log_plan}
    problems = [problem(size, seed) for seed in range(PROBLEMS)]
    plans = {name: [np.asarray(solve(*given, epsilon)) for given in problems] for name, solve in solvers.items()}
    times: dict[str, list[float]] = {name: [] for name in solvers}
    for _ in range(BLOCKS):
        for name, solve in solvers.items():
            block = shared.processor_ms(lambda solve=solve: [jax.block_until_ready(solve(*p, epsilon)) for p in problems], 1)
            times[name].append(block / PROBLEMS)
    for name, found in plans.items():
        difference = max(np.abs(plan - own).max() for plan, own in zip(found, plans["POT, log domain"], strict=True))
        shared.print_row(name, str(size), str(epsilon), f"{difference:.1e}", f"{statistics.median(times[name]):.1f}")


def start(name: str, method: str, folder: str) -> None:
    """Print the seconds of the first update, the first and a later label, with this solver and a folder for JAX's cache."""
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    sil.sinkhorn_plan = lambda cost, x_weight, y_weight, epsilon, _: IN_JAX[name](cost, x_weight, y_weight, epsilon)
    episode = Demonstrations.load("walker_walk").episodes[0]
    with envs.opened("walker_walk") as env:
        setup = parts.Setup(presets.make("walker_walk", method), envs.spec(env))

    def label() -> None:
        learner.label_episode(setup.run.learner, setup.state, episode, 0)

    times = shared.processor_ms(lambda: setup.update(1), 1), shared.processor_ms(label, 1), shared.processor_ms(label, 10)
    print(*(milliseconds / 1e3 for milliseconds in times))


def main() -> None:
    """Compare plans and times, then the start of a process with an empty and with a filled compilation cache."""
    shared.print_row("", "size", "epsilon", "difference", "ms a plan")
    for size in (128, 500):
        for epsilon in (0.01, 3e-3):
            compare(size, epsilon)
    shared.print_row("", "cache", "first update, s", "first label, s", "label, s")
    for method, name in itertools.product(("sil", "potil"), ("POT (ours)", "OTT, log domain")):
        with tempfile.TemporaryDirectory() as folder:
            for cache in ("empty", "filled"):
                command = [sys.executable, __file__, name, method, folder]
                printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
                shared.print_row(f"{method}, {name}", cache, *(f"{float(seconds):.2f}" for seconds in printed.split()))


if __name__ == "__main__":
    start(*sys.argv[1:]) if sys.argv[1:] else main()
