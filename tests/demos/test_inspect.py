"""What `pcil demos PATH` says of a dataset, by hand and by NumPy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcil import cli
from pcil.demos import Demonstrations
from pcil.demos.inspect import lines, summary
from small import POINT_MASS


def of(returns: list[float], lengths: list[int], **changes: Any) -> Demonstrations:
    """Episodes of these returns and lengths, with an entry that varies, a constant, a huge one, and one far from 0."""
    obs, actions, rewards = [], [], []
    for paid, length in zip(returns, lengths, strict=True):
        varying = np.linspace(-1, 1, length + 1)
        obs.append(np.stack([varying, 0 * varying + 7, 2e6 * varying, 5000 + varying], axis=1))
        actions.append(np.stack([varying[:-1], 0 * varying[:-1]], axis=1))
        rewards.append(np.full(length, paid / length))
    given = {"actions": actions, "rewards": rewards, "terminated": [i == 0 for i in range(len(obs))]} | changes
    return Demonstrations.from_arrays(obs, **given, task="arm")


def test_numbers_by_hand() -> None:
    about = summary(of([1, 1, 2, 2, 30], [4, 4, 4, 4, 4]))
    assert about["episodes"] == 5 and about["steps"] == 20 and about["terminated"] == 1
    assert (about["return_min"], about["return_mean"], about["return_max"]) == pytest.approx((1, 7.2, 30))
    assert (about["length_min"], about["length_mean"], about["length_max"], about["length_std"]) == (4, 4, 4, 0)
    assert [row["note"] for row in about["observation_ranges"]] == ["", "constant", "huge", "offset"]
    assert about["observation_ranges"][0] | {"std": 0} == {"min": -1, "mean": 0, "max": 1, "std": 0, "note": ""}
    assert [row["note"] for row in about["action_ranges"]] == ["", "constant"]
    assert about["outliers"] == [{"episode": 4, "what": "return", "value": pytest.approx(30)}]
    assert json.loads(json.dumps(about)) == about


def test_an_outlier_is_one_and_a_half_interquartile_ranges_away() -> None:
    """The quartiles of 0, 1, 2, 3, x are 1 and 3 for x above 3, so that the limit is 6; three episodes have no outlier."""
    assert summary(of([0, 1, 2, 3, 6], [5] * 5))["outliers"] == []
    assert [found["episode"] for found in summary(of([0, 1, 2, 3, 6.01], [5] * 5))["outliers"]] == [4]
    assert [found["what"] for found in summary(of([1] * 5, [5, 5, 5, 5, 6]))["outliers"]] == ["length"]
    assert summary(of([1, 1, 99], [5, 5, 50]))["outliers"] == []


def test_what_is_absent_is_said() -> None:
    about = summary(of([1, 2], [4, 4], actions=None, rewards=None))
    assert about["actions"] is False and about["rewards"] is False and about["action_ranges"] == []
    assert about["return_mean"] is None and about["action_dim"] is None
    assert {"return: there are no rewards", "actions: there are none"} <= set(lines(about))


@hypothesis.settings(max_examples=30, deadline=None)
@given(arrays.arrays(np.float32, st.tuples(st.integers(2, 20), st.integers(1, 4)), elements=st.floats(-1e5, 1e5, width=32)))
def test_ranges_are_those_of_all_states(states: np.ndarray) -> None:
    about = summary(Demonstrations.from_arrays([states, states[::-1]]))
    both = np.concatenate([states, states[::-1]]).astype(np.float64)
    for i, row in enumerate(about["observation_ranges"]):
        column = sorted(both[:, i])
        assert (row["min"], row["max"]) == (column[0], column[-1])
        assert row["mean"] == pytest.approx(sum(column) / len(column), abs=1e-6 * max(abs(column[0]), abs(column[-1]), 1))
        assert (row["note"] == "constant") == (len(set(column)) == 1)


def test_the_command_says_all_of_it_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = of([1, 1, 2, 2, 30], [4, 4, 4, 4, 4]).save(tmp_path / "arm")
    assert cli.main(["demos", str(path), "--plot", str(tmp_path / "arm.png")]) == 0
    text = capsys.readouterr().out
    assert "arm: 5 episodes, 20 steps, 1 terminated" in text and "outlier: episode 4 has a return of 30" in text
    assert "constant" in text and "huge" in text and (tmp_path / "arm.png").read_bytes()[:4] == b"\x89PNG"
    assert cli.main(["demos", str(path), "--env", POINT_MASS, "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert about["outliers"][0]["episode"] == 4
    assert about["misfits"] == [
        "Episode 0 of the demonstrations of arm has obs of shape (5, 4), but in this environment it must be (5, 2)."
    ]


def test_demonstrations_that_fit_are_said_to(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demos", "pendulum_swingup", "--env", "pendulum_swingup"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "The demonstrations fit pendulum_swingup."


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--env", "walker_walk"], "are about one dataset; name it"),
        (["nowhere"], "There is no Minari dataset"),
        (["pendulum_swingup", "--plot", "picture.txt"], "give a name that ends in .png, .pdf, .svg"),
        (["pendulum_swingup", "--score", "nowhere"], "nowhere holds no run; give a folder that pcil train made"),
        (["pendulum_swingup", "--env", "no_task"], "no_task"),
        (["pendulum_swingup", "--env", "pendulum_swingup", "--env-kwargs", "["], "--env-kwargs"),
    ],
)
def test_bad_input_is_one_sentence(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demos", *words]) == 2
    out, err = capsys.readouterr()
    assert said in err and err.count("\n") == 1 and not out
