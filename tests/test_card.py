"""A policy's model card says what `policy.json` says, in YAML and Markdown that nothing in it can break."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from pcil.card import card
from pcil.nets.networks import Actor
from pcil.policy import Policy, as_saved, load_policy
from pcil.report import stats
from pcil.training.runs import execute
from small import POINT_MASS, save_point_mass_demos, small_run

INFO = {
    "method": "pcil",
    "preset": "default",
    "seed": 1,
    "frames": 200_000,
    "return_mean": 961.24,
    "return_std": 10.0,
    "return_episodes": 10,
    "demos": "walker_walk",
    "action_repeat": 2,
}


def parts(text: str) -> tuple[dict[str, Any], dict[str, str], str]:
    """The front matter, the rows of the table, and the whole text below the front matter."""
    empty, front, body = text.split("---\n", 2)
    assert empty == ""
    rows = [line.strip("| ").split(" | ", 1) for line in body.splitlines() if line.startswith("| ") and line != "| | |"]
    return yaml.safe_load(front), dict(rows), body


def test_the_card_says_what_the_policy_is() -> None:
    front, rows, body = parts(card("walker_walk", INFO))
    assert rows == {
        "task": "`walker_walk`",
        "method": "`pcil`, preset `default`, seed 1",
        "data": "`walker_walk`",
        "frames": "200,000 control steps of the environment, 2 for each action",
        "return": "961.2 [953.7, 968.8], a mean over 10 episodes and its 95% interval",
        "command": "`pcil train walker_walk --method pcil --preset default --seed 1 --frames 200000 --out DIR`",
        "licence": "not chosen; whoever shares this policy chooses one, here and in `license` above",
    }
    assert front["license"] == "unknown" and front["library_name"] == "pcil"
    assert front["pipeline_tag"] == "reinforcement-learning" and "walker_walk" in front["tags"]
    (index,) = front["model-index"]
    (result,) = index["results"]
    assert index["name"] == "pcil-walker_walk" and result["dataset"] == {"name": "walker_walk", "type": "walker_walk"}
    assert result["metrics"][0]["type"] == "mean_reward" and result["metrics"][0]["value"] == rows["return"]
    assert "# pcil on walker_walk" in body and "pcil.load_policy" in body


def test_the_interval_is_students() -> None:
    """Equal to that of reports, which is computed from the scores themselves."""
    returns = [900.0, 950.0, 955.0, 1000.0]
    info = {"return_mean": np.mean(returns), "return_std": np.std(returns), "return_episodes": 4}
    _, low, high = stats.mean_interval(returns)
    assert parts(card("t", info))[1]["return"].startswith(f"951.2 [{low:.1f}, {high:.1f}], a mean over 4 episodes")


@pytest.mark.parametrize("info", [{"return_std": None}, {"return_episodes": 1, "return_std": 0.0}, {}])
def test_one_episode_has_no_interval(info: dict[str, Any]) -> None:
    assert parts(card("t", {"return_mean": 1.25, **info}))[1]["return"] == "1.2"


def test_what_is_unknown_is_left_out() -> None:
    front, rows, _ = parts(card("t", {}))
    assert list(rows) == ["task", "method", "command", "licence"] and "model-index" not in front


def test_a_method_without_demonstrations_says_so_and_arguments_are_in_the_command() -> None:
    rows = parts(card("t", {"demos": None, "env_kwargs": {"speed": 2}}))[1]
    assert rows["data"].startswith("none") and rows["command"] == "`pcil train t --env-kwargs '{\"speed\": 2}' --out DIR`"


@pytest.mark.parametrize("name", ["a\nlicense: mit\n---\n# x", "a | b", "`a`", "<script>", 'a": {', "é\x1b[31m"])
def test_no_name_breaks_the_card(name: str) -> None:
    front, rows, body = parts(card(name, INFO | {"method": name, "demos": name, "frames": name}))
    assert front["license"] == "unknown" and name in front["tags"] and list(rows) == list(parts(card("t", INFO))[1])
    assert body.count("\n# ") == 1 and "<" not in body.replace("`", "") and "\x1b" not in body


def test_a_run_writes_the_card_with_its_policy(tmp_path: Path) -> None:
    """It says what `eval.csv` says, changes no checksum, and is written again with a policy that was lost."""
    run = small_run(demos=save_point_mass_demos(tmp_path))
    result = execute(run, tmp_path / "run")
    folder = tmp_path / "run" / "policy"
    info = json.loads((folder / "policy.json").read_text())["info"]
    rows = [line.split(",") for line in (tmp_path / "run" / "eval.csv").read_text().splitlines()]
    returns = [float(row[2]) for row in rows[1:] if row[0] == rows[-1][0]]
    assert len(returns) == info["return_episodes"] == 2
    assert info["return_mean"] == result.final_return == np.mean(returns) and info["return_std"] == np.std(returns)
    assert info["demos"] == "point_mass-v0", "no path of the machine"
    assert (info["action_low"], info["action_high"]) == ([-1, -1], [1, 1])
    text = (folder / "README.md").read_text()
    assert text == card(POINT_MASS, info) and str(tmp_path) not in text
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for path in folder.iterdir():
        path.unlink()
    execute(run, tmp_path / "run")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_policy_without_a_card_is_as_good(tmp_path: Path) -> None:
    policy = Policy(Actor.init(2, 2, 4, 8, key=jax.random.key(0)), POINT_MASS, dict(INFO))
    policy.save(tmp_path / "policy")
    (tmp_path / "policy" / "README.md").unlink()
    assert load_policy(tmp_path / "policy").info == INFO and as_saved(tmp_path / "policy")
    (tmp_path / "policy" / "README.md").write_text("# My own words")
    assert load_policy(tmp_path / "policy").action_bounds is None and as_saved(tmp_path / "policy")


BOUNDS = [
    ([-1.0, -1.0], None),
    ([-1.0], [1.0, 1.0]),
    ([1.0, 1.0], [1.0, 2.0]),
    ([float("nan")] * 2, [1.0] * 2),
    ("low", "high"),
    (-1, 1),
    ([[-1.0]], [[1.0]]),
    ({"a": 1}, {"a": 2}),
]


@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_bounds_that_are_none_are_damage(low: Any, high: Any, tmp_path: Path) -> None:
    policy = Policy(Actor.init(2, 2, 4, 8, key=jax.random.key(0)), POINT_MASS, {"action_low": low, "action_high": high})
    policy.save(tmp_path / "policy")
    with pytest.raises(Exception, match="is damaged"):
        load_policy(tmp_path / "policy")
