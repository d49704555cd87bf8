"""The docs agree with the code: names exist, tables match the settings, examples run, generated pages are up to date."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import json
import re
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pcil
from pcil import cli, envs
from pcil.agents import BC, DrQV2
from pcil.cli import COMMANDS
from pcil.demos import Demonstrations
from pcil.envs.rollout import Rollout
from pcil.nets.networks import Actor
from pcil.policy import Policy
from pcil.rewards import REWARDS, Reward, TaskReward
from pcil.training import checkpoint, learner, presets
from pcil.training.config import Run
from pcil.types import Batch, Episode, Spec
from small import POINT_MASS, narrow, random_batch, save_point_mass_demos, small_run, windows

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAME = re.compile(r"`(pcil(?:\.\w+)*):(\w+(?:\.\w+)*)`")
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")
LINK = re.compile(r"\]\((?!https?:)([^)\s]+)\)")
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

CLASSES = {kind.__name__: kind for kind in (DrQV2, BC, *REWARDS.values()) if kind is not TaskReward}
"""Agents and rewards whose settings have a table."""


def blocks(page: Path, language: str) -> list[str]:
    return [text for kind, text in BLOCK.findall(page.read_text()) if kind == language]


def exists(module: str, name: str) -> bool:
    """Whether `module:name` is there; a dataclass's field counts even if it has no value on the class."""
    found: Any = importlib.import_module(module)
    for part in name.split("."):
        if part in getattr(found, "__dataclass_fields__", {}):
            return True
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


def test_every_name_in_the_docs_exists() -> None:
    named = {match for page in PAGES for match in NAME.findall(page.read_text())}
    assert len(named) > 50
    assert [f"{module}:{name}" for module, name in sorted(named) if not exists(module, name)] == []


def test_every_test_in_the_docs_exists() -> None:
    named = {match for page in PAGES for match in TEST.findall(page.read_text())}
    assert len(named) > 40
    functions = {
        path: {node.name for node in ast.parse((ROOT / path).read_text()).body if isinstance(node, ast.FunctionDef)}
        for path in {path for path, _ in named}
    }
    assert [f"{path}::{name}" for path, name in sorted(named) if name not in functions[path]] == []


def test_every_equation_has_a_function_and_a_test_or_is_said_to_be_missing() -> None:
    tables = [line for line in (ROOT / "docs/paper-map.md").read_text().splitlines() if line.startswith("| ")]
    rows = [line for line in tables if "| Function |" not in line and len(line.split(" | ")) == 4]
    assert len(rows) > 25
    bare = [row for row in rows if not (NAME.search(row) and TEST.search(row)) and "Not implemented" not in row]
    assert bare == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text()):
        path, _, anchor = target.partition("#")
        goal = (page.parent / path).resolve() if path else page
        assert goal.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", goal.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}, target


def settings_tables() -> list[tuple[str, list[list[str]]]]:
    """Class and rows of every table with a header such as `| setting | PCIL | default | paper | released | meaning |`."""
    found = []
    for page in sorted((ROOT / "docs" / "methods").glob("*.md")):
        for header, body in re.findall(r"^\| setting \| (\w+) \|.*\n\|[-|]+\n((?:\|.*\n)+)", page.read_text(), re.MULTILINE):
            found.append((header, [[cell.strip() for cell in row.strip("|").split("|")] for row in body.splitlines()]))
    return found


def flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Every setting by its name on the command line; nested names have dots."""
    values = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        nested = flat(value, f"{prefix}{field.name}.") if dataclasses.is_dataclass(value) else {prefix + field.name: value}
        values |= nested
    return values


def of(run: Run, kind: str) -> dict[str, Any]:
    """The settings of a run that a table of this class lists."""
    if kind in ("DrQV2", "BC"):
        return flat(run.agent)
    if kind in CLASSES:
        return flat(run.reward)
    return {
        name: value
        for name, value in flat(run).items()
        if "." not in name and name not in ("task", "method", "preset") and not hasattr(value, "__dataclass_fields__")
    }


def cell_value(cell: str, task: str) -> Any:
    """The value of a cell for a task: `3; walker 1` is 1 for walker tasks and 3 for others."""
    general, _, special = cell.partition("; walker ")
    return ast.literal_eval(special if special and task.startswith("walker") else general)


def made_of(method: str) -> tuple[str, str]:
    """The classes of a method's agent and reward."""
    run = presets.make("walker_walk", method)
    return type(run.agent).__name__, type(run.reward).__name__


def test_the_settings_tables_say_what_the_code_says() -> None:
    """Every field is listed with its default and its value in each preset."""
    tables = settings_tables()
    assert sorted(kind for kind, _ in tables) == sorted([*CLASSES, "Run"])
    bare = {name: kind() for name, kind in CLASSES.items()}
    for kind, rows in tables:
        method = next(m for m in presets.METHODS if kind in ("Run", *made_of(m)))
        names = [row[0].strip("`") for row in rows]
        own = flat(bare[kind]) if kind in bare else of(Run(task="finger_spin"), kind)
        assert sorted(names) == sorted(own), kind
        for name, row in zip(names, rows, strict=True):
            assert cell_value(row[1], "finger_spin") == own[name], f"{kind}.{name}"
            for cell, preset in zip(row[2:5], ("default", "paper", "released"), strict=True):
                for task in ("finger_spin", "walker_walk"):
                    expected = of(presets.make(task, method, preset), kind)[name]
                    assert cell_value(cell, task) == expected, f"{kind}.{name}, {preset}, {task}"


def load_example(folder: Path, monkeypatch: pytest.MonkeyPatch) -> type[Reward]:
    """The example reward of architecture.md, imported as a user's module would be."""
    text, _ = blocks(ROOT / "docs" / "architecture.md", "python")
    (folder / "nearest_example.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setitem(sys.modules, "nearest_example", None)
    monkeypatch.delitem(sys.modules, "nearest_example")
    return importlib.import_module("nearest_example").NearestExpert


def test_the_example_reward_is_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared with a naive second computation; it is 0 at an expert state, and its state can be restored from a checkpoint."""
    settings = load_example(tmp_path, monkeypatch)(num_states=10)
    demos, states = random_batch(40, 3, 1, seed=1), random_batch(7, 3, 1, seed=2)

    def embed(obs: Any) -> Any:
        return obs

    state = settings.init([demos], embed, key=jax.random.key(0))
    got = settings.reward(state, states, embed, key=jax.random.key(1))
    spread = demos.obs.std(axis=0) + 1e-3
    naive = [-min(np.linalg.norm((s - e) / spread) for e in demos.obs[::4]) for s in states.obs]
    assert got.shape == (7,) and np.allclose(got, naive, atol=1e-3)
    at_expert = settings.reward(state, Batch(*(array[:1] for array in demos[:3])), embed, key=jax.random.key(1))
    assert float(at_expert[0]) == pytest.approx(0.0, abs=1e-2)
    fresh = settings.init([random_batch(40, 3, 1, seed=9)], embed, key=jax.random.key(0))
    restored = checkpoint.unflatten("reward", fresh, checkpoint.flatten("reward", state))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(restored), jax.tree.leaves(state), strict=True))


def test_the_example_reward_goes_through_the_compiled_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It uses the same `init`, `update` and `label_episode` as PCIL, and the agent is trained on the example's rewards."""
    settings = narrow(load_example(tmp_path, monkeypatch)())
    run = dataclasses.replace(small_run(), reward=settings)
    demos, rows, n = random_batch(50, 2, 2), run.agent.batch_size, run.agent.n_step
    state = learner.init(run.learner, Spec(2, 2, 1), [demos], 0)
    window = windows(random_batch(rows + n, 2, 2, seed=1), n)
    before = np.asarray(state.agent.critic.heads[0].weights[0])
    state, actor = learner.update(run.learner, state, window, None, None, np.int32(0), np.int32(0))
    assert not np.array_equal(before, state.agent.critic.heads[0].weights[0])
    assert float(state.totals["updates"]) == 1 and float(state.totals["agent/target"]) < 0
    assert actor(jnp.zeros((1, 2))).shape == (1, 2)
    episode = Episode(np.concatenate([demos.obs[:10], demos.obs[:1] + 5]), demos.action[:10], np.zeros(10, np.float32))
    learned = learner.label_episode(run.learner, state, episode, 0)
    assert learned.shape == (10,) and learned.dtype == np.float32
    assert np.allclose(learned[:9], 0, atol=1e-2) and learned[9] < -1


def test_the_example_agent_clones_the_expert_and_leaves_a_policy_that_loads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Uses the command on the page. The policy's file names its class, so it is refused without `--trust`."""
    _, text = blocks(ROOT / "docs" / "architecture.md", "python")
    (Path.cwd() / "cloning_example.py").write_text(text)
    demos = save_point_mass_demos(tmp_path)
    words = f"train {POINT_MASS} --method bc --agent cloning_example:LinearCloning --demos {demos} --frames 3000 --out run"
    assert cli.main(words.split()) == 0
    rows = [json.loads(line) for line in Path("run/train.jsonl").read_text().splitlines()]
    assert rows[-1]["agent/loss"] < np.mean(Demonstrations.load(demos).action ** 2), "better than standing still"
    assert json.loads(Path("run/run.json").read_text())["run"]["agent"]["class"] == "cloning_example:LinearCloning"
    assert cli.main(words.split()) == 0 and "is done" in capsys.readouterr().out
    assert cli.main(["evaluate", "run"]) == 2 and "--trust cloning_example" in capsys.readouterr().err
    assert cli.main(["evaluate", "run", "--episodes", "2", "--trust", "cloning_example"]) == 0
    assert cli.main(["export", "run", "--out", "policy.onnx"]) == 2 and "--trust cloning_example" in capsys.readouterr().err
    assert cli.main(["export", "run", "--out", "policy.onnx", "--trust", "cloning_example"]) == 0
    policy, obs = pcil.load_policy("run", ["cloning_example"]), np.ones((3, 2), np.float32)
    assert (np.diag(policy.actor.weight) < -0.1).all(), "the expert moves towards the origin"
    assert np.allclose(policy(obs), np.tanh(obs @ policy.actor.weight)) and policy.spec[:2] == (2, 2)


def test_the_ten_lines_run_an_exported_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    """They end where the policy itself ends, up to rounding."""
    policy = Policy(Actor.init(3, 1, 4, 8, key=jax.random.key(0)), "Pendulum-v1")
    pcil.export_onnx(policy, "policy.onnx")
    (text,) = blocks(ROOT / "docs" / "deploy.md", "python")
    assert len([line for line in text.splitlines() if line]) == 10
    exec(compile(text, "deploy.md", "exec"), ran := {})
    rollout = Rollout([envs.make("Pendulum-v1")], [0], ["the same"])
    while rollout.playing:
        rollout.step([policy(rollout.obs[0])])
    assert ran["over"] and np.allclose(ran["obs"], rollout.obs[0], atol=1e-2)
    about = ran["session"].get_modelmeta().custom_metadata_map
    assert about["task"] == "Pendulum-v1" and json.loads(about["action_high"]) == [2.0]


def test_the_page_of_the_command_line_is_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """If this fails, run `python docs/make_cli.py`."""
    spec = importlib.util.spec_from_file_location("make_cli", ROOT / "docs" / "make_cli.py")
    assert spec is not None and spec.loader is not None
    make_cli = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_cli)
    for columns in ("60", "200"):
        monkeypatch.setenv("COLUMNS", columns)
        assert make_cli.main(["--check"]) == 0


def test_every_option_in_the_docs_is_one() -> None:
    known = set(re.findall(r"--[a-z][\w.-]*", (ROOT / "docs" / "cli.md").read_text()))
    for page in PAGES:
        for line in re.findall(rf"^.*\bpcil (?:{'|'.join(COMMANDS)})\b.*$", page.read_text(), re.MULTILINE):
            assert set(re.findall(r"(?<!\S)--[a-z][\w.-]*\w", line)) <= known, line


def test_the_map_in_the_readme_has_every_file_once() -> None:
    (text,) = (text for text in blocks(ROOT / "README.md", "text") if text.startswith("src/pcil/\n"))
    mapped = re.findall(r"^  (\S+\.py) ", text, re.MULTILINE)
    package = ROOT / "src" / "pcil"
    assert sorted(mapped) == sorted(path.relative_to(package).as_posix() for path in package.rglob("*.py"))


def test_the_python_in_the_docs_is_python() -> None:
    """It compiles, and the names that it uses from `pcil` exist."""
    for page in PAGES:
        for text in blocks(page, "python"):
            tree = ast.parse(text)
            used = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "pcil"}
            assert used <= set(pcil.__all__), page.name


def test_the_tables_of_results_are_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are filled from results/*.csv and the included demonstrations by the command on the page."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    assert importlib.import_module("results").main(["--check"]) == 0, "run python experiments/results.py"
