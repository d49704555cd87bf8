"""The parts of a run that are timed, and the matrix products of an update. It loads JAX: call `use_one_thread` before."""

from __future__ import annotations

import contextlib
import functools
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from pcil.training import learner, loop, runs
from pcil.training.callbacks import Callback
from pcil.training.config import Run
from pcil.training.learner import on_host
from pcil.training.replay import Replay
from pcil.types import Batch, Episode, Spec

LARGE = 1024
"""Rows and columns of the product that measures a core's peak, `2 LARGE^3` FLOPs."""


class Setup:
    """The parts that are measured: a method's update, acting and sampling, on random data of a task's sizes."""

    def __init__(self, run: Run, spec: Spec) -> None:
        rng = np.random.default_rng(0)
        self.run, self.rng, self.count = run, rng, 0

        def normal(*shape: int) -> np.ndarray:
            return rng.standard_normal(shape, dtype=np.float32)

        self.replay = Replay(50_000, spec.obs_dim, spec.action_dim)
        for _ in range(50):
            reward = rng.uniform(size=500)
            self.replay.add(Episode(normal(501, spec.obs_dim), np.tanh(normal(500, spec.action_dim)), reward), reward)
        self.window = self.replay.sample(rng, run.agent.batch_size, run.agent.n_step)
        rows = run.reward.batch_size
        self.expert = self.replay.sample(rng, rows, run.reward.span) if rows else None
        self.cloned = self.replay.sample(rng, run.agent.batch_size, 1) if run.agent.clones else None
        demo = Batch.of(normal(501, spec.obs_dim), normal(500, spec.action_dim))
        self.state = learner.init(run.learner, spec, (demo,) * 10, 0)
        self.actor = on_host(run.agent.actor(self.state.agent))
        self.explore = run.agent.explorer(spec.action_dim, rng)
        self.obs = normal(spec.obs_dim)
        step = functools.partial(learner.update, run.learner)
        jaxpr = jax.make_jaxpr(step)(self.state, self.window, self.expert, None, np.int32(0), np.int32(0), self.cloned)
        found = list(_dot_generals(jaxpr.jaxpr))
        self.products, self.flops = _products(found), sum(map(flops, found))

    def update(self, times: int) -> None:
        """Do `times` updates, and wait for them at the end."""
        for _ in range(times):
            step, self.count = np.int32(self.count), self.count + 1
            given = self.window, self.expert, None, step, step, self.cloned
            self.state, actor = learner.update(self.run.learner, self.state, *given)
        jax.block_until_ready((self.state, actor))

    def floor(self, times: int) -> None:
        """Compute the matrix products of `times` updates."""
        for _ in range(times):
            results = self.products()
        jax.block_until_ready(results)

    def act(self, times: int) -> None:
        """Compute `times` actions for one observation."""
        for _ in range(times):
            self.explore(self.actor, self.obs, 0)

    def sample(self, times: int) -> None:
        """Sample `times` batches of windows."""
        for _ in range(times):
            self.replay.sample(self.rng, self.run.agent.batch_size, self.run.agent.n_step)


def _dot_generals(jaxpr: Any) -> Iterator[Any]:
    """Every matrix product of a jaxpr, including those of nested jaxprs."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in core.jaxprs_in_params(equation.params):
            yield from _dot_generals(inner)


def flops(equation: Any) -> int:
    """Two for each multiplication: twice the size of the result times the length of the summed axes."""
    (contracted, _), _ = equation.params["dimension_numbers"]
    return 2 * math.prod(equation.outvars[0].aval.shape) * math.prod(equation.invars[0].aval.shape[i] for i in contracted)


def large_product(times: int) -> None:
    """Multiply two matrices of `LARGE` rows and columns, which a core does at its highest rate."""
    operand = jnp.ones((LARGE, LARGE))
    for _ in range(times):
        result = _squared(operand)
    jax.block_until_ready(result)


@jax.jit
def _squared(x: Any) -> Any:
    return x @ x


def _products(equations: list[Any]) -> Callable[[], Any]:
    """A compiled function that computes these matrix products on random operands.

    Left operands are distinct, so that XLA merges no two products; right operands of the same shape are shared, as weights are.
    """
    rng = np.random.default_rng(0)
    lefts = [rng.standard_normal(e.invars[0].aval.shape, dtype=np.float32) for e in equations]
    shapes = {e.invars[1].aval.shape for e in equations}
    rights = {shape: rng.standard_normal(shape, dtype=np.float32) for shape in shapes}
    lefts, rights = jax.device_put((lefts, rights))

    @jax.jit
    def run(lefts: list[Any], rights: dict[Any, Any]) -> list[Any]:
        pairs = zip(equations, lefts, strict=True)
        return [jax.lax.dot_general(left, rights[e.invars[1].aval.shape], e.params["dimension_numbers"]) for e, left in pairs]

    return lambda: run(lefts, rights)


def medians(parts: dict[str, Callable[[int], None]], seconds: float) -> dict[str, float]:
    """The median time of one call of each part, in the unit at the end of its name; the parts alternate."""
    units = {name: 1e3 if name.endswith("_ms") else 1e6 for name in parts}
    times = {name: 20 if name.endswith("_ms") else 500 for name in parts}
    blocks: dict[str, list[float]] = {name: [] for name in parts}
    for part in parts.values():
        part(2)
    begin = time.perf_counter()
    while time.perf_counter() - begin < seconds or min(map(len, blocks.values())) < 3:
        for name, part in parts.items():
            start = time.perf_counter()
            part(times[name])
            blocks[name].append((time.perf_counter() - start) / times[name] * units[name])
    return {name: statistics.median(values) for name, values in blocks.items()}


class Timing(NamedTuple):
    """Times of some complete episodes of a training loop."""

    seconds: float
    frames: int
    inside: dict[str, float]
    """The seconds spent in each part."""
    calls: dict[str, int]
    """The number of calls of each part."""


def time_loop(run: Run, seconds: float, parts: Sequence[tuple[Any, str]]) -> Timing:
    """Run the training loop for about `seconds` after compilation, and time all calls of each `owner.name` of the parts.

    The result of each call is waited for, unlike in the loop itself, so that the time is attributed to the right part.
    """
    names = [name for _, name in parts]
    inside, calls = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0)
    ends: list[
        tuple[float, int, dict[str, float], dict[str, int]]
    ] = []  # for each episode: time, frames, and copies of both dicts

    def timed(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            result = jax.block_until_ready(original(*arguments, **named))
            inside[name] += time.perf_counter() - start
            calls[name] += 1
            return result

        return call

    class Watch(Callback):
        """Records the end of each episode, and stops the run after enough of them."""

        def episode(self, row: dict[str, Any]) -> None:
            ends.append((time.perf_counter(), row["frames"], dict(inside), dict(calls)))

        def stop(self) -> bool:
            return len(ends) >= 6 and ends[-1][0] - ends[3][0] > seconds

    with contextlib.ExitStack() as stack:
        for owner, name in parts:
            original = getattr(owner, name)
            stack.callback(setattr, owner, name, original)
            setattr(owner, name, timed(name, original))
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        with contextlib.suppress(loop.Stopped):
            runs.execute(run, Path(folder) / "run", [Watch()])
    (start, first, inside_before, before), (end, last, inside_after, after) = ends[3], ends[-1]
    within = {name: inside_after[name] - inside_before[name] for name in names}
    return Timing(end - start, last - first, within, {name: after[name] - before[name] for name in names})
