"""Our DeepMind Control environments compared with dm_control itself: every number of every step, bit for bit."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pcil.envs import TASKS, make
from pcil.envs.dmc import DMCEnv, import_suite, split_name
from pcil.envs.views import views_for
from pcil.errors import InputError

suite = import_suite()

from dm_control.rl.control import PhysicsError  # noqa: E402  after `import_suite`, which keeps OpenGL out
from dm_control.suite.wrappers import action_scale  # noqa: E402

OTHER_TASKS = ("ball_in_cup_catch", "lqr_lqr_2_1", "humanoid_CMU_run", "reacher_easy")


class Outcome(NamedTuple):
    obs: np.ndarray
    reward: float
    last: bool
    discount: float


class Reference:
    """A new dm_control environment, with actions scaled to [-1, 1] if the task has other bounds."""

    def __init__(self, task: str, seed: int) -> None:
        env = suite.load(*split_name(task, suite.ALL_TASKS), task_kwargs={"random": seed})
        bounds = env.action_spec()
        self.physics = env.physics
        self.scaled = bool(np.any(bounds.minimum != -1) or np.any(bounds.maximum != 1))
        self.env = action_scale.Wrapper(env, -1, 1) if self.scaled else env

    def reset(self) -> np.ndarray:
        return flat(self.env.reset().observation)

    def step(self, action: np.ndarray, repeat: int = 2) -> Outcome:
        total = 0.0
        for _ in range(repeat):
            step = self.env.step(action)
            total += step.reward
            if step.last():
                break
        return Outcome(flat(step.observation), total, step.last(), step.discount)


def flat(observation: dict) -> np.ndarray:
    return np.concatenate([np.ravel(entry) for entry in observation.values()]).astype(np.float32)


def actions_for(env: DMCEnv, steps: int, seed: int) -> np.ndarray:
    """Uniform actions with stretches at the bounds and at 0."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)
    actions[steps // 5 : 2 * steps // 5] = np.sign(actions[steps // 5 : 2 * steps // 5])
    actions[3 * steps // 5 : 4 * steps // 5] = 0.0
    return actions


def assert_same_episode(env: DMCEnv, task: str, seed: int, steps: int) -> tuple[int, Outcome]:
    """Run both for `steps` steps or to the end; returns the number of steps and dm_control's last result."""
    reference = Reference(task, seed)
    obs, info = env.reset(seed=seed)
    np.testing.assert_array_equal(obs, reference.reset())
    assert info == {}
    for number, action in enumerate(actions_for(env, steps, seed), start=1):
        expected = reference.step(action)
        obs, reward, terminated, truncated, info = env.step(action)
        assert obs.dtype == np.float32 and isinstance(reward, float)
        np.testing.assert_array_equal(obs, expected.obs, err_msg=f"{task}, step {number}")
        assert reward == expected.reward, f"{task}, step {number}"
        assert (terminated or truncated) == expected.last
        assert terminated == (expected.last and expected.discount == 0.0)
        assert info == {"frames": 2 * number}
        if expected.last:
            break
    return number, expected


@pytest.mark.parametrize("task", TASKS)
def test_two_whole_episodes_are_dm_controls(task: str) -> None:
    env = make(task)
    for seed in (7, 8):
        steps, end = assert_same_episode(env, task, seed, 500)
        assert steps == 500 and end.last and end.discount == 1.0  # a time limit, not a termination


@pytest.mark.parametrize("task", OTHER_TASKS)
def test_any_task_of_the_suite_is_dm_controls(task: str) -> None:
    env = make(task)
    for seed in (7, 8):
        assert_same_episode(env, task, seed, 500 if task == "ball_in_cup_catch" else 40)


@pytest.mark.parametrize("task", TASKS)
def test_views_agree_in_states_that_are_rewarded(task: str) -> None:
    """A random policy never reaches most values of some rewards, so states near and far from the start are set directly."""
    env = make(task).unwrapped
    env.reset(seed=0)
    dm_task, physics = env._env.task, env.physics
    model, data = physics.model.ptr, physics.data.ptr
    fill_observation, reward = views_for(task)(env._env)
    rng, row, rewards = np.random.default_rng(0), np.empty(env.observation_space.shape, np.float32), []
    for _ in range(300):
        data.qpos[:] = model.qpos0 + rng.uniform(0.0, 1.0) * rng.normal(size=model.nq)
        data.qvel[:] = 10.0 * rng.normal(size=model.nv)
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        data.act[:] = rng.normal(size=model.na)
        mujoco.mj_forward(model, data)
        fill_observation(row)
        rewards.append(reward())
        np.testing.assert_array_equal(row, flat(dm_task.get_observation(physics)))
        assert rewards[-1] == float(dm_task.get_reward(physics)) and isinstance(rewards[-1], float)
    assert np.mean(np.array(rewards) > 0.0) > 0.01 and len(set(rewards)) > 1


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "name"), [names for names in suite.ALL_TASKS if names[1] != "lqr_6_2"])
def test_every_task_of_the_suite_is_dm_controls(domain: str, name: str) -> None:
    """All except lqr_6_2, whose action bounds are +-1e10, so that random actions make it diverge."""
    try:
        env = make(f"{domain}_{name}")
    except InputError as error:  # quadruped_escape needs OpenGL
        pytest.skip(str(error))
    for seed in (7, 8):
        assert_same_episode(env, f"{domain}_{name}", seed, 50)


def test_a_task_that_ends_with_discount_zero_terminates_at_once() -> None:
    env, reference = make("lqr_lqr_2_1"), Reference("lqr_lqr_2_1", 3)
    env.reset(seed=3)
    reference.reset()
    for physics in (env.unwrapped.physics, reference.physics):
        physics.set_state(np.zeros(4))  # within the goal's tolerance
        physics.forward()
    expected = reference.step(np.zeros(1))
    obs, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert expected.last and expected.discount == 0.0
    np.testing.assert_array_equal(obs, expected.obs)
    assert (reward, terminated, truncated, info) == (expected.reward, True, False, {"frames": 1})
    with pytest.raises(Exception, match="call reset"):
        env.step(np.zeros(1))


def test_an_episode_that_ends_inside_the_repeat_stops_there() -> None:
    env, reference = DMCEnv("pendulum_swingup", action_repeat=3), Reference("pendulum_swingup", 5)
    env.reset(seed=5)
    reference.reset()
    for action in actions_for(env, 334, seed=0):
        obs, reward, _, truncated, info = env.step(action)
        expected = reference.step(action, repeat=3)
        assert (reward, truncated) == (expected.reward, expected.last)
    np.testing.assert_array_equal(obs, expected.obs)
    assert truncated and info == {"frames": 1000}


def test_an_episode_is_a_function_of_its_seed() -> None:
    def episode(env: DMCEnv, seed: int | None) -> np.ndarray:
        rows = [env.reset(seed=seed)[0]]
        return np.stack(rows + [env.step(action)[0] for action in actions_for(env, 20, seed=0)])

    first, second = make("cheetah_run"), make("cheetah_run")
    original, other = episode(first, 3), episode(first, 4)
    np.testing.assert_array_equal(episode(first, 3), original)
    np.testing.assert_array_equal(episode(second, 3), original)
    assert not np.array_equal(other, original)
    unseeded = episode(second, None)  # determined by the previous seed
    episode(first, 3)
    np.testing.assert_array_equal(episode(first, None), unseeded)
    assert not np.array_equal(unseeded, original)
    assert not np.array_equal(episode(first, None), unseeded)


@pytest.mark.parametrize("bad", [1.0000001, -1.5, np.nan, np.inf])
def test_actions_out_of_range_are_refused(bad: float) -> None:
    env = make("walker_walk").unwrapped
    env.reset(seed=0)
    action = np.zeros(6, np.float32)
    action[4] = bad
    with pytest.raises(ValueError, match=r"must lie in \[-1, 1\]; got"):
        env.step(action)
    with pytest.raises(ValueError, match=r"shape \(6,\) was expected; got shape \(5,\)"):
        env.step(np.zeros(5))
    for bound in (-1.0, 1.0):
        env.step(np.full(6, bound))


def test_actions_reach_the_bounds_of_quadruped() -> None:
    env = make("quadruped_run").unwrapped
    bounds = env._env.action_spec()
    assert Reference("quadruped_run", 0).scaled and bounds.maximum.max() == 1.1
    np.testing.assert_array_equal(env.control_signal(np.full(12, -1.0)), bounds.minimum)
    np.testing.assert_allclose(env.control_signal(np.ones(12)), bounds.maximum, rtol=1e-15)
    assert not make("walker_walk").unwrapped._rescale


def test_a_task_with_its_own_step_is_left_to_itself() -> None:
    env, plain = make("walker_walk").unwrapped, make("walker_walk").unwrapped

    class Weaker(type(env._env.task)):
        def before_step(self, action: np.ndarray, physics: object) -> None:
            super().before_step(action / 2, physics)

    env._env.task.__class__ = Weaker
    env.reset(seed=0)
    plain.reset(seed=0)
    assert env._advance.__qualname__ != plain._advance.__qualname__
    for action in actions_for(env, 10, seed=0):
        obs, *_ = env.step(action)
        expected, *_ = plain.step(action.astype(np.float64) / 2)
        np.testing.assert_array_equal(obs, expected)


def test_a_diverged_simulation_raises_dm_controls_error() -> None:
    env, reference = make("walker_walk").unwrapped, Reference("walker_walk", 0)
    env.reset(seed=0)
    reference.reset()
    for physics in (env.unwrapped.physics, reference.physics):
        physics.data.qvel[:] = 1e30
    with pytest.raises(PhysicsError) as expected:
        reference.step(np.zeros(6))
    with pytest.raises(PhysicsError) as raised:
        env.step(np.zeros(6))
    assert str(raised.value) == str(expected.value)
    assert_same_episode(env, "walker_walk", seed=1, steps=5)  # the error has no later effect


def test_physics_is_reachable() -> None:
    env = make("walker_walk")
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(obs[-9:], env.unwrapped.physics.data.qvel.astype(np.float32))


@pytest.mark.filterwarnings("ignore:.*A Box observation space")
@pytest.mark.parametrize("task", ["pendulum_swingup", "reacher_easy"])
def test_gymnasiums_own_checks_pass(task: str) -> None:
    check_env(make(task).unwrapped, skip_render_check=True)


def test_loading_says_nothing_and_mutes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """dm_control itself warns about cheetah's model file, so there is a warning to suppress."""
    logger = logging.getLogger("absl")
    level = logger.level
    with caplog.at_level(logging.WARNING, "absl"):
        import_suite().load("cheetah", "run")
        assert "deprecated" in caplog.text
        caplog.clear()
        DMCEnv("cheetah_run")
        assert not caplog.text and logger.level == logging.WARNING
    assert logger.level == level


def test_names_that_are_none() -> None:
    with pytest.raises(InputError, match="no task 'walker_fly'"):
        DMCEnv("walker_fly")
    with pytest.raises(InputError, match="action_repeat"):
        DMCEnv("walker_walk", action_repeat=0)


def test_no_opengl_is_needed_and_none_is_kept_away() -> None:
    """In a new process without display or MUJOCO_GL; importing pcil.envs must not import dm_control either."""
    program = (
        "import os, sys, pcil.envs\n"
        "assert 'dm_control' not in sys.modules and 'mujoco' not in sys.modules\n"
        "env = pcil.envs.make('pendulum_swingup'); env.reset(seed=0); env.step([0.5])\n"
        "assert 'OpenGL' not in sys.modules and 'glfw' not in sys.modules and 'MUJOCO_GL' not in os.environ\n"
    )
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)


def test_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """dm_control was imported earlier without OpenGL; an environment can still render, or says what is missing."""
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    with pytest.raises(InputError, match=r"install EGL .* MUJOCO_GL=egl, or OSMesa"):
        make("walker_walk", render_mode="rgb_array")
    monkeypatch.delenv("MUJOCO_GL")
    try:
        env = make("walker_walk", render_mode="rgb_array")
    except InputError as error:
        pytest.skip(str(error))
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (240, 320, 3) and picture.dtype == np.uint8 and picture.std() > 1.0
    env.close()
    assert make("walker_walk").render() is None
