"""A finished run that goes on equals the run that was asked for as much at once."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from test_loop import StopAfter, finish, rows, same_run

from pcil.errors import InputError
from pcil.sweep.plans import Job
from pcil.training import loop, runs
from pcil.training.evaluate import Evaluation, evaluate
from small import save_point_mass_demos, small_run


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_point_mass_demos(tmp_path_factory.mktemp("demos"))


@pytest.mark.parametrize(
    ("method", "label"), [("pcil", "sampled"), ("pwil", "stored"), ("expert", "sampled"), ("bc", "sampled")]
)
@pytest.mark.parametrize("first", [130, 200])
def test_a_finished_run_goes_on_with_more_frames(method: str, label: Any, first: int, demos: str, tmp_path: Path) -> None:
    """At 200 frames an evaluation was due in any case; the one at 130 is not among those of the longer run."""
    run = small_run(method, label=label, demos=demos)
    if run.agent.offline:  # a pass has 500 updates
        run, first = dataclasses.replace(run, frames=2300, seed_frames=0, evaluate_every=1000), 10 * first
    finish(run, tmp_path / "whole")
    finish(dataclasses.replace(run, frames=first), tmp_path / "parts")
    assert (tmp_path / "parts" / "DONE").exists()
    finish(run, tmp_path / "parts")
    same_run(tmp_path / "whole", tmp_path / "parts")
    about = [json.loads((tmp_path / name / "run.json").read_text())["run"] for name in ("whole", "parts")]
    assert about[0] == about[1]


def test_it_goes_on_after_a_stop_and_twice(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    finish(run, tmp_path / "whole")
    finish(dataclasses.replace(run, frames=130), tmp_path / "parts")
    finish(dataclasses.replace(run, frames=230), tmp_path / "parts", stops=(1,))
    finish(run, tmp_path / "parts", stops=(1,))
    same_run(tmp_path / "whole", tmp_path / "parts")


@pytest.mark.parametrize("frames", [300, 400])
def test_a_run_that_had_ended_early_goes_on_without_until(
    frames: int, demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def generous(*given: Any, **named: Any) -> Evaluation:
        found = evaluate(*given, **named)
        return dataclasses.replace(found, returns=found.returns + 1000)

    monkeypatch.setattr(loop, "evaluate", generous)
    run = small_run(demos=demos)
    finish(dataclasses.replace(run, until=1e-5), tmp_path / "early")
    assert rows(tmp_path / "early")[1][-1]["frames"] == 100
    finish(dataclasses.replace(run, frames=frames, until=1e-5), tmp_path / "early")
    assert rows(tmp_path / "early")[1][-1]["frames"] == 100, "a run with more frames would have ended there too"
    finish(dataclasses.replace(run, frames=frames), tmp_path / "early")
    finish(dataclasses.replace(run, frames=frames), tmp_path / "whole")
    same_run(tmp_path / "whole", tmp_path / "early")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frames": 200}, r"another run: frames was 300, now 200"),
        ({"until": 0.9}, r"another run: until was None, now 0.9"),
        ({"frames": 400, "seed": 2}, r"another run: seed was 1, now 2; use"),
        (
            {"frames": 400},
            r"run in .* has kept no replay, so it can't go on from 300 to 400 frames; train anew with another --out",
        ),
    ],
)
def test_what_would_be_another_run_is_refused_and_changes_nothing(
    change: dict[str, Any], said: str, demos: str, tmp_path: Path
) -> None:
    run = small_run(demos=demos, keep_replay=False)
    finish(run, tmp_path)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=said):
        runs.execute(dataclasses.replace(run, **change), tmp_path)
    assert contents(tmp_path) == before


def test_a_run_knows_its_demonstrations_by_what_they_hold(tmp_path: Path) -> None:
    path = save_point_mass_demos(tmp_path)
    finish(small_run(demos=path), tmp_path / "whole")
    with pytest.raises(loop.Stopped):
        runs.execute(small_run(demos=path), tmp_path / "run", [StopAfter(2)])
    Path(path).rename(tmp_path / "elsewhere")
    (tmp_path / "run").rename(tmp_path / "moved")
    run = small_run(demos=str(tmp_path / "elsewhere"))
    finish(run, tmp_path / "moved")
    same_run(tmp_path / "whole", tmp_path / "moved")
    assert json.loads((tmp_path / "moved" / "run.json").read_text())["run"]["demos"] == run.demos


def test_a_sweep_goes_on_with_what_has_more_frames(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos, frames=130)
    finish(run, tmp_path)
    for frames, until, state in ((130, None, "done"), (120, None, "done"), (300, None, "waiting"), (130, 0.9, "waiting")):
        job = Job("name", tmp_path, dataclasses.replace(run, frames=frames, until=until), (), tmp_path / "log")
        job.look()
        assert job.state == state
