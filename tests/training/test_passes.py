"""The passes of the loop, with a clock that is moved by hand."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from test_learner import DEMOS, SPEC, Recorder, Scribe, recorded

from pcil import envs, seeds
from pcil.errors import InputError
from pcil.seeds import Stream
from pcil.training import collect, learner, loop, state
from pcil.training.callbacks import Callback, History
from pcil.training.config import Run
from pcil.training.state import Clock, Counters
from pcil.types import Episode
from small import POINT_MASS


class StandingClock(Clock):
    """A clock that changes only when `now` is set."""

    now: ClassVar[float] = 0.0

    def __init__(self, before: float) -> None:
        super().__init__(before)
        self.before = before

    def total(self) -> float:
        return self.before + StandingClock.now

    def rate(self, frames: int) -> float:
        return frames / 37


class Heard(Callback):
    """Moves the clock by ten seconds in each episode, and records its calls."""

    def __init__(self, step: float = 10.0) -> None:
        self.step, self.runs, self.episodes, self.evaluations = step, [], [], []

    def begin(self, run: Run, folder: Path, history: History) -> None:
        self.runs.append(run)

    def episode(self, row: dict[str, Any]) -> None:
        self.episodes.append(row)
        StandingClock.now += self.step

    def evaluation(self, frames: int, seconds: float, result: Any) -> None:
        self.evaluations.append((frames, result.mean))


@pytest.fixture(autouse=True)
def _the_clock_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "Clock", StandingClock)
    monkeypatch.setattr(StandingClock, "now", 0.0)


@pytest.fixture
def saves(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The frames of each checkpoint."""
    frames: list[int] = []
    save = state.save

    def noting(folder: Path, held: Any, logs: Any, clock: Any, **named: Any) -> None:
        frames.append(held.counters.frames)
        save(folder, held, logs, clock, **named)

    monkeypatch.setattr(state, "save", noting)
    return frames


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "train.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.0, [50, 100, 150, 200, 250, 300, 350, 400]),
        (20.0, [100, 200, 300, 400]),
        (25.0, [150, 300]),
        (45.0, [250]),
        (1000.0, []),
    ],
)
def test_a_checkpoint_is_written_once_so_many_seconds_have_passed_since_the_last(
    seconds: float, expected: list[int], saves: list[int], tmp_path: Path
) -> None:
    """Each episode of 50 steps takes ten seconds; the last checkpoint is the one of the finished run."""
    loop.train_loop(recorded(frames=400, evaluate_every=400, checkpoint_seconds=seconds), tmp_path, DEMOS, [Heard()])
    assert saves == [*expected, 400]


def test_a_run_is_told_of_and_written_down_episode_by_episode(tmp_path: Path) -> None:
    run, heard = recorded(frames=150, evaluate_every=100), Heard(step=7.777)
    ended = loop.train_loop(run, tmp_path, DEMOS, [heard])
    table = lines(tmp_path)
    assert [line["frames"] for line in table] == [50, 100, 150] and [line["episode"] for line in table] == [1, 2, 3]
    assert [line["updates"] for line in table] == [0, 25, 50]
    assert [line["seconds"] for line in table] == [0.0, 7.78, 15.55]
    assert [line["frames_per_second"] for line in table] == [1.4, 2.7, 4.1]
    assert "agent/was" not in table[0]
    assert [line["agent/was"] for line in table[1:]] == [np.mean(range(25)), np.mean(range(25, 50))], (
        "the mean over its updates"
    )
    assert heard.runs == [run] and heard.episodes == table
    assert [frames for frames, _ in heard.evaluations] == [0, 100, 150]
    assert heard.evaluations[-1][1] == ended.counters.final_return
    assert ended.counters.evaluations == 2, "the last one was only due because the run ended"


def test_each_action_is_of_the_observation_before_it_and_each_episode_of_its_own_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[np.ndarray] = []

    def explorer(self: Any, action_dim: int, rng: np.random.Generator) -> Callable[..., np.ndarray]:
        return lambda actor, obs, step: seen.append(obs.copy()) or np.full(action_dim, 0.5, np.float32)

    monkeypatch.setattr(Scribe, "explorer", explorer)
    run, env = recorded(seed_frames=900), envs.make(POINT_MASS)
    held = state.start(run, SPEC, DEMOS)
    for number in range(2):
        seen.clear()
        (episode,) = collect.play(run, [env], SPEC, held)
        assert np.array_equal(seen, episode.obs[:-1])
        assert episode.seed == seeds.episode_seed(run.seed, Stream.EPISODE, number)
        assert np.array_equal(env.reset(seed=episode.seed)[0], episode.obs[0])
        assert held.counters == Counters(50 * (number + 1), 50 * (number + 1), number + 1, 0)


class Held:
    """A replay with a given number of windows of a length."""

    def __init__(self, windows: int, steps: int) -> None:
        self.windows, self.steps = windows, steps

    def num_windows(self, steps: int) -> int:
        return self.windows if steps <= self.steps else 0


@pytest.mark.parametrize(
    ("windows", "steps", "frames", "due"),
    [(1, 3, 10, True), (0, 3, 10, False), (1, 2, 10, False), (2, 3, 10, True), (1, 3, 9, False), (1, 3, 11, True)],
)
def test_an_update_is_due_from_the_seed_frames_on_where_one_window_is_there(
    windows: int, steps: int, frames: int, due: bool
) -> None:
    run: Any = recorded(agent=Scribe(n_step=3), seed_frames=10, update_every=4)
    replay: Any = Held(windows, steps)
    assert collect._update_due.__wrapped__(run, replay, Counters(frames, steps=8)) == due
    assert not collect._update_due.__wrapped__(run, replay, Counters(frames, steps=9))


def test_a_pass_is_refused_where_no_window_fits_into_any_of_its_episodes() -> None:
    """With several environments, this is decided after all episodes are stored, because a short one may come first."""

    def ended(steps: int) -> collect.Labelled:
        obs, action = np.zeros((steps + 1, 2), np.float32), np.zeros((steps, 2), np.float32)
        return collect.Labelled(Episode(obs, action, np.zeros(steps)), np.ones(steps), {})

    run = recorded(agent=Scribe(n_step=5), seed_frames=10)
    for lengths, fits in (((4, 30), True), ((30, 4), True), ((4, 4), False)):
        held = state.start(run, SPEC, DEMOS)
        held.counters = Counters(frames=34)
        with contextlib.nullcontext() if fits else pytest.raises(InputError, match="cut before the 5 steps"):
            collect.store(run, held, [ended(steps) for steps in lengths])
        assert held.replay.num_steps == sum(lengths)


def test_an_evaluation_copies_the_actor_to_the_host_once(monkeypatch: pytest.MonkeyPatch) -> None:
    copies: list[Any] = []
    plain = state.on_host
    monkeypatch.setattr(state, "on_host", lambda actor: copies.append(actor) or plain(actor))
    run = recorded()
    policy = state.start(run, SPEC, DEMOS).policy(run)
    assert all(policy(np.zeros((3, 2), np.float32)).shape == (3, 2) for _ in range(4)) and len(copies) == 1


# --- Offline ---


@dataclasses.dataclass(frozen=True)
class Reader(Scribe):
    """Learns from the demonstrations alone."""

    offline: ClassVar[bool] = True


@dataclasses.dataclass(frozen=True)
class Nothing(Recorder):
    """A reward that draws no rows."""

    batch_size: int = 0


def test_an_offline_agent_has_passes_of_500_updates_on_draws_of_the_demonstrations(
    monkeypatch: pytest.MonkeyPatch, saves: list[int], tmp_path: Path
) -> None:
    """The last pass is whole too, so that a longer run begins alike; random draws come from the stream of the pass."""
    updates: list[Any] = []
    real = learner.update

    def update(algorithm: Any, held: Any, window: Any, expert: Any, longer: Any, step: Any, count: Any, cloned: Any) -> Any:
        updates.append((window, expert, int(step), int(count)))
        assert cloned is None
        return real(algorithm, held, window, expert, longer, step, count)

    monkeypatch.setattr(learner, "update", update)
    run = recorded(agent=Reader(), frames=1203, evaluate_every=2000, checkpoint_seconds=0.0)
    heard = Heard()
    ended = loop.train_loop(run, tmp_path, DEMOS, [heard])
    assert [(line["frames"], line["episode"], line["updates"]) for line in lines(tmp_path)] == [
        (500, 1, 500),
        (1000, 2, 1000),
        (1500, 3, 1500),
    ]
    assert saves == [500, 1000, 1500, 1500] and not any("return" in row for row in heard.episodes)
    assert [step for _, _, step, _ in updates] == [count for *_, count in updates] == list(range(1500))
    assert ended.expert is not None and ended.replay.num_episodes == 0
    for number in range(3):
        rng = seeds.rng(run.seed, Stream.SAMPLE, number)
        for window, expert, *_ in updates[500 * number :][:2]:
            assert np.array_equal(window.obs, ended.expert.sample(rng, 6, 1).obs)
            assert np.array_equal(expert.obs, ended.expert.sample(rng, 3, 1).obs)


def test_the_reward_is_given_every_so_manyth_step_of_the_demonstrations(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[Any] = []
    real = learner.update
    monkeypatch.setattr(learner, "update", lambda *given: seen.append(given[3]) or real(*given))
    run = recorded(frames=300, reward=dataclasses.replace(recorded().reward, subsampling=7))
    loop.train_loop(run, tmp_path, DEMOS)
    expected = {tuple(obs) for i, demo in enumerate(DEMOS) for obs in demo.obs[i % 7 : -1 : 7].tolist()}
    assert {tuple(obs) for window in seen for obs in window.obs[:, 0].tolist()} == expected


def test_without_demonstrations_no_rows_of_them_are_drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever number of rows the reward asks for."""
    experts: list[Any] = []
    real = learner.update
    monkeypatch.setattr(learner, "update", lambda *given: experts.append(given[3]) or real(*given))
    assert recorded().reward.batch_size > 0
    loop.train_loop(recorded(frames=120), tmp_path, ())
    assert len(experts) > 20 and all(expert is None for expert in experts)
