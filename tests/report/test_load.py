"""Run folders to rows and back; what counts as a run, which runs are seeds of one variant, and messages about omitted ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fake_runs import fake_run, fake_sweep
from pcil.errors import InputError
from pcil.files import flat
from pcil.report.load import EvalRow, TransitionRow, by_variant, collect, label, matrix, read_rows, read_run, write_rows
from pcil.report.variants import NO_VARIANT
from pcil.training.config import MACHINE_SETTINGS


def make_run(folder: Path) -> Path:
    folder.mkdir()
    run = {"task": "walker_walk", "method": "pcil", "preset": "default", "seed": 3}
    about = {"run": run, "demos": {"return_mean": 947.456}, "commit": "abc+"}
    (folder / "run.json").write_text(json.dumps(about))
    rows = ["frames,episode,return,length,seconds", "0,0,1.0,500,0.1", "0,1,4.0,500,0.1", "20000,0,10.25,500,9.9"]
    (folder / "eval.csv").write_text("\n".join([*rows, "20000,1,10.75,500,9.9"]) + "\n")
    health = ((1000, 0.5), (9000, "null"), (10000, 0.0), (20000, 0.25), (20001, 9.0))
    (folder / "train.jsonl").write_text("".join(f'{{"frames": {f}, "correlation": {c}}}\n' for f, c in health) + '{"frames": 2')
    return folder


def test_each_evaluation_is_one_row(tmp_path: Path) -> None:
    """The correlation is the mean of the episodes since the previous evaluation that have one: null means none, as does 0 in
    older logs. An incomplete line of a killed run does not count."""
    rows = read_run(make_run(tmp_path / "run"))
    assert rows == [
        EvalRow("walker_walk", "pcil", "default", 3, 0, 2.5, 1.0, 4.0, 947.456, "abc+", 0.1, None),
        EvalRow("walker_walk", "pcil", "default", 3, 20000, 10.5, 10.25, 10.75, 947.456, "abc+", 9.9, 0.375),
    ]


def test_a_run_without_episodes_has_no_correlation(tmp_path: Path) -> None:
    """Behavioural cloning plays no episodes while it trains."""
    folder = make_run(tmp_path / "run")
    (folder / "train.jsonl").write_text('{"frames": 1000, "agent/loss": 1.0}\n')
    assert {row.correlation for row in read_run(folder)} == {None}


def test_rows_survive_their_file(tmp_path: Path) -> None:
    rows = [*read_run(make_run(tmp_path / "run"), "warm"), EvalRow("t", "expert", "default", 1, 0, 0.0, 0.0, 0.0, None, "")]
    transitions = [
        TransitionRow("t", "dac", "paper", 2, 9, None, 0.1, -0.5, 1.0, 2.0),
        TransitionRow("t", "dac", "paper", 2, 9, 1.5, 0.0, 1.0, 0.0, 0.0),
    ]
    for written in (rows, transitions):
        write_rows(tmp_path / "results" / "x.csv", written)
        assert read_rows(tmp_path / "results" / "x.csv") == written


def test_files_of_older_versions_are_read(tmp_path: Path) -> None:
    write_rows(tmp_path / "x.csv", rows := read_run(make_run(tmp_path / "run")))
    cut = [",".join(line.split(",")[:10]) for line in (tmp_path / "x.csv").read_text().splitlines()]
    (tmp_path / "x.csv").write_text("\n".join(cut) + "\n")
    assert read_rows(tmp_path / "x.csv") == [row._replace(seconds=None, correlation=None) for row in rows]


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "task,method\nx,y\n", "task,frames\nx,many\n", "\x00\x01\xff"])
def test_a_file_of_something_else_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match="is not a file of results"):
        read_rows(tmp_path / "x.csv")


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no run"):
        read_run(tmp_path)


def test_a_run_without_demonstrations_has_no_expert(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(about | {"demos": None, "commit": None}))
    assert {(row.expert_return, row.commit) for row in read_run(folder)} == {(None, "")}


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"run": [], "demos": null, "commit": null}'])
def test_a_damaged_description_is_refused(text: str, tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    (folder / "run.json").write_text(text)
    with pytest.raises(InputError, match="holds no run"):
        read_run(folder)


# --- Many runs ---


def test_runs_are_found_at_any_depth_and_once(tmp_path: Path) -> None:
    root = fake_sweep(tmp_path / "sweep")
    found = collect([root, root / "walker_run", root / "walker_run" / "pcil-1"])
    assert len(found.sources) == 12 and len(found.rows) == 36 and found.notes == []
    assert found.sources["walker_run", "pcil", "default", 2].folder == root / "walker_run" / "pcil-2"
    assert found.sources["walker_run", "pcil", "default", 2].settings["agent.gamma"] == 0.99


def test_the_order_of_the_paths_changes_nothing(tmp_path: Path) -> None:
    root = fake_sweep(tmp_path)
    one, two = (collect(sorted(root.glob("*/*"), reverse=reverse)).rows for reverse in (False, True))
    assert one == two
    assert [name[:2] for name in by_variant(one)] == [(t, m) for t in ("hopper_stand", "walker_run") for m in ("pcil", "dac")]


def test_a_csv_gives_the_same_rows_as_its_runs(tmp_path: Path) -> None:
    found = collect([fake_sweep(tmp_path / "sweep")])
    write_rows(tmp_path / "all.csv", found.rows)
    again = collect([tmp_path / "all.csv"])
    assert again.rows == found.rows and again.sources == {}
    assert collect([tmp_path / "all.csv", tmp_path / "sweep"]).rows == found.rows, "each seed counts once"


def test_a_run_in_two_files_is_whole_and_of_the_first(tmp_path: Path) -> None:
    """A run is never put together from rows of two files."""
    short, long = tmp_path / "short.csv", tmp_path / "long.csv"
    for seed, path, returns in ((1, short, [1, 2]), (2, long, [3, 4, 5])):
        runs = [fake_run(tmp_path / f"a{seed}", returns), fake_run(tmp_path / f"b{seed}", [9], method="dac", seed=seed)]
        write_rows(path, collect(runs).rows)
    both = collect([short, long])
    assert [row.return_mean for row in both.rows] == [1, 2, 9, 9], "each of DAC's two seeds comes from one file"
    assert both.notes == [f"{long} holds runs that {short} has too; those of the latter are shown."]


def test_runs_that_differ_in_a_setting_are_no_seeds_of_each_other(tmp_path: Path) -> None:
    """A setting that differs on one task is in the variant's name on every task, so that variants can be compared."""
    fake_run(tmp_path / "a", [1], seed=1, checkpoint_seconds=1)
    fake_run(tmp_path / "b", [2], seed=2, checkpoint_seconds=2)
    fake_run(tmp_path / "c", [3], seed=1, agent={"gamma": 0.9})
    fake_run(tmp_path / "d", [4], "hopper_hop", n_step=1)
    fake_run(tmp_path / "e", [5], method="dac", n_step=1)
    by = {(row.task, row.method, row.variant, row.seed): row.return_mean for row in collect([tmp_path]).rows}
    assert by == {
        ("walker_run", "pcil", "default", 1): 1,
        ("walker_run", "pcil", "default", 2): 2,
        ("walker_run", "pcil", "default, agent.gamma=0.9", 1): 3,
        ("hopper_hop", "pcil", "default", 1): 4,
        ("walker_run", "dac", "default", 1): 5,
    }


def test_where_no_value_is_the_usual_one_all_are_told(tmp_path: Path) -> None:
    fake_run(tmp_path / "a", [1], agent={"gamma": 0.99})
    fake_run(tmp_path / "b", [2], agent={"gamma": 0.9})
    assert {row.variant for row in collect([tmp_path]).rows} == {"default, agent.gamma=0.9", "default, agent.gamma=0.99"}


@pytest.mark.parametrize(
    ("first", "second", "third", "longer"),
    [(500, 1000, 500, "default, frames=1000"), (500, 1000, 2000, "default"), (500, 1000, 1000, "default")],
)
def test_a_budget_that_differs_on_one_task_makes_two_rows_of_a_method(
    first: int, second: int, third: int, longer: str, tmp_path: Path
) -> None:
    """The most frequent number of frames is not named, else the largest; a task with only one number is not split."""
    fake_run(tmp_path / "a", [1], "hopper_hop", frames=first)
    fake_run(tmp_path / "b", [2], "hopper_hop", frames=second)
    fake_run(tmp_path / "c", [3], "walker_run", frames=third)
    by = {(row.task, row.return_mean): row.variant for row in collect([tmp_path]).rows}
    assert by["walker_run", 3] == "default" and by["hopper_hop", 2] == longer and len(set(by.values())) == 2


def test_settings_that_a_run_lacks_may_be_completed(tmp_path: Path) -> None:
    for seed, agent in enumerate(({"gamma": 0.99}, {"gamma": 0.99, "novel": 0}, {"gamma": 0.99, "novel": 1})):
        fake_run(tmp_path / str(seed), [1], seed=seed, agent=agent)
    found = collect([tmp_path], lambda settings: {"agent.novel": 0} | settings)
    assert [name[2:] for name in found.sources] == [("default", 0), ("default", 1), ("default, agent.novel=1", 2)]


def test_settings_of_the_machine_make_no_variant() -> None:
    assert set(MACHINE_SETTINGS) <= set(NO_VARIANT)


def test_the_same_run_twice_is_shown_once_and_said(tmp_path: Path) -> None:
    for name in ("a", "b"):
        fake_run(tmp_path / name, [1, 2])
    found = collect([tmp_path])
    assert len(found.rows) == 2
    assert found.notes == [f"{tmp_path / 'b'} holds the same run as {tmp_path / 'a'}, which is shown."]


def test_what_cannot_be_read_is_left_out_and_said(tmp_path: Path) -> None:
    fake_run(tmp_path / "good", [1, 2])
    fake_run(tmp_path / "young", [])
    fake_run(tmp_path / "torn", [1]).joinpath("eval.csv").unlink()
    found = collect([tmp_path])
    assert [source.folder.name for source in found.sources.values()] == ["good"]
    young, torn = sorted(found.notes, key=lambda note: "torn" in note)
    assert young == f"left out: {tmp_path / 'young'}, it has no evaluation yet"
    assert torn == f"left out: {tmp_path / 'torn'}, eval.csv can't be read (No such file or directory)"


def test_without_any_run_the_reason_is_given(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="There is no run in"):
        collect([tmp_path])
    with pytest.raises(InputError, match="There is no run in nothing"):
        collect([])
    with pytest.raises(InputError, match="nowhere does not exist"):
        collect([tmp_path / "nowhere"])
    fake_run(tmp_path / "young", [])
    with pytest.raises(InputError, match="has no evaluation yet"):
        collect([tmp_path])


def test_a_matrix_has_the_frames_that_all_seeds_have(tmp_path: Path) -> None:
    fake_run(tmp_path / "a", {0: 1, 1000: 2, 2000: 3}, correlation=[0.5, 0.6])
    fake_run(tmp_path / "b", {0: 4, 2000: 5, 3000: 6}, seed=2, correlation=[0.7, 0.8])
    (runs,) = by_variant(collect([tmp_path]).rows).values()
    frames, values = matrix(runs)
    assert frames.tolist() == [0, 2000] and values.tolist() == [[1, 3], [4, 5]]
    frames, values = matrix(runs, "correlation")
    assert frames.tolist() == [2000] and np.allclose(values, [[0.6], [0.7]])


def test_a_label_says_the_variant_unless_it_is_the_default_presets_alone() -> None:
    one, other, alone, paper = ("pcil", "default"), ("pcil", "paper"), ("dac", "default"), ("sil", "paper")
    names = [one, other, alone, paper]
    assert [label(name, names) for name in names] == ["pcil, default", "pcil, paper", "dac", "sil, paper"]


def test_nested_settings_are_flat_by_their_dotted_names() -> None:
    assert flat({"a": 1, "b": {"c": {"d": None}, "e": "x"}}) == {"a": 1, "b.c.d": None, "b.e": "x"}


def test_without_rows_a_file_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("old")
    with pytest.raises(InputError, match="no rows"):
        write_rows(tmp_path / "x.csv", [])
    assert (tmp_path / "x.csv").read_text() == "old"


def test_seeds_without_frames_in_common_are_not_averaged(tmp_path: Path) -> None:
    fake_run(tmp_path / "a", {1000: 5}, seed=1)
    fake_run(tmp_path / "b", {2000: 6}, seed=2)
    found = collect([tmp_path])
    assert {row.seed for row in found.rows} == {1} and "no frames in common; only seed 1" in found.notes[0]
