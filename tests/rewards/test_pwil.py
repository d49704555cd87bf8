"""PWIL's greedy coupling by hand, by a naive one that deletes atoms, and by exact transport."""

from __future__ import annotations

import functools
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcil.nets.networks import Trunk
from pcil.rewards.pwil import PWIL, PWILState, greedy_distances, move
from pcil.types import Batch
from small import batches, random_batch, staying

GREEDY = jax.jit(greedy_distances)
MOVE = jax.jit(move)
KEY = jax.random.key(0)
EMBED = Trunk.init(3, 6, key=jax.random.key(9))


def column(*values: float) -> jax.Array:
    return jnp.array(values, jnp.float32)[:, None]


def grid(rows: int, seed: int) -> np.ndarray:
    """Points with small integer coordinates: their distances are exact in float32, and many are equal."""
    return np.random.default_rng(seed).integers(-3, 4, (rows, 2)).astype(np.float32)


def naive_costs(atoms: np.ndarray, points: np.ndarray, horizon: int) -> list[float]:
    """The cost of each step by the paper's Algorithm 1 with exact fractions; used atoms are removed from the list."""
    held: list[list[Any]] = []
    costs = []
    for time, point in enumerate(points):
        if time % horizon == 0:
            held = [[atom, Fraction(1, len(atoms))] for atom in atoms]
        mass, cost = Fraction(1, horizon), 0.0
        while mass > 0:
            distances = [float(np.sqrt(((atom - point) ** 2).sum())) for atom, _ in held]
            nearest = distances.index(min(distances))
            moved = min(mass, held[nearest][1])
            cost += float(moved) * distances[nearest]
            mass -= moved
            held[nearest][1] -= moved
            if held[nearest][1] == 0:
                del held[nearest]
        costs.append(cost)
    return costs


def test_coupling_by_hand() -> None:
    """Three atoms for two steps: each step fills 1.5 atoms. The first takes atom 0 and half of atom 1; the second, the rest."""
    assert np.allclose(GREEDY(column(0, 1, 5), column(0, 0), jnp.int32(2)), [(1 * 0 + 0.5 * 1) / 1.5, (0.5 * 1 + 1 * 5) / 1.5])
    assert np.allclose(GREEDY(column(0, 4), column(1, 2, 3, 9), jnp.int32(4)), [1, 2, 1, 5])


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    atoms=st.integers(1, 7),
    points=st.sampled_from([1, 4, 9]),
    horizon=st.integers(1, 12),
    seed=st.integers(0, 999),
)
def test_costs_equal_those_of_a_naive_coupling_step_by_step(atoms: int, points: int, horizon: int, seed: int) -> None:
    """Episodes as long as the horizon, shorter, and longer, in which all capacity is restored after the horizon."""
    a, x = grid(atoms, seed), grid(points, seed + 1000)
    distances = np.asarray(GREEDY(jnp.asarray(a), jnp.asarray(x), jnp.int32(horizon)))
    assert np.allclose(distances / horizon, naive_costs(a, x, horizon), rtol=1e-5, atol=1e-7)


@settings(deadline=None, derandomize=True, max_examples=25)
@given(atoms=st.sampled_from([1, 5]), horizon=st.integers(1, 12), seed=st.integers(0, 999))
def test_mass_is_conserved_and_a_full_atom_gets_no_more(atoms: int, horizon: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    left = jnp.full(atoms, horizon)
    for _ in range(horizon):
        before = np.asarray(left)
        left, distance = MOVE(left, jnp.asarray(rng.random(atoms, np.float32)))
        assert before.sum() - np.asarray(left).sum() == atoms, "a step has as many units as there are atoms"
        assert (np.asarray(left) >= 0).all() and (np.asarray(left) <= before).all()
        assert 0 <= float(distance) < 1
    assert not np.asarray(left).any(), "an episode of the horizon's length fills every atom"


@settings(deadline=None, derandomize=True, max_examples=25)
@given(atoms=st.sampled_from([2, 7]), horizon=st.sampled_from([3, 6]), seed=st.integers(0, 999))
def test_the_greedy_coupling_costs_at_least_the_exact_one(atoms: int, horizon: int, seed: int) -> None:
    """Over a whole episode it is a coupling of the two measures, so its cost bounds the Wasserstein distance from above."""
    a, x = grid(atoms, seed), grid(horizon, seed + 1000)
    greedy = float(np.sum(np.asarray(GREEDY(jnp.asarray(a), jnp.asarray(x), jnp.int32(horizon))))) / horizon
    distance = np.linalg.norm(x[:, None].astype(np.float64) - a[None], axis=-1)
    exact = float(ot.emd2(np.full(horizon, 1 / horizon), np.full(atoms, 1 / atoms), distance))
    assert greedy >= exact - 1e-6


def test_distances_that_are_not_finite_end_too() -> None:
    """A full atom must rank behind one that is infinitely far away, or the loop would choose it forever."""
    left, distance = MOVE(jnp.array([0, 4]), jnp.array([1.0, jnp.inf]))
    assert left.tolist() == [0, 2] and float(distance) > 1e37
    left, distance = MOVE(jnp.array([0, 4]), jnp.array([1.0, jnp.nan]))
    assert left.tolist() == [0, 2] and np.isnan(distance)


@functools.partial(jax.jit, static_argnames="pwil")
def reward(pwil: PWIL, state: PWILState, batch: Batch, embed: Any = EMBED) -> jax.Array:
    return pwil.reward(state, batch, embed, key=KEY)


def reward_of(pwil: PWIL, demos: list[Batch], episode: Batch) -> np.ndarray:
    return np.asarray(reward(pwil, pwil.init(demos, EMBED, key=KEY), episode))


DEMOS = [random_batch(30, 3, 2, seed) for seed in (1, 2)]
EPISODE = random_batch(30, 3, 2, 5)


@pytest.mark.parametrize("inputs", ["state", "state-action"])
def test_reward_is_the_papers_formula(inputs: Any) -> None:
    """`alpha exp(-beta T / sqrt(|S| + |A|) c)` with the demonstrations standardised as by StandardScaler."""

    def rows(batch: Batch) -> np.ndarray:
        return np.concatenate([batch.obs, batch.action], axis=1) if inputs == "state-action" else batch.obs

    expert = np.concatenate([rows(demo) for demo in DEMOS])
    atoms, points = ((x - expert.mean(axis=0)) / expert.std(axis=0) for x in (expert, rows(EPISODE)))
    costs = np.array(naive_costs(atoms, points, 30))
    expected = 3 * np.exp(-2 * 30 / np.sqrt(5) * costs)
    assert np.allclose(reward_of(PWIL(inputs=inputs, alpha=3.0, beta=2.0), DEMOS, EPISODE), expected, rtol=1e-4)


def test_reward_lies_between_0_and_alpha_which_a_copy_of_the_demonstration_earns() -> None:
    for demo in (random_batch(20, 3, 2, 7), staying(np.tile(np.float32([[1, 2, 3]]), (20, 1)), np.zeros((20, 2), np.float32))):
        assert np.allclose(reward_of(PWIL(alpha=4.0), [demo], demo), 4)
    got = reward_of(PWIL(alpha=4.0), DEMOS, EPISODE)
    assert (got > 0).all() and (got <= 4).all()


def test_a_step_is_paid_by_what_came_before_it_and_not_by_what_comes_after() -> None:
    changed = EPISODE.obs.copy()
    changed[20] += 1
    one, two = reward_of(PWIL(), DEMOS, EPISODE), reward_of(PWIL(), DEMOS, staying(changed, EPISODE.action))
    assert np.array_equal(one[:20], two[:20]) and not np.allclose(one[20:], two[20:])


def test_order_matters() -> None:
    """With the same steps in another order, the first step takes the nearest atoms."""
    order = np.random.default_rng(0).permutation(30)
    shuffled = reward_of(PWIL(), DEMOS, staying(EPISODE.obs[order], EPISODE.action[order]))
    assert not np.allclose(shuffled, reward_of(PWIL(), DEMOS, EPISODE)[order])


def test_units_and_origins_of_states_do_not_matter_and_constant_entries_stay_finite() -> None:
    unit, origin = np.float32([10, 0.1, 3]), np.float32([5, -2, 0])

    def other(batch: Batch) -> Batch:
        constant = np.full((len(batch.obs), 1), 0.1, np.float32)
        return staying(np.concatenate([batch.obs * unit + origin, constant], axis=1), batch.action)

    plain = staying(np.pad(EPISODE.obs, ((0, 0), (0, 1))), EPISODE.action)
    demos = [staying(np.pad(demo.obs, ((0, 0), (0, 1))), demo.action) for demo in DEMOS]
    got, expected = reward_of(PWIL(), [other(d) for d in DEMOS], other(EPISODE)), reward_of(PWIL(), demos, plain)
    assert np.isfinite(got).all() and np.allclose(got, expected, rtol=1e-2)


def test_subsampling_leaves_fewer_atoms_and_the_same_horizon() -> None:
    steps = staying(np.arange(23, dtype=np.float32)[:, None], np.zeros((23, 1), np.float32))
    state = PWIL(subsampling=5).init([steps, steps], EMBED, key=KEY)
    assert state.atoms[:, 0].tolist() == [0, 5, 10, 15, 20, 1, 6, 11, 16, 21]
    assert int(state.horizon) == 23, "the horizon is the demonstration's own length"


def test_the_horizon_is_that_of_the_longest_demonstration() -> None:
    demos = [random_batch(steps, 3, 2) for steps in (4, 9, 6)]
    state = PWIL().init(demos, EMBED, key=KEY)
    assert int(state.horizon) == 9 and state.atoms.shape == (19, 3)


def test_slow_features_are_those_of_the_trunk_at_its_last_turn() -> None:
    """Until the first refresh, they are those of the initial trunk; the reward never uses the agent's current trunk."""
    trunks = [Trunk.init(3, 6, key=jax.random.key(seed)) for seed in range(4)]
    pwil = PWIL(inputs="trunk", refresh=2)
    nothing = Batch(*(array[:0] for array in batches(EPISODE)))
    state = pwil.init(DEMOS, trunks[0], key=KEY)
    expert = np.concatenate([demo.obs for demo in DEMOS])

    def expected(trunk: Trunk) -> np.ndarray:
        costs = np.array(naive_costs(trunk(expert, np), trunk(EPISODE.obs, np), 30))
        return 5 * np.exp(-5 * 30 / np.sqrt(6) * costs)

    for updates, slow in enumerate([0, 0, 2, 2]):
        if updates:
            state, _ = pwil.update(state, nothing, nothing, trunks[updates], key=KEY)
        got = reward(pwil, state, EPISODE, trunks[updates])
        assert np.allclose(got, expected(trunks[slow]), rtol=1e-3)
    assert pwil.trunk == "actor"


def test_prefill_pays_alpha() -> None:
    assert PWIL(prefill_steps=70, alpha=3.0).prefill == (70, 3)
    assert PWIL().prefill == (0, 5)
