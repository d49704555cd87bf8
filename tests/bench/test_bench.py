"""The benchmark's lower bound consists of exactly the update's own matrix products."""

from __future__ import annotations

import functools
import itertools
import json
import math
import re
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from pcil import bench
from pcil.bench import parts
from pcil.bench.parts import flops
from pcil.envs.toy import PointMass
from pcil.training import learner, presets
from pcil.training.config import Run
from pcil.types import Batch, Spec, Window
from small import small_run

BATCH, WIDTHS = 5, (3, 7, 2)
DESIGN = """
    update_ms, floor_ms, agent_update_ms, agent_floor_ms, env_step_us, physics_us, act_us, sample_us,
    loop_update_share, frames_per_second
"""
"""The keys of `pcil bench --json`."""


def layers() -> tuple[Array, Array]:
    return tuple(jnp.ones(shape) for shape in itertools.pairwise(WIDTHS))


def loss(weights: tuple[Array, Array], x: Float[Array, "batch in"]) -> Float[Array, ""]:
    """The loss of a network with two layers, the first in a separate compiled function."""
    hidden = jax.jit(lambda w, x: jnp.tanh(x @ w))(weights[0], x)
    return jnp.sum((hidden @ weights[1]) ** 2)


def products(function: Any, *arguments: Any) -> list[Any]:
    """The matrix products that the benchmark finds in a function."""
    return list(parts._dot_generals(jax.make_jaxpr(function)(*arguments).jaxpr))


def signature(equation: Any) -> str:
    shapes = [variable.aval.shape for variable in (*equation.invars, *equation.outvars)]
    return f"{shapes} {equation.params['dimension_numbers']}"


def test_products_are_found_in_compiled_functions() -> None:
    found = products(jax.jit(loss), layers(), jnp.ones((BATCH, WIDTHS[0])))
    first, second = ((BATCH, WIDTHS[i], WIDTHS[i + 1]) for i in (0, 1))
    assert [flops(equation) for equation in found] == [2 * math.prod(first), 2 * math.prod(second)]


def test_products_are_found_in_gradients() -> None:
    """In the backward pass each layer needs one product for its weights and one for its input, except for the first input."""
    found = products(jax.value_and_grad(loss), layers(), jnp.ones((BATCH, WIDTHS[0])))
    assert len(found) == 5
    assert sum(map(flops, found)) == 2 * 2 * BATCH * 3 * 7 + 3 * 2 * BATCH * 7 * 2


def test_other_operations_are_no_products() -> None:
    found = products(lambda x: jnp.sum(jnp.tanh(x) * x, axis=0), jnp.ones((BATCH, 3)))
    assert found == []


def test_the_floor_is_the_same_products() -> None:
    """Shapes, operations and FLOPs are equal, and the compiler neither merges nor removes any product."""
    found = products(jax.value_and_grad(loss), layers(), jnp.ones((BATCH, WIDTHS[0])))
    floor = parts._products(found)
    again = products(floor)
    assert sorted(map(signature, again)) == sorted(map(signature, found))
    assert sum(map(flops, again)) == sum(map(flops, found))
    results = floor()
    assert [result.shape for result in results] == [equation.outvars[0].aval.shape for equation in found]
    assert all(np.isfinite(result).all() and np.any(result != 0) for result in results)


def test_equal_products_are_each_computed() -> None:
    """Two layers of the same shape are not merged."""
    x, w = jnp.ones((4, 4)), jnp.ones((4, 4))
    found = products(lambda x, w: (x @ w, jnp.tanh(x) @ w), x, w)
    first, second = parts._products(found)()
    assert not np.array_equal(first, second)


def update_products(run: Run, spec: Spec) -> list[Any]:
    """The matrix products of one update, traced on shapes alone."""

    def numbers(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, np.float32)

    count = jax.ShapeDtypeStruct((), np.int32)
    batch, n, expert = run.agent.batch_size, run.agent.n_step, run.reward.batch_size
    demos = (Batch(*(numbers(1000, size) for size in (spec.obs_dim, spec.action_dim, spec.obs_dim))),)
    state = jax.eval_shape(functools.partial(learner.init, run.learner, spec), demos, count)

    def steps(rows: int, n: int) -> Window:
        shapes = (rows, n + 1, spec.obs_dim), (rows, n, spec.action_dim), (rows, n), (rows, n)
        return Window(*(numbers(*shape) for shape in shapes), jax.ShapeDtypeStruct((rows,), np.int32))

    update = functools.partial(learner.update, run.learner)
    return products(update, state, steps(batch, n), steps(expert, 1), None, count, count)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_the_agents_update_has_the_products_that_it_must(preset: str) -> None:
    """Counted by hand: trunks t, the actor's head a, the critic's two heads c.

    The target runs the actor and the slow critic. The critic's loss runs it forwards, and backwards for all weights and for the
    inputs of its heads. The actor's loss runs both forwards, backwards through the critic's heads, then for the actor's weights
    and the inputs of its head. At the paper's sizes this is 0.33 GFLOP.
    """
    run, spec = presets.make("walker_walk", "expert", preset), Spec(24, 6, 2)
    hidden, features = run.agent.hidden, run.agent.feature_dim
    t = spec.obs_dim * features
    a = features * hidden + hidden * hidden + hidden * spec.action_dim
    c = 2 * ((features + spec.action_dim) * hidden + hidden * hidden + hidden)
    target, critic, actor = (t + a) + (t + c), 2 * (t + c) + c, (t + a) + (t + c) + c + (t + a) + a
    total = sum(map(flops, update_products(run, spec)))
    assert total == 2 * run.agent.batch_size * (target + critic + actor)
    assert total == pytest.approx(0.33e9, rel=0.01)


def test_pcils_update_costs_what_the_design_says() -> None:
    """About 0.8 GFLOP at the paper's sizes, including the agent's."""
    total = sum(map(flops, update_products(presets.make("walker_walk", "pcil", "paper"), Spec(24, 6, 2))))
    assert total == pytest.approx(0.8e9, rel=0.1)


def test_the_parts_that_are_timed_are_the_runs_own() -> None:
    run, spec = small_run("expert"), Spec(2, 2, 1)
    setup = parts.Setup(run, spec)
    floor = sorted(map(signature, products(setup.products)))
    assert floor == sorted(map(signature, update_products(run, spec)))
    before = np.asarray(setup.state.agent.actor.head.weights[0])
    setup.update(2)
    assert setup.count == 2 and not np.array_equal(setup.state.agent.actor.head.weights[0], before)
    assert float(setup.state.totals["updates"]) == 2


def test_the_loop_is_timed_over_whole_episodes_and_left_as_it_was() -> None:
    """Episodes 5 and 6 have 50 steps each, with an update every second step."""
    update, step = learner.update, PointMass.step
    run, timed = small_run("expert", frames=1000, evaluate_every=1000), [(learner, "update"), (PointMass, "step")]
    timing = parts.time_loop(run, 0.0, timed)
    assert timing.frames == timing.calls["step"] == 2 * timing.calls["update"] == 100
    assert min(timing.inside.values()) > 0 and sum(timing.inside.values()) < timing.seconds
    assert learner.update is update and PointMass.step is step


def test_figures_have_the_names_of_the_design() -> None:
    assert list(bench.KEYS) == re.findall(r"\w+", DESIGN)


def test_the_table_shows_the_ratios() -> None:
    figures = dict(zip(bench.KEYS, (15.0, 12.0, 6.0, 5.0, 900.0, 600.0, 90.0, 300.0, 0.876, 1234.5), strict=True))
    lines = bench.table(figures).splitlines()
    assert len(lines) == 6
    expected = ["ratio 1.25", "ratio 1.20", "ratio 1.50", "step of 0.10", "update of 0.020", "87.6% of its time"]
    assert all(words in line for words, line in zip(expected, lines, strict=True))
    assert "1,234 frames/s" in lines[-1]


@pytest.mark.slow
def test_bench_prints_json_and_nothing_else() -> None:
    command = [sys.executable, "-m", "pcil", "bench", "--json", "--seconds", "2"]
    figures = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert tuple(figures) == bench.KEYS
    assert all(value > 0 for value in figures.values())
    assert figures["loop_update_share"] < 1 and figures["floor_ms"] < figures["update_ms"]
