"""DrQ-v2's update compared with a second implementation in float64, written from the definitions; its noise over time."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil.agents import DrQV2
from pcil.agents.drqv2 import DrQV2State
from pcil.nets.networks import MLP, Actor, Trunk
from pcil.nets.noise import LinearSchedule
from pcil.types import Spec, Window
from small import narrow, random_batch

SPEC = Spec(3, 2, 1)
AGENT = narrow(DrQV2(), n_step=2, learning_rate=0.01, tau=0.2, gamma=0.9, noise=LinearSchedule(1.0, 0.1, 1000), noise_clip=0.3)
DEVIATION = {0: 1.0, 500: 0.55, 1000: 0.1, 5000: 0.1}
"""Standard deviations of the noise, by hand: `1 - 0.9 step / 1000`, and 0.1 after step 1000."""


def window(seed: int) -> Window:
    """32 windows of two steps; of each four, the first terminates at its first step and the second at its last."""
    rng = np.random.default_rng(seed)
    flat = random_batch(32 * 3, 3, 2, seed)
    discount = np.ones((32, 2), np.float32)
    discount[0::4], discount[1::4, 1] = 0, 0
    reward = rng.standard_normal((32, 2), dtype=np.float32) * 3
    parts = flat.obs.reshape(32, 3, 3), flat.action.reshape(32, 3, 2)[:, :2], reward, discount, np.zeros(32, np.int32)
    return Window(*map(jnp.asarray, parts))


# --- The second implementation ---


def features(trunk: Trunk, obs: Any) -> Any:
    """tanh(LayerNorm(Linear(obs)))."""
    x = obs @ trunk.weight + trunk.bias[None]
    x = (x - x.mean(axis=1, keepdims=True)) / jnp.sqrt(x.var(axis=1, keepdims=True) + 1e-5)
    return jnp.tanh(x * trunk.scale[None] + trunk.offset[None])


def layers(mlp: MLP, x: Any) -> Any:
    (w0, w1, w2), (b0, b1, b2) = mlp.weights, mlp.biases
    return jax.nn.relu(jax.nn.relu(x @ w0 + b0[None]) @ w1 + b1[None]) @ w2 + b2[None]


def noisy(actor: Any, obs: Any, noise: Any) -> Any:
    """The action is clamped to 1 - 1e-6, with the gradient of the mean alone."""
    mean = jnp.tanh(layers(actor.head, features(actor.trunk, obs)))
    return mean + jax.lax.stop_gradient(jnp.clip(mean + noise, -1 + 1e-6, 1 - 1e-6) - mean)


def worth(critic: Any, obs: Any, action: Any) -> Any:
    x = jnp.concatenate([features(critic.trunk, obs), action], axis=1)
    return tuple(layers(head, x)[:, 0] for head in critic.heads)


def adam(network: Any, slope: Any, first: Any, second: Any, count: Any) -> tuple[Any, Any, Any]:
    first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, slope)
    second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, second, slope)
    step = jax.tree.map(lambda m, v: m / (1 - 0.9**count) / (jnp.sqrt(v / (1 - 0.999**count)) + 1e-8), first, second)
    return jax.tree.map(lambda x, s: x - 0.01 * s, network, step), first, second


@jax.jit
def naive(
    nets: dict[str, Any], w: Window, target_noise: Any, actor_noise: Any, count: Any, weight: Any, cloned: Window | None = None
) -> tuple[dict[str, Any], Any]:
    """Update number `count`: target, critic step, actor step on the new critic, slow critic. Returns networks and losses.

    With `cloned` windows, the actor's loss is `-mean Q / size + weight mean |mu(s) - a|^2`; `size^2` is the mean square of
    the length of `dQ/da`.
    """
    nets = dict(nets)
    s0, s2, a0 = w.obs[:, 0], w.obs[:, 2], w.action[:, 0]
    r, d = w.reward, w.discount
    bootstrap = jnp.minimum(*worth(nets["slow"], s2, noisy(nets["actor"], s2, target_noise)))
    target = r[:, 0] + 0.9 * d[:, 0] * r[:, 1] + 0.81 * d[:, 0] * d[:, 1] * bootstrap

    def critic_loss(critic: Any) -> Any:
        return sum(jnp.mean((q - target) ** 2) for q in worth(critic, s0, a0))

    losses = {"critic_loss": critic_loss(nets["critic"])}
    slope = jax.grad(critic_loss)(nets["critic"])
    nets["critic"], *nets["critic opt_state"] = adam(nets["critic"], slope, *nets["critic opt_state"], count)

    def actor_loss(actor: Any) -> Any:
        return -jnp.mean(jnp.minimum(*worth(nets["critic"], s0, noisy(actor, s0, actor_noise))))

    def cloning_error(actor: Any) -> Any:
        mean = jnp.tanh(layers(actor.head, features(actor.trunk, cloned.obs[:, 0])))
        return jnp.mean(jnp.sum((mean - cloned.action[:, 0]) ** 2, axis=1))

    losses["actor_loss"], slope = jax.value_and_grad(actor_loss)(nets["actor"])
    if cloned is not None:
        losses["cloning_error"], other = jax.value_and_grad(cloning_error)(nets["actor"])
        actions = noisy(nets["actor"], s0, actor_noise)
        each = jax.vmap(jax.grad(lambda a, s: jnp.minimum(*worth(nets["critic"], s[None], a[None]))[0]))(actions, s0)
        size = jnp.sqrt(jnp.mean(jnp.linalg.norm(each, axis=1) ** 2))
        slope = jax.tree.map(lambda g, c: g / size + weight * c, slope, other)
    nets["actor"], *nets["actor opt_state"] = adam(nets["actor"], slope, *nets["actor opt_state"], count)
    nets["slow"] = jax.tree.map(lambda slow, fast: 0.8 * slow + 0.2 * fast, nets["slow"], nets["critic"])
    return nets, losses


def close(got: Any, expected: Any, name: str) -> None:
    for one, two in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert np.allclose(one, two, rtol=1e-3, atol=2e-5), name


@pytest.mark.parametrize("cloning", [False, True])
def test_three_updates_equal_the_definitions_in_float64(cloning: bool) -> None:
    """At three steps of the schedules of the noise and of cloning's weight. Adam's state shows the
    size of each gradient, which its first step does not."""
    agent = dataclasses.replace(AGENT, cloning=cloning, cloning_weight=LinearSchedule(10.0, 2.0, 1000))
    state = agent.init(SPEC, key=jax.random.key(0))
    more = {"cloned": window(9)} if cloning else {}
    steps, weights, keys = (0, 500, 5000), (10.0, 6.0, 2.0), [jax.random.key(10 + i) for i in range(3)]
    draws = [jax.random.normal(key, (2, 32, 2)) for key in keys]
    update = jax.jit(lambda s, w, step, key: agent.update(s, w, **more, step=step, key=key))
    got: list[tuple[DrQV2State, Any]] = []
    for i in range(3):
        got.append(update(got[-1][0] if got else state, window(i), jnp.int32(steps[i]), keys[i]))

    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), tree)  # noqa: E731
        nets = {"actor": double(state.actor), "critic": double(state.critic), "slow": double(state.critic)}
        for name in ("actor", "critic"):
            nets[f"{name} opt_state"] = [jax.tree.map(jnp.zeros_like, nets[name]) for _ in range(2)]
        for i, (after, metrics) in enumerate(got):
            noise = np.clip(DEVIATION[steps[i]] * np.asarray(draws[i], np.float64), -0.3, 0.3)
            nets, losses = naive(
                nets, double(window(i)), *map(jnp.asarray, noise), jnp.float64(i + 1), weights[i], *map(double, more.values())
            )
            for name, value in losses.items():
                assert float(metrics[name]) == pytest.approx(float(value), rel=1e-4, abs=1e-5), (i, name)
            for name, network, opt_state in (
                ("critic", after.critic, after.critic_opt_state),
                ("actor", after.actor, after.actor_opt_state),
            ):
                close(network, nets[name], f"{name} of update {i}")
                close([opt_state[0].mu, opt_state[0].nu], nets[f"{name} opt_state"], f"opt_state of the {name} of update {i}")
            close(after.critic_target, nets["slow"], f"slow critic of update {i}")


def test_a_value_without_slope_moves_nothing_but_the_clone() -> None:
    """With a critic that is constant in the actions, the actor's gradient is that of the cloning error alone."""
    agent = dataclasses.replace(AGENT, cloning=True, cloning_weight=LinearSchedule(7.0, 7.0, 1))
    state, key, cloned = agent.init(SPEC, key=jax.random.key(0)), jax.random.key(1), window(9)
    agent = dataclasses.replace(agent, learning_rate=0.0)
    flat = jax.tree.map(jnp.zeros_like, state.critic)
    state = dataclasses.replace(state, critic=flat, critic_target=flat)
    after, metrics = agent.update(state, window(0), cloned=cloned, step=jnp.int32(0), key=key)
    slopes = jax.tree.leaves(jax.grad(lambda actor: 7 * agent.cloning_error(state, actor, cloned))(state.actor))
    assert float(metrics["actor_loss"]) == 0
    for got, slope in zip(jax.tree.leaves(after.actor_opt_state[0].mu), slopes, strict=True):
        assert np.allclose(got, 0.1 * slope, rtol=1e-4, atol=1e-7)


# --- Noise over time ---


def resting() -> Actor:
    """An actor whose mean action is 0 everywhere."""
    return jax.tree.map(lambda x: np.zeros_like(x), AGENT.init(SPEC, key=jax.random.key(0)).actor)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_acting_noise_follows_the_schedule(correlation: float) -> None:
    """With the same draws of one generator, the noise at each step is scaled by the schedule, and bounded only by
    the action's bounds."""
    agent = dataclasses.replace(AGENT, noise_correlation=correlation)
    alone = dataclasses.replace(agent, noise=LinearSchedule(0.1, 0.1, 1))
    obs, large = np.zeros(3, np.float32), 0
    explore, unit = (kind.explorer(2, np.random.default_rng(0)) for kind in (agent, alone))
    for step in [0, 500, 1000, 5000] * 10:
        got, tenth = explore(resting(), obs, step), unit(resting(), obs, 0)
        assert np.allclose(got, np.clip(10 * DEVIATION[step] * tenth, -1 + 1e-6, 1 - 1e-6), atol=1e-5)
        large += int((np.abs(got) > 0.3).sum())
    assert large > 10, "noise_clip bounds only the updates"


def test_white_acting_noise_is_the_schedules_deviation_times_the_generators_draws() -> None:
    explore, draws = AGENT.explorer(2, np.random.default_rng(7)), np.random.default_rng(7)
    for step, deviation in DEVIATION.items():
        noise = deviation * draws.standard_normal(2, dtype=np.float32)
        got = explore(resting(), np.zeros(3, np.float32), step)
        assert np.allclose(got, np.clip(noise, -1 + 1e-6, 1 - 1e-6), atol=1e-6)


def test_the_noise_of_updates_follows_the_schedule_and_its_two_draws_are_independent(monkeypatch: pytest.MonkeyPatch) -> None:
    """The unclipped noise of the target and of the actor's loss: 1000 draws each, with the standard deviation of the step."""
    agent = dataclasses.replace(AGENT, noise_clip=100.0, batch_size=500)
    given: dict[str, Any] = {}
    target, actor_loss = DrQV2.target, DrQV2.actor_loss
    monkeypatch.setattr(DrQV2, "target", lambda self, s, w, noise: given.update(target=noise) or target(self, s, w, noise))

    def loss(self: DrQV2, actor: Actor, critic: Any, obs: Any, noise: Any, alive: Any) -> Any:
        given["actor"] = noise
        return actor_loss(self, actor, critic, obs, noise, alive)

    monkeypatch.setattr(DrQV2, "actor_loss", loss)
    state, batch = agent.init(SPEC, key=jax.random.key(0)), jax.tree.map(lambda x: jnp.repeat(x, 16, axis=0)[:500], window(0))

    @jax.jit
    def noises(step: Any, key: Any) -> tuple[Any, Any]:
        agent.update(state, batch, step=step, key=key)
        return given["target"].ravel(), given["actor"].ravel()

    for step, deviation in DEVIATION.items():
        one, two = map(np.asarray, noises(jnp.int32(step), jax.random.key(step)))
        assert np.std(one) == pytest.approx(deviation, rel=0.1) and np.std(two) == pytest.approx(deviation, rel=0.1)
        assert abs(np.corrcoef(one, two)[0, 1]) < 0.12, "four standard errors of 1000 independent pairs are 0.126"
