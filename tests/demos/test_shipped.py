"""Included data: plain Minari reads the demonstrations, their actions replay, and the policies reach their returns."""

from __future__ import annotations

import tomllib
from pathlib import Path

import minari
import numpy as np
import pytest

from pcil import demos, envs
from pcil.card import card
from pcil.demos import inspect
from pcil.policy import load_policy

TASKS = demos.shipped_tasks()
ROOT = Path(__file__).parent.parent.parent
POLICIES = demos.SHIPPED.parent / "policies"


def test_the_quickstart_has_its_demonstrations() -> None:
    assert TASKS[:10] == sorted(envs.TASKS) and {"Hopper-v5", "Walker2d-v5"} <= set(TASKS[10:])


@pytest.mark.parametrize("task", TASKS)
def test_plain_minari_reads_ten_episodes_of_the_environments_sizes(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(demos.SHIPPED))
    suite, steps = ("dmc", 500) if task in envs.TASKS else ("gymnasium", 1000)
    dataset = minari.load_dataset(f"{suite}/{task}/expert-v0")
    spec = envs.spec(envs.make(task))
    assert (dataset.total_episodes, dataset.total_steps) == (10, 10 * steps)
    for episode in dataset.iterate_episodes():
        assert episode.observations.shape == (steps + 1, spec.obs_dim) and episode.actions.shape == (steps, spec.action_dim)
        assert episode.truncations[-1] and not episode.terminations.any()


@pytest.mark.parametrize("task", TASKS)
def test_a_dataset_is_found_by_its_task_and_by_its_id(task: str) -> None:
    suite = "dmc" if task in envs.TASKS else "gymnasium"
    assert demos.Demonstrations.load(f"{suite}/{task}/expert-v0").hash == demos.Demonstrations.load(task).hash


@pytest.mark.parametrize("task", TASKS)
def test_one_episode_replays_from_its_seed(task: str) -> None:
    """The same observations and rewards, bit for bit: dm_control and MuJoCo are pinned for this."""
    episode = demos.Demonstrations.load(task).episodes[3]
    env = envs.make(task)
    obs = [env.reset(seed=episode.seed)[0]]
    rewards = []
    for action in episode.action:
        step = env.step(action)
        obs.append(step[0])
        rewards.append(step[1])
    assert np.array_equal(np.stack(obs), episode.obs)
    assert np.allclose(rewards, episode.reward, rtol=1e-12, atol=0)


@pytest.mark.parametrize("task", TASKS)
def test_the_policy_still_reaches_the_tables_return(task: str) -> None:
    """Two episodes selected by the same rule, each within four standard deviations (or 5%) of the demonstrations' mean."""
    shipped = demos.Demonstrations.load(task)
    rule, policy = shipped.info["record_minimum_return"], load_policy(POLICIES / task)
    rule = None if rule is None else float(rule)
    played = demos.record(policy, envs.make(task), 2, task=task, seed=11, minimum_return=rule, info={})
    tolerance = max(4 * shipped.return_std, 0.05 * shipped.return_mean)
    assert np.abs(played.returns - shipped.return_mean).max() < tolerance


@pytest.mark.parametrize("task", TASKS)
def test_no_shipped_episode_is_a_failed_one(task: str) -> None:
    """All satisfy the rule of experiments/experts.toml, and none has less than half of the task's mean."""
    rule = {"minimum_return": 100} | tomllib.loads((ROOT / "experiments" / "experts.toml").read_text())[task]
    shipped = demos.Demonstrations.load(task)
    assert shipped.returns.min() >= max(rule["minimum_return"], shipped.returns.mean() / 2)
    assert shipped.info["record_minimum_return"] in (None, rule["minimum_return"])


@pytest.mark.parametrize("task", TASKS)
def test_the_table_says_where_it_comes_from(task: str) -> None:
    row = next(row for row in inspect.shipped() if row["task"] == task)
    info = demos.Demonstrations.load(task).info
    assert row["frames"] >= 100_000 and row["seeds_tried"] >= 1 and len(row["hash"]) == 64
    about = load_policy(POLICIES / task).info
    for name in ("command", "seed", "frames", "commit", "run"):
        assert about[name] == info[name]
    assert len(info["commit"].rstrip("+")) == 40 and info["command"] and info["run"]["method"] == "expert"


@pytest.mark.parametrize("task", TASKS)
def test_the_shipped_policy_has_its_card(task: str) -> None:
    """`experiments/experts.py` writes it when it replaces a policy."""
    folder = POLICIES / task
    assert (folder / "README.md").read_text() == card(task, load_policy(task).info, "mit", task)
