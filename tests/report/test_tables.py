"""The tables of runs with known numbers, computed by hand, and their formatting."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
import scipy.stats

from fake_runs import fake_run, fake_sweep
from pcil.report import tables
from pcil.report.load import Collection, TransitionRow, collect
from pcil.report.stats import Interval


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    return collect([fake_sweep(tmp_path_factory.mktemp("sweep"))])


def rows(text: str) -> list[str]:
    """The rows below a Markdown table's header."""
    return text.splitlines()[2:]


def test_finals(sweep: Collection) -> None:
    """Student's interval of three numbers 100 apart is +- 248.4; of 27 bootstrap draws, 1 is all lowest, 1 all highest."""
    text = tables.markdown(tables.finals(sweep))
    assert text.startswith("| task | method | variant | mean | sd | IQM | expert | of expert | seeds | frames |\n| --- | --- |")
    assert rows(text) == [
        "| hopper_stand | pcil | default | 200.0 [-48.4, 448.4] | 100.0 | 200.0 [100.0, 300.0] | 400.0 | 0.50 | 3 | 2,000 |",
        "| hopper_stand | dac | default | 100.0 [-24.2, 224.2] | 50.0 | 100.0 [50.0, 150.0] | 400.0 | 0.25 | 3 | 2,000 |",
        "| walker_run | pcil | default | 800.0 [551.6, 1048.4] | 100.0 | 800.0 [700.0, 900.0] | 1000.0 | 0.80 | 3 | 2,000 |",
        "| walker_run | dac | default | 400.0 [275.8, 524.2] | 50.0 | 400.0 [350.0, 450.0] | 1000.0 | 0.40 | 3 | 2,000 |",
    ]


def test_overview(sweep: Collection, tmp_path: Path) -> None:
    assert rows(tables.markdown(tables.overview(sweep))) == [
        "| hopper_stand | 400.0 | 200.0 [-48.4, 448.4] | 100.0 [-24.2, 224.2] |",
        "| walker_run | 1000.0 | 800.0 [551.6, 1048.4] | 400.0 [275.8, 524.2] |",
    ]
    fake_run(tmp_path / "a", [0.0, 30.0], "walker_run", "dac", expert=None)
    fake_run(tmp_path / "b", [0.0, 40.0], "hopper_stand", "bc")
    fake_run(tmp_path / "c", [0.0, 50.0], "hopper_stand", "pcil")
    more_methods_than_tasks = [
        "| method | hopper_stand | walker_run |",
        "| --- | --- | --- |",
        "| demonstrations | 800.0 |  |",
        "| pcil | 50.0 |  |",
        "| bc | 40.0 |  |",
        "| dac |  | 30.0 |",
    ]
    assert tables.markdown(tables.overview(collect([tmp_path]))).splitlines() == more_methods_than_tasks


def test_beside_the_paper(sweep: Collection) -> None:
    """The paper has 771.2 +- 142.1 on Hopper Stand and 778.4 +- 14.1 on Walker Run for PCIL, and nothing for DAC."""
    assert rows(tables.markdown(tables.paper(sweep))) == [
        "| hopper_stand | pcil | default | 200.0 [-48.4, 448.4] | 771.2 [418.2, 1124.2] | -571.2 | yes | 3 | 2,000 |",
        "| walker_run | pcil | default | 800.0 [551.6, 1048.4] | 778.4 [743.4, 813.4] | 21.6 | yes | 3 | 2,000 |",
    ]


def test_beside_the_paper_where_the_intervals_are_apart(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        fake_run(tmp_path / f"a{seed}", [0.0, 30.0 + seed], "finger_spin", "pcil-gail", seed)
    fake_run(tmp_path / "b", [0.0, 980.0], "finger_spin", "tcn")
    by_method = {row[1]: row for row in tables.paper(collect([tmp_path])).rows}
    assert by_method["pcil-gail"][5:7] == (pytest.approx(32 - 2.5), "no")
    assert by_method["tcn"][5:7] == (pytest.approx(980 - 975.2), None), "one seed has no interval"


def test_the_papers_table_is_copied_without_a_slip() -> None:
    """Differences between its rows and columns, summed on paper."""
    means = {method: [mean for mean, _ in row] for method, row in tables.PAPER.items()}
    assert {method: round(sum(row), 1) for method, row in means.items()} == {
        "pcil": 2557.0,
        "tcn": 1164.5,
        "pcil-gail": 22.3,
        "tcn-gail": 74.0,
    }
    assert [round(sum(column), 1) for column in zip(*means.values(), strict=True)] == [1977.3, 997.2, 775.9, 67.4]
    assert [round(sum(sd for _, sd in row), 1) for row in tables.PAPER.values()] == [200.5, 57.9, 10.8, 28.3]


def test_all_tasks_together(sweep: Collection) -> None:
    """PCIL's fractions are 0.25, 0.5, 0.75 and 0.7, 0.8, 0.9: mean 0.65; IQM, without the lowest and the highest, 0.6875."""
    table = tables.aggregate(sweep)
    assert [row[:2] + row[5:] for row in table.rows] == [("pcil", "default", 2, 6), ("dac", "default", 2, 6)]
    (mean, iqm, area), (half_mean, half_iqm, _) = (row[2:5] for row in table.rows)
    assert area.value == pytest.approx(0.65 / 2), "0, half of the end, and the end: half of it on average"
    assert (mean.value, iqm.value) == pytest.approx((0.65, 0.6875))
    assert (half_mean.value, half_iqm.value) == pytest.approx((0.325, 0.34375))
    assert 0.475 <= mean.low < mean.value < mean.high <= 0.825, "all lowest and all highest seeds"


def test_sample_efficiency(tmp_path: Path) -> None:
    """The levels are 400, 640 and 720 of 800. Two of three seeds reach 400; the median of 1000, 2000 and never is 2000."""
    for seed, returns in enumerate(([0.0, 400.0, 650.0, 730.0], [0.0, 0.0, 500.0, 500.0], [0.0, 0.0, 0.0, 0.0]), 1):
        fake_run(tmp_path / str(seed), returns, seed=seed)
    fake_run(tmp_path / "no expert", [0.0, 1.0], "hopper_hop", expert=None)
    fake_run(tmp_path / "cloned", [0.0, 800.0], method="bc")
    assert rows(tables.markdown(tables.efficiency(collect([tmp_path])))) == [
        "| walker_run | pcil | default | 2,000 | 1.00 | 2 |  |  | 1 |  |  | 1 | 3 | 3,000 |"
    ]


def test_probability_of_improvement(sweep: Collection) -> None:
    """Hopper Stand: 100, 200, 300 against 50, 100, 150 wins 1.5 + 3 + 3 of 9 pairs; on Walker Run PCIL wins all."""
    ((*names, chance, tasks),) = tables.improvement(sweep).rows
    assert names == ["pcil", "default", "dac", "default"] and tasks == 2
    assert chance.value == pytest.approx((7.5 / 9 + 1) / 2) and chance.low < chance.value < chance.high == 1


def test_comparisons_by_task(sweep: Collection) -> None:
    """100, 200, 300 against 50, 100, 150 and 700, 800, 900 against 350, 400, 450, by SciPy; the smaller p-value is doubled."""
    table = tables.comparison(sweep)
    finals = [([100, 200, 300], [50, 100, 150]), ([700, 800, 900], [350, 400, 450])]
    tests = [scipy.stats.ttest_ind(*pair, equal_var=False).pvalue for pair in finals]
    assert [row[0] for row in table.rows] == ["hopper_stand", "walker_run"]
    assert [row[5].value for row in table.rows] == [100, 400]
    assert [row[6] for row in table.rows] == [f"{p:.2g}" for p in tests]
    assert [row[7] for row in table.rows] == [f"{tests[0]:.2g}", f"{2 * tests[1]:.2g}"] and tests[1] < tests[0] / 2
    assert all(row[8] == "3 and 3" for row in table.rows)


def test_methods_are_compared_at_the_frames_that_both_have(tmp_path: Path) -> None:
    """PCIL ends at 9 after 3000 frames, and is behind at 1000, where DAC ends; BC takes no steps, so its end is compared."""
    fake_run(tmp_path / "a", [0.0, 1.0, 5.0, 9.0], method="pcil")
    fake_run(tmp_path / "b", [0.0, 2.0], method="dac")
    fake_run(tmp_path / "c", [0.0, 8.0], method="bc")
    found = collect([tmp_path])
    chances = {(row[0], row[2]): row[4].value for row in tables.improvement(found).rows}
    assert chances == {("pcil", "bc"): 1, ("pcil", "dac"): 0, ("bc", "dac"): 1}
    assert rows(tables.markdown(tables.overview(found)))[1:] == ["| pcil | 9.00 |", "| bc | 8.00 |", "| dac | 2.00 at 1,000 |"]


def test_methods_without_a_common_task_are_not_compared(tmp_path: Path) -> None:
    fake_run(tmp_path / "a", [1.0, 2.0], "hopper_hop", "dac")
    fake_run(tmp_path / "b", [1.0, 2.0], "walker_run", "pcil")
    assert tables.improvement(collect([tmp_path])).rows == []


def test_methods_without_an_evaluation_in_common_are_not_compared(tmp_path: Path) -> None:
    fake_run(tmp_path / "a", [1.0, 2.0], method="pcil")
    fake_run(tmp_path / "b", [3.0, 4.0], method="dac")
    found = collect([tmp_path])
    moved = [row._replace(frames=row.frames + 7) if row.method == "dac" else row for row in found.rows]
    assert len(tables.improvement(found).rows) == 1 and tables.improvement(found._replace(rows=moved)).rows == []


def test_health(sweep: Collection) -> None:
    """PCIL: 0.2 in the first half; 0.5, 0.6, 0.7 in the second, whose interval is +- 4.3027 x 0.1 / sqrt 3 = 0.2484."""
    row = next(row for row in tables.health(sweep).rows if row[:2] == ("walker_run", "pcil"))
    assert row[3] == pytest.approx((0.2, 0.2, 0.2)) and row[5] == 3
    assert row[4] == pytest.approx((0.6, 0.6 - 0.2484, 0.6 + 0.2484), abs=1e-4)


def test_a_seed_that_is_behind_shortens_the_comparison(tmp_path: Path) -> None:
    fake_run(tmp_path / "a", [0.0, 100.0, 500.0], seed=1)
    fake_run(tmp_path / "b", [0.0, 200.0], seed=2, done=False)
    (row,) = tables.finals(collect([tmp_path])).rows
    assert row[3].value == 150 and row[-1] == 1000


def test_representation() -> None:
    """Distances 1, 2, 3 with rewards 3, 2, 1 and 1, 3, 2 have the rank correlations -1 and 0.5."""
    transitions = []
    for seed, rewards in ((1, (3.0, 2.0, 1.0)), (2, (1.0, 3.0, 2.0))):
        head = ("hopper_hop", "pcil", "paper", seed, 500)
        transitions += [TransitionRow(*head, None, 0.0, silhouette, 0.0, 0.0) for silhouette in (0.5, 0.7 + seed / 10)]
        transitions += [TransitionRow(*head, reward, distance, -1.0, 0.0, 0.0) for distance, reward in enumerate(rewards, 1)]
    ((*name, spearman, each, silhouette, of_each),) = tables.representation(Collection([], transitions, {}, [])).rows
    assert name == ["hopper_hop", "pcil", "paper"] and each == "1: -1.00, 2: 0.50" and of_each == "1: 0.65, 2: 0.70"
    assert spearman.value == pytest.approx(-0.25) and silhouette.value == pytest.approx(0.675)


# --- Writing ---


def test_cells() -> None:
    plain = {None: "", "x": "x", 1234567: "1,234,567", 0.123: "0.12", 9.99: "9.99", 9.996: "10.0", -123.456: "-123.5"}
    assert {value: tables.cell(value) for value in plain} == plain
    others = math.nan, Interval(1.0, math.nan, math.nan), Interval(1.0, 0.5, 20.0)
    assert [tables.cell(value) for value in others] == ["", "1.00", "1.00 [0.50, 20.0]"]


def test_a_csv_has_every_number(sweep: Collection, tmp_path: Path) -> None:
    tables.write("finals", tables.finals(sweep), tmp_path)
    with (tmp_path / "finals.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 4 and table[0]["task"] == "hopper_stand" and table[0]["frames"] == "2000"
    numbers = [float(table[0][name]) for name in ("mean", "mean low", "mean high", "sd", "IQM low")]
    assert numbers == pytest.approx([200, -48.413771, 448.413771, 100, 100])
    text = (tmp_path / "finals.md").read_text()
    assert text.startswith("# Final return of each task\n\nMean over seeds at the last evaluation")
    assert text.endswith(tables.markdown(tables.finals(sweep)))


@pytest.mark.parametrize("name", list(tables.MAKERS))
def test_every_table_has_a_title_a_note_and_columns_of_its_own(name: str, sweep: Collection) -> None:
    title, caption = tables.title_and_caption(tables.MAKERS[name])
    assert 5 < len(title) < 40 and caption.endswith(".") and len(caption) > 40
    table = tables.MAKERS[name](sweep)
    assert len(set(table.header)) == len(table.header) and all(len(row) == len(table.header) for row in table.rows)
