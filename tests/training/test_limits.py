"""Limits of all numeric settings, by hand: both limits are accepted, and nothing beyond them."""

from __future__ import annotations

import dataclasses
import math
from math import inf
from typing import Any

import jax.numpy as jnp
import pytest

from pcil.agents import BC, DrQV2
from pcil.agents.base import Agent
from pcil.errors import InputError
from pcil.nets.noise import LinearSchedule
from pcil.rewards import DAC, PCIL, POTIL, PWIL, SIL, TCN
from pcil.training import presets

LIMITS: dict[Any, dict[str, tuple[float, float]]] = {
    LinearSchedule(): {"start": (0, inf), "end": (0, inf), "steps": (0, inf)},
    DrQV2(): {
        **dict.fromkeys(["batch_size", "n_step", "feature_dim", "hidden"], (1, inf)),
        **dict.fromkeys(["gamma", "learning_rate", "tau", "noise_correlation", "averaging_rate"], (0, 1)),
        "noise_clip": (0, inf),
    },
    BC(): {"learning_rate": (0, 1), "deviation": (1e-6, inf), "feature_dim": (1, inf), "hidden": (1, inf)},
    PCIL(): {
        **dict.fromkeys(["penalty", "stages", "stage_weight"], (0, inf)),
        **{"temperature": (1e-6, inf), "penalty_every": (1, inf), "hidden": (4, inf), "batch_size": (2, inf)},
        "learning_rate": (0, 1),
    },
    PCIL(penalty_rows=3): {"penalty_rows": (1, PCIL().batch_size)},
    TCN(): {"temperature": (1e-6, inf), "window": (1, inf), "margin": (1, inf), "hidden": (4, inf), "batch_size": (2, inf)},
    TCN(negatives="rollout", window=3): {"margin": (4, inf), "learning_rate": (0, 1)},
    DAC(): {"batch_size": (1, inf), "penalty": (0, inf), "hidden": (1, inf), "learning_rate": (0, 1)},
    PWIL(): {
        **{"alpha": (1e-6, inf), "beta": (0, inf), "refresh": (1, inf)},
        **{"prefill_steps": (0, inf), "batch_size": (0, inf), "task_weight": (-inf, inf)},
    },
    SIL(): {
        **dict.fromkeys(["iterations", "batch_size", "hidden", "embedding", "every"], (1, inf)),
        **{"epsilon": (3e-3, inf), "first_sum": (-inf, 0), "learning_rate": (0, 1)},
    },
    POTIL(): {"refresh": (1, inf), "epsilon": (3e-3, inf)},
}
"""The smallest and largest value of every number with limits, by hand."""
CASES = [(settings, name, *limits) for settings, numbers in LIMITS.items() for name, limits in numbers.items()]
CASES += [(kind(), "subsampling", 1, inf) for kind in (PCIL, TCN, DAC, PWIL, SIL, POTIL)]


@pytest.mark.parametrize(("settings", "name", "low", "high"), CASES, ids=lambda value: value if isinstance(value, str) else "")
def test_numbers_are_taken_up_to_their_limits_and_no_further(settings: Any, name: str, low: float, high: float) -> None:
    whole = isinstance(getattr(settings, name), int)
    kind, step = (int, 1) if whole else (float, 1e-7)
    for limit, outside in ((low, low - step), (high, high + step)):
        if abs(limit) == inf:
            dataclasses.replace(settings, **{name: kind(math.copysign(1e6, limit))})
        else:
            dataclasses.replace(settings, **{name: kind(limit)})
            with pytest.raises(InputError, match=rf"\.{name} is .* it must be"):
                dataclasses.replace(settings, **{name: kind(outside)})


@pytest.mark.parametrize("settings", [DrQV2(), BC(), PCIL()])
def test_true_is_no_whole_number(settings: Any) -> None:
    """In Python, True equals 1. Values that are not numbers at all are refused earlier, by the type checks of the tests."""
    with pytest.raises(InputError, match=r"\.batch_size is True; it must be a whole number"):
        dataclasses.replace(settings, batch_size=True)


def test_only_bc_learns_offline_and_only_the_tasks_reward_asks_for_no_demonstrations() -> None:
    made = {method: presets.make("walker_walk", method) for method in presets.METHODS}
    assert [method for method, run in made.items() if run.agent.offline] == ["bc"]
    assert [method for method, run in made.items() if not run.reward.needs_demos] == ["bc", "expert"]


def test_an_agent_without_statistics_of_observations_keeps_its_state() -> None:
    state = object()
    assert Agent.observe(DrQV2(), state, jnp.zeros((3, 2))) is state
