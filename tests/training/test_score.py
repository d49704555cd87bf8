"""Demonstrations scored by a learned reward."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from test_loop import finish

from pcil.demos import Demonstrations
from pcil.errors import InputError
from pcil.training.score import scores
from small import POINT_MASS, save_point_mass_demos, small_run

SOURCE = """
from dataclasses import dataclass
import jax.numpy as jnp
from pcil.rewards import Reward

@dataclass(frozen=True)
class FirstEntry(Reward):
    def init(self, demos, embed, *, key):
        return jnp.zeros(())

    def update(self, state, expert, agent, embed, *, key):
        return state + 1, {}

    def reward(self, state, batch, embed, *, key):
        return batch.next_obs[:, 0] + state
"""


def test_a_score_is_the_mean_of_the_labels_by_the_last_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reward whose label is the first entry of the next state plus the number of updates."""
    (tmp_path / "reward_to_score.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "reward_to_score", raising=False)
    from reward_to_score import FirstEntry  # pyright: ignore[reportMissingImports] - written above

    run = dataclasses.replace(small_run(demos=save_point_mass_demos(tmp_path)), reward=FirstEntry(batch_size=32))
    finish(run, tmp_path / "run")
    rng = np.random.default_rng(0)
    others = Demonstrations.from_arrays([rng.uniform(-1, 1, (steps + 1, 2)) for steps in (7, 300, 50)], task=POINT_MASS)
    expected = [np.mean(episode.obs[1:, 0]) + 100 for episode in others.episodes]
    assert scores(tmp_path / "run", others, ["reward_to_score"]) == pytest.approx(expected, abs=1e-4)
    with pytest.raises(InputError, match="reward_to_score"):
        scores(tmp_path / "run", others)


def test_a_run_without_a_learned_reward_is_refused(tmp_path: Path) -> None:
    demos = save_point_mass_demos(tmp_path)
    finish(small_run("expert"), tmp_path / "expert")
    with pytest.raises(InputError, match=r"is one of expert, which learns no reward; give one of pcil"):
        scores(tmp_path / "expert", Demonstrations.load(demos))
    with pytest.raises(InputError, match="holds no run; give a folder that pcil train made"):
        scores(tmp_path / "nowhere", Demonstrations.load(demos))
