"""Settings: every preset makes a run, the paper preset has the paper's numbers, and invalid settings are refused."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
import pytest

from pcil.agents import AGENTS, BC, DrQV2
from pcil.envs import TASKS
from pcil.errors import InputError, check_kinds
from pcil.files import flat
from pcil.rewards import PCIL, REWARDS, TaskReward
from pcil.training import presets
from pcil.training.config import Run, differences, registered, renamed

EVERY_RUN = sorted(itertools.product(presets.METHODS, presets.PRESETS))


@dataclass(frozen=True)
class Needy(TaskReward):
    """Has a setting without a default."""

    weight: float = field(kw_only=True)


@dataclass(frozen=True)
class WholeEpisodes(TaskReward):
    """Like PWIL's reward, it needs the steps of an episode in order."""

    scope: ClassVar[Literal["step", "episode"]] = "episode"


def to_json(run: Run) -> dict[str, Any]:
    """The settings after a round trip through JSON, as in `run.json`."""
    return json.loads(json.dumps(run.to_json()))


# --- Presets ---


def test_what_a_method_changes_is_of_presets_that_exist() -> None:
    assert all(set(settings) <= {"every preset", *presets.PRESETS} for settings in presets.METHOD_SETTINGS.values())


@pytest.mark.parametrize(("method", "preset"), EVERY_RUN)
def test_a_preset_makes_a_run_that_survives_json(method: str, preset: str) -> None:
    for task in TASKS:
        run = presets.make(task, method, preset)
        assert (run.task, run.method, run.preset) == (task, method, preset)
        assert type(run.reward) in REWARDS.values()
        assert to_json(run) == run.to_json()
        assert differences(to_json(run), run.to_json()) == []


@pytest.mark.parametrize(("method", "preset"), EVERY_RUN)
def test_equal_settings_share_one_compilation(method: str, preset: str) -> None:
    """The compiled function is found by a hash that does not depend on seed, frames and the task's name."""
    one, two = presets.make("cheetah_run", method, preset), presets.make("hopper_hop", method, preset, seed=7)
    assert one.learner == two.learner and hash(one.learner) == hash(two.learner)
    wider = dataclasses.replace(one, agent=dataclasses.replace(one.agent, hidden=512))
    assert wider.learner != one.learner


@pytest.mark.parametrize("task", TASKS)
def test_the_paper_preset_is_the_papers_table(task: str) -> None:
    """Appendix B, table of hyperparameters (paper.tex, label table:hyper); the penalty is from the authors' agent/pcil.py."""
    run = presets.make(task, "pcil", "paper")
    assert isinstance(run.agent, DrQV2)
    assert run.replay_steps == 500_000
    assert run.update_every == 2
    assert run.agent.learning_rate == run.reward.learning_rate == 1e-4
    assert run.agent.tau == 0.01
    assert run.agent.batch_size == 128
    assert run.agent.hidden == run.reward.hidden == 256
    assert run.reward.batch_size == 256 * 0.5, "discriminator batch of 256, half of which is expert data"
    assert run.reward.temperature == 0.07
    assert run.reward.penalty == 10


def test_the_released_preset_never_applies_the_temperature_and_stores_rewards() -> None:
    """As in the authors' agent/pcil.py and train.py."""
    run = presets.make("walker_walk", "pcil", "released")
    assert run.reward.temperature == 1 and run.label == "stored"
    assert run.agent.hidden == run.reward.hidden == 1024 and run.agent.batch_size == 512


def test_presets_can_be_changed_in_any_field() -> None:
    run = presets.make("walker_walk", "dac", "paper", seed=3, frames=5000, label="sampled")
    assert (run.seed, run.frames, run.label) == (3, 5000, "sampled")
    assert dataclasses.replace(run, seed=1, frames=2_000_000, label="stored") == presets.make("walker_walk", "dac", "paper")


def test_nested_settings_change_by_dotted_names() -> None:
    run = presets.make("walker_walk", **{"agent.noise.steps": 7, "agent.gamma": 0.9, "reward.penalty": 0.0, "seed": 3})
    assert (run.agent.noise.steps, run.agent.gamma, run.reward.penalty, run.seed) == (7, 0.9, 0.0, 3)
    assert (run.agent.noise.start, run.agent.tau) == (1.0, 0.01), "other settings are unchanged"


@pytest.mark.parametrize("name", ["speed", "agent.speed", "agent.noise.speed", "seed.speed"])
def test_settings_that_do_not_exist_are_refused_with_those_that_do(name: str) -> None:
    known = {"agent.speed": "gamma", "agent.noise.speed": "steps"}.get(name, "frames")
    with pytest.raises(InputError, match=rf"has no setting '\S*speed'; it has .*\b{known}\b.*\.$"):
        presets.make("walker_walk", **{name: 1})


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"no method 'gail'.*pcil, dac, .*expert"):
        presets.make("walker_walk", "gail")
    with pytest.raises(InputError, match=r"no preset 'best'.*default, reward-only, paper, released"):
        presets.make("walker_walk", "pcil", "best")


# --- Differences ---


def test_differences_name_what_changed_however_deep() -> None:
    run = presets.make("walker_walk")
    agent = dataclasses.replace(run.agent, gamma=0.9, noise=dataclasses.replace(run.agent.noise, steps=7))
    other = dataclasses.replace(run, seed=2, agent=agent)
    assert differences(to_json(run), to_json(other)) == [
        "seed was 1, now 2",
        "agent.gamma was 0.99, now 0.9",
        f"agent.noise.steps was {run.agent.noise.steps}, now 7",
    ]


def test_another_reward_is_a_difference_even_where_its_settings_are_equal() -> None:
    run = presets.make("walker_walk", "expert")
    found = differences(to_json(run), to_json(dataclasses.replace(run, label="stored", reward=WholeEpisodes())))
    assert found[-1].startswith("reward.class was expert, now ") and "WholeEpisodes" in found[-1]


def test_fields_that_one_side_lacks_are_differences() -> None:
    assert differences({"a": 1}, {"b": {"c": 2}}) == ["a was 1, now None", "b was None, now {'c': 2}"]


def test_a_setting_that_an_older_run_lacks_had_its_classes_default() -> None:
    """A run of an older version can thus be resumed, and only a value other than its default is a difference."""
    run = dataclasses.replace(presets.make("walker_walk"), clip_actions=True)
    older = to_json(run)
    del older["agent"]["noise_correlation"], older["agent"]["normalize_observations"], older["agent"]["noise"]["end"]
    del older["agent"]["absorbing"], older["clip_actions"]
    found = differences(flat(to_json(Run.from_json(older))), flat(to_json(run)))
    assert run.agent.normalize_observations and not DrQV2().normalize_observations
    assert sorted(found) == [
        "agent.absorbing was False, now None",
        "agent.normalize_observations was False, now True",
        "clip_actions was False, now True",
    ]


@pytest.mark.parametrize(("method", "preset"), EVERY_RUN)
def test_from_json_gives_back_the_run_that_was_written(method: str, preset: str) -> None:
    run = presets.make("walker_walk", method, preset, seed=7, env_kwargs={"a": {"b": [1, 2.5]}})
    assert Run.from_json(to_json(run)) == Run.from_json(flat(to_json(run))) == run


def test_a_class_that_a_file_names_is_made_only_where_it_is_given() -> None:
    """Even if it can't be made without one of its settings."""
    run = dataclasses.replace(presets.make("walker_walk", "expert"), reward=Needy(weight=3.0, task_weight=2.0))
    path = f"{Needy.__module__}:Needy"
    with pytest.raises(InputError, match=f"The reward '{path}' is not part of this package"):
        Run.from_json(to_json(run))
    assert Run.from_json(to_json(run), {path: Needy}) == run


def test_a_setting_by_the_name_of_an_older_version_is_the_one_of_today() -> None:
    run = presets.make("walker_walk", **{"agent.standardise": False})
    assert run == presets.make("walker_walk", **{"agent.normalize_observations": False})
    older = to_json(run)
    older["agent"]["standardise"] = older["agent"].pop("normalize_observations")
    assert Run.from_json(older) == run


def test_an_agent_that_is_not_the_methods_own_has_the_defaults_of_its_class() -> None:
    run = presets.make("walker_walk", agent="bc", **{"agent.hidden": 32})
    assert run.agent == BC(hidden=32)
    assert presets.make("walker_walk", agent="drqv2") == presets.make("walker_walk")
    with pytest.raises(InputError, match=r"--agent 'nobody' can't be loaded .* one of drqv2, bc, or my.module:MyAgent"):
        presets.make("walker_walk", agent="nobody")


def test_how_often_to_save_is_no_difference() -> None:
    run = presets.make("walker_walk")
    assert differences(to_json(run), to_json(dataclasses.replace(run, checkpoint_seconds=1.0))) == []


# --- Refusals ---


def test_an_episode_reward_cannot_label_samples() -> None:
    assert presets.make("walker_walk", label="stored", reward=WholeEpisodes()).label == "stored"
    with pytest.raises(InputError, match=r"WholeEpisodes needs whole episodes.*--label stored"):
        presets.make("walker_walk", label="sampled", reward=WholeEpisodes())


def test_the_rewards_batch_fits_into_the_agents() -> None:
    run = presets.make("walker_walk")
    half = dataclasses.replace(run.agent, batch_size=64)
    smaller = dataclasses.replace(run, agent=half, reward=dataclasses.replace(run.reward, batch_size=64))
    assert smaller.reward.batch_size == smaller.agent.batch_size
    with pytest.raises(InputError, match=r"batch of 128 agent steps.*which has 64"):
        dataclasses.replace(run, agent=half)


@pytest.mark.parametrize(
    ("name", "bad", "good"),
    [
        ("frames", 2000, 2001),
        ("frames", -1, 10_000),
        ("update_every", 0, 1),
        ("evaluate_every", 0, 1),
        ("evaluate_episodes", 0, 1),
        ("replay_steps", 0, 1),
        ("seed", -1, 0),
        ("seed", 2**31, 2**31 - 1),
    ],
)
def test_numbers_out_of_range_are_refused(name: str, bad: int, good: int) -> None:
    assert getattr(presets.make("walker_walk", **{name: good}), name) == good
    with pytest.raises(InputError, match=str(bad)) as refusal:
        presets.make("walker_walk", **{name: bad})
    sentence = str(refusal.value)
    assert sentence.endswith(".") and "\n" not in sentence and not math.isnan(good)


WHOLE = ("agent.hidden", "agent.n_step", "agent.feature_dim", "agent.batch_size", "reward.hidden", "reward.batch_size")
REAL = ("agent.gamma", "agent.learning_rate", "agent.tau", "reward.temperature", "reward.penalty")


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name in (*WHOLE, "evaluate_every", "update_every") for value in (0, -1)]
    + [(name, value) for name in REAL for value in (math.nan, -0.5)],
)
def test_settings_that_cannot_work_are_refused_when_they_are_made(name: str, value: float) -> None:
    with pytest.raises(InputError, match=rf"\w+.{name.split('.')[-1]} is {value}; it must be"):
        presets.make("walker_walk", **{name: value})


def test_nested_settings_are_reached_by_dotted_names() -> None:
    run = presets.make("walker_walk", **{"agent.noise.steps": 7, "agent.gamma": 0.5, "seed": 3})
    assert (run.agent.noise.steps, run.agent.gamma, run.seed) == (7, 0.5, 3)
    with pytest.raises(InputError, match=r"DrQV2 has no setting 'gama'; it has batch_size, "):
        presets.make("walker_walk", **{"agent.gama": 0.5})
    with pytest.raises(InputError, match="Run has no setting 'fames'"):
        presets.make("walker_walk", fames=5)


def test_what_is_given_whole_keeps_its_settings_under_every_preset() -> None:
    """A preset changes settings of its own agent and reward, never of a given one."""
    assert presets.make("walker_walk", preset="released", reward=PCIL(batch_size=64)).reward == PCIL(batch_size=64)
    agent = DrQV2(batch_size=512)
    assert presets.make("walker_walk", "pwil", "released", agent=agent).agent == agent


@dataclass(frozen=True)
class Kinds:
    """One field of each kind that settings have."""

    word: Literal["sampled", "stored"] = "sampled"
    whole: int = 1
    number: float = 0.5
    maybe: int | None = None
    switch: bool = False
    text: str = "a"
    own: TaskReward = field(default_factory=TaskReward)
    other: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_kinds(self)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"word": "store"}, "Kinds.word is 'store'; it must be one of 'sampled', 'stored'"),
        ({"whole": 1.5}, "Kinds.whole is 1.5; it must be a whole number"),
        ({"whole": True}, "must be a whole number"),
        ({"whole": "9"}, "Kinds.whole is '9'; it must be a whole number"),
        ({"maybe": 2.5}, "must be a whole number or None"),
        ({"number": "high"}, "Kinds.number is 'high'; it must be a number"),
        ({"switch": 1}, "must be True or False"),
        ({"text": 3}, "must be text"),
        ({"own": "task"}, "must be of class TaskReward"),
    ],
)
def test_a_setting_of_another_kind_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Kinds(**change)


def test_numpys_numbers_are_numbers() -> None:
    taken = Kinds(whole=np.int64(3), number=np.float32(0.5), maybe=np.int32(1))
    assert (taken.whole, taken.number, taken.maybe) == (3, 0.5, 1)
    assert Kinds(number=3, other="what is not known is not judged").other


def test_no_third_word_is_taken_in_python_either() -> None:
    """The loop compares with each of the two. Runs in a separate process, without the type checks of the tests."""
    code = "from pcil.training import presets; presets.make('walker_walk', label='store')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "InputError: Run.label is 'store'; it must be one of 'sampled', 'stored'" in done.stderr


@pytest.mark.parametrize(
    ("task", "batch", "frames", "steps"),
    [
        ("walker_walk", 256, 1_100_000, 100_000),
        ("walker_run", 256, 3_100_000, 500_000),
        ("pendulum_swingup", 128, 1_100_000, 100_000),
        ("hopper_hop", 128, 3_100_000, 500_000),
    ],
)
def test_released_has_the_batch_of_bc_and_the_length_of_an_expert_by_task(
    task: str, batch: int, frames: int, steps: int
) -> None:
    """BC's batch is half the agent's (bz_ratio = 2); experts have DrQ-v2's settings for easy or medium tasks."""
    cloned, agent = presets.make(task, "bc", "released").agent, presets.make(task, "pcil", "released").agent
    assert cloned.batch_size == batch == agent.batch_size // 2 and cloned.hidden == agent.hidden == 1024
    expert = presets.make(task, "expert", "released")
    assert (expert.frames, expert.random_frames, expert.agent.noise.steps) == (frames, 4000, steps)
    assert presets.make(task, "bc").agent.batch_size == presets.make(task, "bc", "paper").agent.batch_size == 128
    assert presets.make(task, "expert", "released", frames=5000).frames == 5000
    assert presets.make(task, "bc", "released", **{"agent.batch_size": 7}).agent.batch_size == 7


def test_classes_go_by_their_names_in_the_registry_and_paths_of_older_files_are_known() -> None:
    """Even if a built-in class was in another module when the file was written; a user's class is named by its path."""
    for method in presets.METHODS:
        settings = presets.make("walker_walk", method).to_json()
        assert AGENTS[settings["agent"]["class"]] and REWARDS[settings["reward"]["class"]]
    assert registered("agent", "pcil.agents.drqv2:DrQV2") == registered("agent", "pcil.old.place:DrQV2") == "drqv2"
    assert registered("reward", "my.module:PCIL") == "my.module:PCIL" and registered("reward", "pcil") == "pcil"
    now = presets.make("walker_walk").to_json()
    old = {**now, "agent": {**now["agent"], "class": "pcil.agents.drqv2:DrQV2"}}
    old |= {"reward": {**now["reward"], "class": "pcil.rewards.pcil:PCIL"}}
    assert old != now and renamed(flat(old)) == renamed(flat(now)) == flat(now)
