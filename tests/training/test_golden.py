"""The numbers of five updates of every method are unchanged, and an update runs with every preset's settings.

Run `make_golden.py` to update `golden.json` after a change that is meant to change numbers.
"""

from __future__ import annotations

import itertools
import json
from typing import Any

import jax
import numpy as np
import pytest

import make_golden
from pcil.training import learner, presets
from pcil.training.config import Algorithm, Run
from pcil.types import Batch, Spec, Window
from small import random_batch, windows

GOLDEN = json.loads(make_golden.GOLDEN.read_text())
CASES = make_golden.cases()
TOLERANCE = 1e-4
"""Relative. Another processor or release of XLA adds in another order, which changes the last bits. When every initial weight
was changed in its last bit, the numbers changed by at most 2.5e-6."""
NEARLY_TIED = 0.05
"""The fraction of pairs in an update whose scores differ only by rounding, so that an accuracy may count them either way. It
was 0.025 and, on another processor, 0.032 with most optimisations of XLA disabled (`JAX_DISABLE_MOST_OPTIMIZATIONS=1`, as in
`mutants.py`)."""


def test_every_method_and_label_has_its_numbers_and_they_say_where_they_are_from() -> None:
    assert list(GOLDEN["cases"]) == list(CASES)
    assert {run.method for run in CASES.values()} == set(presets.METHODS)
    about = GOLDEN["made by"]
    assert about["command"] == make_golden.COMMAND and len(about["commit"].rstrip("+")) == 40
    assert {"python", "jax", "jaxlib", "numpy"} <= set(about["versions"]) and about["processor"]


@pytest.mark.parametrize("name", CASES)
def test_five_updates_give_the_numbers_that_they_gave(name: str) -> None:
    """A part's second sum has terms of both signs, so its tolerance is relative to the first, the sum of their sizes."""
    got, expected = make_golden.five_updates(CASES[name]), GOLDEN["cases"][name]
    assert got["metrics"].keys() == expected["metrics"].keys()
    for part, value in got["metrics"].items():
        absolute = NEARLY_TIED if part.endswith("accuracy") else 1e-5
        assert value == pytest.approx(expected["metrics"][part], rel=TOLERANCE, abs=absolute), part
    assert got["sums"].keys() == expected["sums"].keys()
    far = {part: (sums, old) for part, sums in got["sums"].items() if distance(sums, old := expected["sums"][part]) > TOLERANCE}
    assert not far, f"if this was meant: {make_golden.COMMAND}"


def distance(sums: list[float], old: list[float]) -> float:
    return max(abs(new - was) for new, was in zip(sums, old, strict=True)) / max(old[0], 1e-3)


def test_defaults_stay_what_old_run_folders_mean_by_them() -> None:
    assert json.loads(json.dumps(make_golden.defaults())) == GOLDEN["defaults"]


# --- Whole presets ---

SPEC = Spec(24, 6, 2)
"""The sizes of walker_walk."""
PRESETS = {
    (method, preset): presets.make("walker_walk", method, preset)
    for method, preset in itertools.product(presets.METHODS, presets.PRESETS)
}
DIFFERENT: dict[Algorithm, str] = {run.learner: " ".join(names) for names, run in PRESETS.items()}
"""Runs whose compiled functions differ; three presets of the expert with two different agents count as two, for example."""


def given(run: Run) -> tuple[list[Batch], Window, Window | None, Window | None]:
    """Demonstrations and windows of the sizes that the settings require."""
    rows, span, n = run.reward.batch_size, run.reward.span, run.agent.n_step
    draw = lambda number, steps: windows(random_batch(number + steps, 24, 6), steps)  # noqa: E731
    return [random_batch(300, 24, 6)], draw(run.agent.batch_size, n), draw(rows, span) if rows else None, None


def updated(run: Run, by: Any = None) -> Any:
    """The sums of metrics after one update, or the result of `by` (`jax.eval_shape`) for the update."""
    demos, *draws = given(run)

    def one() -> Any:
        state = learner.init(run.learner, SPEC, demos, 0)
        return learner.update(run.learner, state, *draws, np.int32(0), np.int32(0))[0].totals

    return by(one) if by else one()


def run_of(method: Algorithm) -> Run:
    return next(run for run in PRESETS.values() if run.learner == method)


@pytest.mark.parametrize("method", DIFFERENT, ids=DIFFERENT.get)
def test_every_preset_of_every_method_can_be_traced(method: Algorithm) -> None:
    """Only shapes and types are computed, so nothing is compiled."""
    totals = updated(run_of(method), jax.eval_shape)
    assert {"updates"} < set(totals) and all(
        (total.shape == () or name == "finite") and total.dtype == np.float32 for name, total in totals.items()
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", DIFFERENT, ids=DIFFERENT.get)
def test_every_preset_of_every_method_goes_through_an_update(method: Algorithm) -> None:
    totals = updated(run_of(method))
    assert float(totals["updates"]) == 1 and all(np.isfinite(total).all() for total in totals.values())
