"""The networks and exploration: one forward pass in two libraries, orthogonal initialisation, exact clamps."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcil.nets.networks import (
    LAYER_NORM_EPSILON,
    MLP,
    SCALED_BOUND,
    SCALER_FLOOR,
    SCALER_RATE,
    Actor,
    Critic,
    Normalizer,
    Scaler,
    Trunk,
    scaled,
    unit_sphere,
    unscaled,
)
from pcil.nets.noise import ACTION_MARGIN, LinearSchedule, add_noise, normal_steps
from pcil.nets.optimiser import adam_init, adam_step

law = settings(deadline=None, derandomize=True, max_examples=50)
scaler_update = jax.jit(Scaler.update)
OBS_DIM, ACTION_DIM, FEATURES, HIDDEN = 5, 3, 8, 16


def randomised(network: eqx.Module, seed: int = 0) -> eqx.Module:
    """The same network with random numbers everywhere, so that no bias is 0 and no scale is 1."""
    rng = np.random.default_rng(seed)
    draw = lambda leaf: jnp.asarray(rng.normal(size=leaf.shape, scale=0.7), leaf.dtype)  # noqa: E731
    return jax.tree.map(draw, network)


def on_host(network: eqx.Module) -> eqx.Module:
    return jax.tree.map(np.asarray, network)


@functools.cache
def make_actor() -> Actor:
    return Actor.init(OBS_DIM, ACTION_DIM, FEATURES, HIDDEN, key=jax.random.key(0))


def random_actor() -> Actor:
    return randomised(make_actor())


@functools.cache
def make_critic() -> Critic:
    return Critic.init(OBS_DIM, ACTION_DIM, FEATURES, HIDDEN, key=jax.random.key(1))


def small_mlp() -> MLP:
    return MLP.init((3, 7, 2), key=jax.random.key(2))


def observations(*shape: int) -> np.ndarray:
    return np.random.default_rng(7).normal(size=shape, scale=2).astype(np.float32)


# --- One forward pass ---


@pytest.mark.parametrize("shape", [(OBS_DIM,), (4, OBS_DIM), (2, 3, OBS_DIM)])
@pytest.mark.parametrize("make", [make_actor, random_actor])
def test_the_actor_acts_the_same_in_numpy_as_in_jax(make: Callable[[], Actor], shape: tuple[int, ...]) -> None:
    network, obs = make(), observations(*shape)
    host = on_host(network)(obs, np)
    assert isinstance(host, np.ndarray) and host.dtype == np.float32
    assert host.shape == (*shape[:-1], ACTION_DIM)
    np.testing.assert_allclose(host, eqx.filter_jit(network)(jnp.asarray(obs)), rtol=0, atol=1e-6)
    assert np.abs(host).max() <= 1


def test_the_actor_is_the_float64_formula() -> None:
    actor = on_host(random_actor())
    obs = observations(6, OBS_DIM)
    x = naive_trunk(actor.trunk, obs)
    for i, (weight, bias) in enumerate(zip(actor.head.weights, actor.head.biases, strict=True)):
        x = x @ weight.astype(np.float64) + bias
        x = np.where(x > 0, x, 0) if i < 2 else np.tanh(x)
    np.testing.assert_allclose(actor(obs, np), x, rtol=0, atol=1e-5)


def naive_trunk(trunk: Trunk, obs: np.ndarray) -> np.ndarray:
    """Row by row in float64: linear, subtract the mean, divide by the standard deviation, scale, offset, tanh."""
    rows = []
    for row in obs.astype(np.float64):
        x = row @ np.asarray(trunk.weight, np.float64) + np.asarray(trunk.bias, np.float64)
        normal = (x - np.mean(x)) / np.sqrt(np.var(x) + LAYER_NORM_EPSILON)
        rows.append(np.tanh(normal * np.asarray(trunk.scale, np.float64) + np.asarray(trunk.offset, np.float64)))
    return np.stack(rows)


def test_the_trunk_is_a_layer_norm_between_a_linear_layer_and_a_tanh() -> None:
    trunk, obs = randomised(make_actor().trunk), observations(6, OBS_DIM)
    np.testing.assert_allclose(trunk(jnp.asarray(obs)), naive_trunk(trunk, obs), rtol=0, atol=1e-6)


def test_a_row_does_not_depend_on_the_batch_around_it() -> None:
    network, obs = random_actor(), observations(4, OBS_DIM)
    together = np.asarray(network(jnp.asarray(obs)))
    alone = np.stack([np.asarray(network(jnp.asarray(row))) for row in obs])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-6)


# --- Initialisation ---


@pytest.mark.parametrize("make", [make_actor, make_critic, small_mlp])
def test_every_linear_layer_starts_orthogonal_and_without_bias(make: Callable[[], eqx.Module]) -> None:
    network = make()
    matrices = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(network) if leaf.ndim == 2]
    assert len(matrices) >= 2
    for matrix in matrices:
        short = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
        np.testing.assert_allclose(short @ short.T, np.eye(len(short)), atol=1e-5)
    for path, leaf in jax.tree_util.tree_leaves_with_path(network):
        if leaf.ndim == 1:
            np.testing.assert_array_equal(leaf, "scale" in jax.tree_util.keystr(path))


def test_no_two_layers_and_no_two_keys_start_alike() -> None:
    square = MLP.init((6, 6, 6, 6), key=jax.random.key(0))
    other = MLP.init((6, 6, 6, 6), key=jax.random.key(1))
    for first, second in itertools.combinations([*square.weights, *other.weights], 2):
        assert np.abs(np.asarray(first - second)).max() > 0.1


def test_the_networks_have_the_sizes_of_drq_v2() -> None:
    """A linear layer to the features, then two hidden layers; the inputs of the critic's heads are features and action."""
    actor, critic = make_actor(), make_critic()
    assert actor.trunk.weight.shape == critic.trunk.weight.shape == (OBS_DIM, FEATURES)
    assert [w.shape for w in actor.head.weights] == [(FEATURES, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, ACTION_DIM)]
    for head in critic.heads:
        assert [w.shape for w in head.weights] == [(FEATURES + ACTION_DIM, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, 1)]


# --- The critic ---


def test_the_critics_values_differ_and_rest_on_one_trunk() -> None:
    critic, obs, action = make_critic(), jnp.asarray(observations(4, OBS_DIM)), jnp.asarray(observations(4, ACTION_DIM))
    first, second = critic(obs, action)
    assert first.shape == second.shape == (4,)
    assert np.abs(np.asarray(first - second)).min() > 1e-4
    for value, from_features in zip((first, second), critic.values(critic.trunk(obs), action), strict=True):
        np.testing.assert_array_equal(value, from_features)
    moved = eqx.tree_at(lambda c: c.trunk.offset, critic, critic.trunk.offset + 0.5)
    for before, after in zip((first, second), moved(obs, action), strict=True):
        assert np.abs(np.asarray(before - after)).min() > 1e-4


@pytest.mark.parametrize("head", [0, 1])
def test_each_head_changes_its_own_value_alone(head: int) -> None:
    critic, obs, action = make_critic(), jnp.asarray(observations(4, OBS_DIM)), jnp.asarray(observations(4, ACTION_DIM))
    moved = eqx.tree_at(lambda c: c.heads[head].biases[-1], critic, jnp.ones(1))
    change = [np.asarray(after - before) for before, after in zip(critic(obs, action), moved(obs, action), strict=True)]
    np.testing.assert_allclose(change[head], 1, rtol=1e-5)
    np.testing.assert_array_equal(change[1 - head], 0)


def test_the_action_matters_to_the_value() -> None:
    critic, obs, action = make_critic(), jnp.asarray(observations(4, OBS_DIM)), jnp.asarray(observations(4, ACTION_DIM))
    slope = jax.grad(lambda a: jnp.sum(critic(obs, a)[0]))(action)
    assert np.abs(np.asarray(slope)).max(axis=1).min() > 1e-4


# --- The unit sphere ---


@law
@given(st.integers(0, 2**32), st.floats(1e-3, 1e6))
def test_on_the_unit_sphere_length_is_1_and_direction_is_kept(seed: int, scale: float) -> None:
    x = np.random.default_rng(seed).normal(size=(3, 4)) * scale
    result = np.asarray(unit_sphere(jnp.asarray(x, jnp.float32)))
    np.testing.assert_allclose(np.linalg.norm(result, axis=-1), 1, rtol=1e-5)
    np.testing.assert_allclose(result, x / np.linalg.norm(x, axis=-1, keepdims=True), atol=1e-5)


def test_the_unit_sphere_has_a_value_and_a_slope_at_zero() -> None:
    zero = jnp.zeros((2, 4))
    value, slope = unit_sphere(zero), jax.grad(lambda x: jnp.sum(unit_sphere(x)))(zero)
    np.testing.assert_array_equal(value, 0)
    assert np.isfinite(slope).all()


# --- Exploration ---


@pytest.mark.parametrize(("step", "deviation"), [(0, 1.0), (250_000, 0.55), (500_000, 0.1), (10_000_000, 0.1), (-5, 1.0)])
def test_the_schedule_is_a_line_between_its_ends_and_constant_outside(step: int, deviation: float) -> None:
    schedule = LinearSchedule(1.0, 0.1, 500_000)
    assert float(schedule(step, np)) == pytest.approx(deviation, rel=1e-6)


@pytest.mark.parametrize("schedule", [LinearSchedule(), LinearSchedule(0.2, 0.2, 0), LinearSchedule(0.1, 0.9, 7)])
def test_the_schedule_is_the_same_in_numpy_as_in_a_compiled_step(schedule: LinearSchedule) -> None:
    compiled = jax.jit(schedule)
    for step in (0, 1, 3, 7, 12_345, 250_000, 499_999, 500_000, 2_000_000):
        host = schedule(step, np)
        assert host.dtype == np.float32
        np.testing.assert_allclose(host, compiled(np.int32(step)), rtol=1e-6)


def test_the_steps_of_the_noise_are_standard_normal_and_correlated_as_asked() -> None:
    walk = normal_steps(np.random.default_rng(0), 3, 0.7)
    steps = np.stack([next(walk) for _ in range(40_000)])
    assert steps.dtype == np.float32
    assert np.allclose(steps.mean(axis=0), 0, atol=0.05) and np.allclose(steps.std(axis=0), 1, atol=0.03)
    for lag in (1, 2, 5):
        correlation = (steps[lag:] * steps[:-lag]).mean(axis=0)
        np.testing.assert_allclose(correlation, 0.7**lag, atol=0.03)
    assert np.abs(np.corrcoef(steps.T) - np.eye(3)).max() < 0.05


def test_without_correlation_the_noise_is_the_generators_own() -> None:
    walk, rng = normal_steps(np.random.default_rng(1), 2, 0.0), np.random.default_rng(1)
    for _ in range(5):
        np.testing.assert_array_equal(next(walk), rng.standard_normal(2, dtype=np.float32))


def test_a_schedule_of_one_step_is_at_its_end_after_it() -> None:
    for steps, expected in ((1, [1.0, 0.1, 0.1]), (2, [1.0, 0.55, 0.1])):
        schedule = LinearSchedule(1.0, 0.1, steps)
        assert [float(schedule(step, np)) for step in range(3)] == pytest.approx(expected)


def test_the_schedule_never_turns_back() -> None:
    values = [float(LinearSchedule(1.0, 0.1, 100)(step, np)) for step in range(120)]
    assert np.all(np.diff(values) <= 0) and values[0] == 1 and len(set(values)) == 101


@law
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-6, 6)), min_size=4, max_size=4))
def test_a_noisy_action_is_the_sum_clamped_to_the_margin(pairs: list[tuple[float, float]]) -> None:
    mean, noise = (np.array(column, np.float32) for column in zip(*pairs, strict=True))
    host = add_noise(mean, noise, np)
    assert host.dtype == np.float32
    limit = np.float32(1 - ACTION_MARGIN)
    np.testing.assert_array_equal(host, np.minimum(np.maximum(mean + noise, -limit), limit))
    compiled = np.asarray(add_noise(jnp.asarray(mean), jnp.asarray(noise)))
    np.testing.assert_allclose(compiled, host, rtol=0, atol=5e-7)
    assert np.abs(compiled).max() < 1


@pytest.mark.parametrize("noise", [0.0, 0.3, -0.9, 5.0, -5.0])
def test_the_clamp_passes_the_gradient_straight_through(noise: float) -> None:
    mean = jnp.array([[0.5, -0.5, 0.999]])
    to_mean, to_noise = jax.grad(lambda m, e: jnp.sum(add_noise(m, e)), (0, 1))(mean, jnp.full((1, 3), noise))
    np.testing.assert_array_equal(to_mean, 1)
    np.testing.assert_array_equal(to_noise, 1)


# --- The optimiser ---


def test_three_steps_are_those_of_adam_written_out() -> None:
    """Kingma and Ba 2015, Algorithm 1, with its default betas and epsilon, in float64."""
    rng, network = np.random.default_rng(0), small_mlp()
    weight, opt_state = np.asarray(network.weights[0], np.float64), adam_init(network)
    mean, square = np.zeros_like(weight), np.zeros_like(weight)
    for step in (1, 2, 3):
        gradient = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), network)
        slope = np.asarray(gradient.weights[0], np.float64)
        mean, square = 0.9 * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
        weight = weight - 1e-2 * (mean / (1 - 0.9**step)) / (np.sqrt(square / (1 - 0.999**step)) + 1e-8)
        network, opt_state = adam_step(network, gradient, opt_state, 1e-2)
    np.testing.assert_allclose(network.weights[0], weight, rtol=0, atol=1e-6)


def test_the_first_step_of_adam_is_the_learning_rate_against_the_gradient() -> None:
    network = small_mlp()
    gradient = jax.tree.map(lambda leaf: jnp.full_like(leaf, 7.0), network)
    moved, _ = adam_step(network, gradient, adam_init(network), 1e-3)
    for before, after in zip(jax.tree.leaves(network), jax.tree.leaves(moved), strict=True):
        np.testing.assert_allclose(np.asarray(after - before), -1e-3, rtol=1e-3)


# --- Standardised observations ---


@law
@given(st.integers(0, 2**32), st.integers(1, 30))
def test_the_scalers_statistics_are_those_of_all_rows_seen(seed: int, batches: int) -> None:
    """Until the smallest rate is reached, compared with NumPy over all rows together."""
    rng = np.random.default_rng(seed)
    rows = (rng.normal(size=(batches, 8, 3)) * [1, 10, 0.1] + [0, -20, 5]).astype(np.float32)
    scaler = Scaler.init(3)
    for batch in rows:
        scaler = scaler_update(scaler, batch)
    flat = rows.reshape(-1, 3).astype(np.float64)
    assert np.allclose(scaler.mean, flat.mean(axis=0), rtol=1e-4, atol=1e-4)
    assert np.allclose(scaler.variance, flat.var(axis=0), rtol=1e-3, atol=1e-5)


def test_the_scaler_forgets_what_is_long_past() -> None:
    scaler = dataclasses.replace(Scaler.init(1), count=jnp.float32(1e6))
    for _ in range(20):
        scaler = scaler_update(scaler, np.full((8, 1), 3.0, np.float32))
    assert float(scaler.mean[0]) == pytest.approx(3 * (1 - (1 - SCALER_RATE) ** 20), rel=1e-3)


@law
@given(st.integers(0, 2**32))
def test_an_unscaled_trunk_gives_for_plain_observations_what_the_trunk_gives_for_scaled_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    trunk = randomised(Trunk.init(4, FEATURES, key=jax.random.key(0)), seed)
    mean, variance = rng.normal(size=4) * 10, rng.uniform(0.1, 9, size=4)
    scaler = Scaler(*(jnp.asarray(x, jnp.float32) for x in (mean, variance, 5.0)))
    obs = (rng.normal(size=(6, 4)) * 5 * np.sqrt(variance) + mean).astype(np.float32)
    naive = np.clip((obs - mean) / np.sqrt(variance), -SCALED_BOUND, SCALED_BOUND)
    assert np.allclose(scaled(scaler, jnp.asarray(obs)), naive, rtol=1e-3, atol=1e-3)
    plain = unscaled(trunk, scaler)
    assert np.allclose(plain(jnp.asarray(obs)), trunk(jnp.asarray(naive, jnp.float32)), atol=2e-3)
    assert np.allclose(jax.tree.map(np.asarray, plain)(obs, np), plain(jnp.asarray(obs)), atol=1e-5)


@pytest.mark.parametrize("scaling", [False, True])
def test_a_trunk_without_its_last_entry_takes_it_for_zero(scaling: bool) -> None:
    rng = np.random.default_rng(0)
    trunk = randomised(Trunk.init(5, FEATURES, key=jax.random.key(0)), 0)
    if scaling:
        mean, deviation = (jnp.asarray(x, jnp.float32) for x in (rng.normal(size=5), rng.uniform(0.5, 2, size=5)))
        trunk = dataclasses.replace(trunk, normalizer=Normalizer(mean, deviation))
    obs = jnp.asarray(rng.normal(size=(6, 4)), jnp.float32)
    whole = trunk(jnp.concatenate([obs, jnp.zeros((6, 1))], axis=1))
    np.testing.assert_allclose(trunk.without_last()(obs), whole, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 1e6, -3e-5])
def test_an_entry_that_never_varies_is_scaled_to_zero_and_one_that_leaves_it_is_bounded(value: float) -> None:
    scaler = Scaler.init(1)
    for _ in range(10):
        scaler = scaler_update(scaler, np.full((8, 1), value, np.float32))
    assert scaler.mean[0] == np.float32(value) and scaler.variance[0] == 0
    assert scaled(scaler, jnp.full((2, 1), value))[0, 0] == 0
    assert abs(scaled(scaler, jnp.full((2, 1), value + 1e7))[0, 0]) <= SCALED_BOUND


def test_the_floor_of_the_deviation_is_a_share_of_the_mean_and_the_bound_is_ten_deviations() -> None:
    still = Scaler(jnp.array([4.0, -4.0, 0.5]), jnp.zeros(3), jnp.float32(9.0))
    expected = np.array([4.0, 4.0, 0.5]) * SCALER_FLOOR
    np.testing.assert_allclose(still.normalizer.deviation, expected, rtol=1e-6)
    plain = Scaler(jnp.zeros(2), jnp.ones(2), jnp.float32(9.0))
    np.testing.assert_array_equal(scaled(plain, jnp.array([[9.75, 1e6], [-9.75, -1e6]])), [[9.75, 10.0], [-9.75, -10.0]])


def test_an_entry_that_stays_where_it_is_for_long_is_not_blown_up() -> None:
    """By rounding, its mean stops short of the value, and its variance stops at the squared difference."""
    scaler = Scaler(jnp.array([0.3]), jnp.array([1.0]), jnp.float32(1e6))
    rows = np.full((8, 1), 0.7, np.float32)
    scaler = jax.lax.fori_loop(0, 100_000, lambda _, s: s.update(jnp.asarray(rows)), scaler)
    assert scaler.variance[0] < 1e-8
    assert abs(scaled(scaler, jnp.asarray(rows))[0, 0]) < 1.01


def test_far_from_zero_the_scaler_keeps_what_float32_has_left() -> None:
    rng = np.random.default_rng(0)
    rows = (1e6 + rng.normal(size=(20, 64, 1))).astype(np.float32)
    scaler = Scaler.init(1)
    for batch in rows:
        scaler = scaler_update(scaler, batch)
    exact = rows.astype(np.float64)
    assert float(scaler.mean[0]) == pytest.approx(exact.mean(), abs=0.1)
    assert float(scaler.variance[0]) == pytest.approx(exact.var(), rel=0.05)
