"""Survival bias and its removal by absorbing states: an environment that may end early, and a constant reward.

Kostrikov et al. 2019, section 4.2: if every step has the same reward, an agent to which an end has value 0 tries to survive (or
to end the episode, if the reward is negative), whatever the demonstrations show.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from pcil import demos, envs
from pcil.agents import BC, DrQV2
from pcil.demos import Demonstrations
from pcil.envs.toy import Reach
from pcil.errors import InputError
from pcil.policy import Policy
from pcil.rewards import TaskReward
from pcil.training import fit, loop, presets, runs, state
from pcil.training.callbacks import Callback
from pcil.training.config import changed
from pcil.training.replay import Replay
from pcil.types import Episode
from small import POINT_MASS, narrow, save_point_mass_demos, small_run

GAMMA = 0.9
EXIT = "pcil_test/exit-v0"


class Exit(gymnasium.Env):
    """Nothing ever changes, and an action above 0 ends the episode; it is truncated after 20 steps."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros(1, np.float32), 0.0, bool(action[0] > 0), False, {}


@pytest.fixture(autouse=True)
def _registered() -> Any:
    gymnasium.register(EXIT, Exit, max_episode_steps=20)
    yield
    del gymnasium.registry[EXIT]


def trained(pay: float, absorbing: bool, folder: Path, n_step: int = 1) -> state.State:
    """Train on uniform actions only, so that both kinds of action occur regardless of the agent's policy."""
    agent = narrow(DrQV2(), learning_rate=3e-3, hidden=32, tau=0.05, gamma=GAMMA, n_step=n_step, absorbing=absorbing)
    changes = {"frames": 1500, "random_frames": 1500, "evaluate_every": 1500, "update_every": 1, "agent": agent}
    run = dataclasses.replace(small_run("expert", EXIT, **changes), reward=TaskReward(task_weight=0.0, constant=pay))
    folder.mkdir()
    return loop.train_loop(run, folder, ())


def value(ended: state.State, action: float, absorbing: bool) -> float:
    obs = jnp.zeros((1, 2 if absorbing else 1))
    return float(np.min([q[0] for q in ended.learner.agent.critic(obs, jnp.full((1, 1), action))]))


@pytest.mark.parametrize("pay", [1.0, -1.0])
def test_without_absorbing_states_an_end_is_worth_nothing(pay: float, tmp_path: Path) -> None:
    """The value of staying is `pay / (1 - gamma)` if that is positive, else that of one more step; of leaving, one reward."""
    state = trained(pay, False, tmp_path / "run")
    stay = pay / (1 - GAMMA) if pay > 0 else pay + GAMMA * pay
    assert value(state, 0.9, False) == pytest.approx(pay, abs=0.3)
    assert value(state, -0.9, False) == pytest.approx(stay, rel=0.15)


@pytest.mark.parametrize(("pay", "n_step"), [(1.0, 1), (-1.0, 1), (1.0, 3)])
def test_with_absorbing_states_an_end_is_worth_what_every_other_state_is(pay: float, n_step: int, tmp_path: Path) -> None:
    state = trained(pay, True, tmp_path / "run", n_step)
    for action in (0.9, -0.9):
        assert value(state, action, True) == pytest.approx(pay / (1 - GAMMA), rel=0.15)


def test_the_policy_of_an_absorbing_run_takes_the_environments_own_observations(tmp_path: Path) -> None:
    trained(1.0, True, tmp_path / "run")
    policy: Policy = runs.load_policy(tmp_path / "run")
    assert policy.spec.obs_dim == envs.spec(envs.make(EXIT)).obs_dim == 1
    assert policy(np.zeros(1, np.float32)).shape == (1,)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("steps", [1, 2, 5])
def test_the_absorbing_state_is_the_first_of_one_window_as_every_other_state(n: int, steps: int) -> None:
    """Its value is therefore learned, on which every target near an end depends."""
    obs = np.arange(1, steps + 2, dtype=np.float32)[:, None]
    episode = Episode(obs, np.zeros((steps, 1), np.float32), np.zeros(steps), terminated=True).absorbed(n)
    window = Replay.of([episode]).sample(np.random.default_rng(0), 1000, n)
    firsts, counts = np.unique(window.obs[:, 0], axis=0, return_counts=True)
    assert firsts[:, 1].tolist() == [1.0] + [0.0] * steps and len(counts) == steps + 1


def test_cloning_has_no_absorbing_states() -> None:
    with pytest.raises(InputError, match="no absorbing states"):
        BC(absorbing=True)


# --- The default ---


def demos_of(task: str, folder: Path, ends: int = 0) -> str:
    """Four demonstrations, of which `ends` are marked as terminated."""
    source = Demonstrations.load(save_point_mass_demos(folder))
    episodes = [dataclasses.replace(e, terminated=i < ends) for i, e in enumerate(source.episodes)]
    return str(dataclasses.replace(source, task=task, episodes=tuple(episodes)).save(folder / f"ends-{ends}-v0"))


class Told(Callback):
    """Keeps the messages, and stops after the first episode."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def message(self, text: str) -> None:
        self.said.append(text)

    def stop(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("method", "changes", "ends", "absorbing", "why"),
    [
        ("pcil", {}, 0, False, "no episode of toy/point_mass-v0 ends early"),
        ("dac", {}, 3, True, "3 of 4 demonstrations end early"),
        ("pcil", {"agent.absorbing": False}, 3, False, "as agent.absorbing says"),
        ("expert", {}, 0, False, "no reward is learned"),
        ("bc", {}, 4, False, "no reward is learned"),
    ],
)
def test_absorbing_states_are_on_where_the_reward_is_learned_and_an_episode_may_end_early(
    method: str, changes: dict[str, Any], ends: int, absorbing: bool, why: str, tmp_path: Path
) -> None:
    data = demos_of(POINT_MASS, tmp_path, ends) if method != "expert" else None
    run = changed(small_run(method, demos=data), changes)
    if method == "bc":
        run = dataclasses.replace(run, agent=narrow(BC()), frames=1200)
    told = Told()
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "run", [told])
    assert told.said[0] == f"Absorbing state: {'on' if absorbing else 'off'}; {why}."
    assert json.loads((tmp_path / "run" / "run.json").read_text())["run"]["agent"]["absorbing"] is absorbing
    with pytest.raises(loop.Stopped):  # the same command resumes the run
        runs.execute(run, tmp_path / "run", [told])
    assert any("Resuming" in text for text in told.said)


def test_an_environment_that_does_not_say_so_is_taken_to_end_early_and_the_ten_tasks_do_not() -> None:
    assert envs.ends_early(envs.make(EXIT)) and envs.ends_early(envs.make("toy/reach-v0"))
    assert not envs.ends_early(envs.make("pendulum_swingup"))
    run, why = fit.with_absorbing_decided(presets.make(EXIT), Demonstrations(EXIT, (), {}), envs.ends_early(envs.make(EXIT)))
    assert run.agent.absorbing and why == f"an episode of {EXIT} may end early"


@pytest.mark.parametrize(("steps", "terminated", "n_step", "rows"), [(7, True, 1, 14), (1, True, 3, 4), (7, False, 1, 7)])
def test_an_early_end_has_as_many_absorbing_steps_as_it_had_steps_before(
    steps: int, terminated: bool, n_step: int, rows: int
) -> None:
    """Otherwise the end of a short demonstration would have less weight than other states."""
    episode = Episode(np.zeros((steps + 1, 1), np.float32), np.zeros((steps, 1), np.float32), np.zeros(steps), terminated)
    run = changed(small_run("expert"), {"agent.absorbing": True, "agent.n_step": n_step})
    assert len(state.absorbed(run, episode)) == rows
    assert state.absorbed(changed(run, {"agent.absorbing": False}), episode) is episode


@pytest.mark.slow
def test_by_default_imitation_reaches_a_goal_that_ends_the_episode(tmp_path: Path) -> None:
    """PCIL's rewards are positive, so without the absorbing state it would stay away from the goal."""
    task, expert = "toy/reach-v0", lambda obs: Reach.optimal_action(obs).astype(np.float32)
    data = demos.record(expert, envs.make(task), 10, task=task, seed=0, info={}).save(tmp_path / "reach-v0")
    run = presets.make(task, frames=8000, demos=str(data), evaluate_every=8000, evaluate_episodes=50)
    runs.execute(run, tmp_path / "run")
    last = [row for row in csv.DictReader((tmp_path / "run" / "eval.csv").open()) if int(row["frames"]) >= 8000]
    assert np.mean([int(row["length"]) < Reach.NUM_STEPS for row in last]) > 0.9
