"""The toy environments have the values and optimal actions against which agents are tested."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pcil.envs import make, spec
from pcil.envs.toy import (
    ActionReward,
    ConstantReward,
    DelayedReward,
    ObservedActionReward,
    ObservedReward,
    PointMass,
    Probe,
)
from pcil.types import Spec

PROBES = {
    "toy/probe_1-v0": ConstantReward,
    "toy/probe_2-v0": ObservedReward,
    "toy/probe_3-v0": DelayedReward,
    "toy/probe_4-v0": ActionReward,
    "toy/probe_5-v0": ObservedActionReward,
}
DISCOUNT = 0.9


@pytest.mark.parametrize("env_id", ["toy/point_mass-v0", *PROBES])
def test_toys_are_proper_environments_without_wrappers(env_id: str) -> None:
    env = make(env_id)
    assert env.env is env.unwrapped and spec(env).action_repeat == 1
    check_env(env.unwrapped, skip_render_check=True)


def point_mass_return(policy: str, seed: int) -> tuple[float, int, bool]:
    env, rng = make("toy/point_mass-v0"), np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    total, steps, terminated, truncated = 0.0, 0, False, False
    while not (terminated or truncated):
        best = PointMass.optimal_action(obs)
        noise = rng.uniform(-0.2, 0.2, 2)
        action = {"best": best, "near": np.clip(best + noise, -1.0, 1.0), "random": rng.uniform(-1.0, 1.0, 2)}[policy]
        obs, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
        total, steps = total + reward, steps + 1
    return total, steps, terminated


@pytest.mark.parametrize("seed", range(5))
def test_point_mass_is_solved_by_its_optimal_action_alone(seed: int) -> None:
    best, steps, terminated = point_mass_return("best", seed)
    assert steps == 50 and not terminated
    assert best > point_mass_return("near", seed)[0] > point_mass_return("random", seed)[0]
    assert best > 50 - 10 * np.sqrt(2.0)  # at most 10 steps to the goal, where the reward of each step is 1


def test_point_mass_by_hand() -> None:
    env = make("toy/point_mass-v0")
    assert spec(env) == Spec(2, 2, 1)
    start, _ = env.reset(seed=1)
    obs, reward, *_ = env.step(np.array([1.0, -0.5], np.float32))
    moved = np.clip(start + np.array([0.1, -0.05]), -1.0, 1.0)
    np.testing.assert_allclose(obs, moved, atol=1e-6)
    assert reward == pytest.approx(1.0 - np.hypot(*moved), abs=1e-6)
    for _ in range(30):
        obs, *_ = env.step(np.ones(2))
    np.testing.assert_array_equal(obs, [1.0, 1.0])  # the walls stop it


def rollout(env: Probe, seed: int) -> tuple[list[float], list[float]]:
    """The observations and rewards of one episode with the best actions."""
    obs, _ = env.reset(seed=seed)
    seen, rewards, terminated = [], [], False
    while not terminated:
        seen.append(float(obs[0]))
        action = env.optimal_action(seen[-1]) if isinstance(env, ActionReward) else 0.3
        obs, reward, terminated, truncated, _ = env.step(np.array([action], np.float32))
        rewards.append(reward)
        assert not truncated
    return seen, rewards


@pytest.mark.parametrize("env_id", PROBES)
def test_probes_are_worth_what_they_say(env_id: str) -> None:
    env = make(env_id).unwrapped
    assert type(env) is PROBES[env_id]
    for seed in range(10):
        seen, rewards = rollout(env, seed)
        value = 0.0
        for obs, reward in reversed(list(zip(seen, rewards, strict=True))):
            value = reward + DISCOUNT * value
            assert value == pytest.approx(env.value(obs, DISCOUNT), abs=1e-12)


def test_the_values_themselves() -> None:
    assert rollout(make("toy/probe_1-v0"), 0) == ([0.0], [1.0])
    assert {rollout(make("toy/probe_2-v0"), seed)[1][0] for seed in range(10)} == {-1.0, 1.0}
    assert rollout(make("toy/probe_3-v0"), 0) == ([0.0, 1.0], [0.0, 1.0])
    assert DelayedReward().value(0.0, DISCOUNT) == DISCOUNT


@pytest.mark.parametrize(("env_id", "best"), [("toy/probe_4-v0", lambda obs: 0.5), ("toy/probe_5-v0", lambda obs: obs / 2)])
def test_only_the_best_action_earns_most(env_id: str, best: object) -> None:
    env = make(env_id)
    for seed in range(4):
        actions = np.linspace(-1.0, 1.0, 21)
        rewards = []
        for action in actions:
            obs, _ = env.reset(seed=seed)
            rewards.append(env.step(np.array([action]))[1])
        assert actions[np.argmax(rewards)] == pytest.approx(best(float(obs[0])))
        assert rewards[0] == pytest.approx(-((-1.0 - best(float(obs[0]))) ** 2))


@pytest.mark.parametrize("env_id", ["toy/point_mass-v0", "toy/probe_4-v0"])
def test_toys_refuse_actions_out_of_range(env_id: str) -> None:
    env: gymnasium.Env = make(env_id).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"must lie in \[-1, 1\]"):
        env.step(np.full(env.action_space.shape, 1.01))
