"""Theorem 1: its bounds, where it fails, and the two optimisers, each compared with a second computation."""

from __future__ import annotations

import functools
import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from pcil import cli, theory
from pcil.errors import InputError
from pcil.nets.losses import info_nce
from pcil.nets.networks import MLP, unit_sphere
from pcil.nets.optimiser import adam_init, adam_step

law = settings(deadline=None, derandomize=True, max_examples=40)
EXACT = 1e-12
"""Tolerance for rounding errors in sums of a few probabilities."""
SOLVED = 1e-6
"""Tolerance for the error that a thousand sweeps of the ascent leave if it is slow."""


def normalised(numbers: list[float]) -> np.ndarray:
    return np.array(numbers) / sum(numbers)


def distributions(atoms: int) -> st.SearchStrategy[np.ndarray]:
    """Probabilities of this number of atoms, some of them 0."""
    number = st.one_of(st.just(0.0), st.floats(0.001, 1.0))
    return st.lists(number, min_size=atoms, max_size=atoms).filter(lambda numbers: sum(numbers) > 0).map(normalised)


PAIRS = st.integers(1, 7).flatmap(lambda atoms: st.tuples(distributions(atoms), distributions(atoms)))
"""Two distributions on the same one to seven atoms."""


def random_weights(atoms: int, pairs: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    p, q = np.random.default_rng(seed).dirichlet(np.full(atoms, 0.5), (2, pairs))
    return p, q


def random_embedding(*shape: int, seed: int = 0) -> np.ndarray:
    phi = np.random.default_rng(seed).standard_normal(shape)
    return phi / np.linalg.norm(phi, axis=-1, keepdims=True)


def naive_objective(phi: np.ndarray, p: np.ndarray, q: np.ndarray) -> float:
    """The paper's game, sample by sample: the expert's mean reward minus the policy's, with the reward of Eq. 2."""
    rewards = [sum(p[j] * float(phi[i] @ phi[j]) for j in range(len(p))) for i in range(len(p))]
    return sum(p[i] * rewards[i] for i in range(len(p))) - sum(q[i] * rewards[i] for i in range(len(p)))


# --- The theorem ---


@law
@given(PAIRS)
def test_neither_value_exceeds_twice_the_total_variation(pair: tuple[np.ndarray, np.ndarray]) -> None:
    tv = theory.total_variation(*pair)
    assert theory.relaxed(*pair)[0] <= theory.UPPER * tv + EXACT
    assert theory.attained(*pair)[0] <= theory.UPPER * tv + EXACT


@law
@given(st.floats(0.001, 0.999))
def test_twice_the_total_variation_is_reached_for_every_mass(mass: float) -> None:
    """Up to a small error: the policy leaves S for a state that the expert never visits, and elsewhere barely exceeds it."""
    shift = mass / 1e6
    p, q = np.array([mass, 1 - mass, 0]), np.array([0, 1 - mass + shift, mass - shift])
    assert theory.expert_mass(p, q) == mass
    assert theory.attained(p, q)[0] / theory.total_variation(p, q) == pytest.approx(2, abs=1e-4)


def test_distributions_that_do_not_meet_are_at_two() -> None:
    p, q = np.array([0.3, 0.7, 0, 0]), np.array([0, 0, 0.9, 0.1])
    assert theory.relaxed(p, q)[0] == theory.attained(p, q)[0] == pytest.approx(2)
    assert theory.total_variation(p, q) == pytest.approx(1) == theory.expert_mass(p, q)


@law
@given(PAIRS)
@example(theory.COUNTER_EXAMPLE)
def test_with_halved_atoms_the_lower_bound_always_holds(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """By the ascent alone, which uses neither the relaxed optimum nor its embedding; the sharper bound holds too."""
    tv, mass = theory.total_variation(*pair), theory.expert_mass(*pair)
    reached = theory.attained(theory.halved(pair[0]), theory.halved(pair[1]))[0]
    assert reached >= theory.LOWER * tv - EXACT
    assert reached >= theory.sharper_bound(mass) * tv - SOLVED


def test_the_counter_example_is_one() -> None:
    """D_cont is 0 by a certificate, while the total variation is 1/4; with halved atoms D_cont is a third of that."""
    p, q = theory.COUNTER_EXAMPLE
    value, phi = theory.attained(p, q)
    assert theory.total_variation(p, q) == 0.25
    assert value == pytest.approx(0, abs=EXACT) and theory.certificate(p, q, phi) == pytest.approx(0, abs=EXACT)
    assert theory.attained(theory.halved(p), theory.halved(q))[0] == pytest.approx(1 / 12, abs=EXACT)
    assert theory.relaxed(p, q)[0] == pytest.approx(1 / 12, abs=EXACT)


def test_the_papers_first_case_has_counter_examples_too() -> None:
    """P = 1/2 belongs to its case 1: an expert in two states, and a policy that misses one of them."""
    p, q = np.array([0.5, 0.5]), np.array([0.0, 1.0])
    value, phi = theory.attained(p, q)
    assert theory.expert_mass(p, q) == 0.5 == theory.total_variation(p, q)
    assert value == pytest.approx(0, abs=EXACT) and theory.certificate(p, q, phi) == pytest.approx(0, abs=EXACT)


@law
@given(PAIRS)
def test_what_holds_with_atoms(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """max(2 (2P - 1), 0) always, so 0.25 for P >= 9/16; and the sharper bound if no atom outweighs the others off S."""
    p, q = pair
    tv, mass, value = theory.total_variation(p, q), theory.expert_mass(p, q), theory.attained(p, q)[0]
    assert value >= theory.bound_with_atoms(mass) * tv - EXACT
    off = np.where(p < q, p, 0)
    if mass >= 9 / 16:
        assert value >= theory.LOWER * tv - EXACT
    if off.max() <= off.sum() / 2:
        assert value >= theory.sharper_bound(mass) * tv - SOLVED


@pytest.mark.parametrize(
    ("largest", "atoms", "bound"),
    [(7 / 32, (5, 6, 8, 12), lambda mass: np.full_like(mass, theory.LOWER)), (1 / 8, (9, 10, 16), theory.sharper_bound)],
)
def test_a_cap_on_the_experts_atoms_is_enough_for_every_policy(largest: float, atoms: tuple[int, ...], bound: Any) -> None:
    """0.25 up to 7/32, the sharper bound up to 1/8; the policy exceeds the expert in one to three states of any weight."""
    rng = np.random.default_rng(0)
    for number in atoms:
        p = rng.dirichlet(np.full(number, 0.5), 60)
        cut = np.minimum(p, largest)
        room = largest - cut
        p = cut + room * ((1 - cut.sum(axis=-1)) / room.sum(axis=-1))[:, None]  # the others get the mass that was cut off
        assert p.max() <= largest + EXACT
        ahead = np.arange(number) >= number - rng.integers(1, 4, (len(p), 1))
        q = np.where(ahead, p, p * rng.uniform(0, 1, (len(p), 1)))
        q[:, -1] += 1 - q.sum(axis=-1)
        tv, mass = theory.total_variation(p, q), theory.expert_mass(p, q)
        assert np.all(theory.attained(p, q)[0] >= bound(mass) * tv - SOLVED)


def test_where_an_atom_weighs_more_than_the_rest_off_s_the_cap_leaves_p_above_nine_sixteenths() -> None:
    """The limiting case of the proof: an atom of 7/32 beside slightly less mass off S."""
    p = np.array([*np.full(4, 9 / 64), 7 / 32, 7 / 32 - 1e-9, 1e-9])
    assert p.sum() == 1 and p[4] > p[4:].sum() / 2 * (1 - 1e-8)
    q = np.array([*np.zeros(4), 0.5, 0.4, 0.1])
    assert theory.expert_mass(p, q) == pytest.approx(9 / 16) and theory.bound_with_atoms(np.array(9 / 16)) == 0.25
    assert theory.attained(p, q)[0] >= theory.LOWER * theory.total_variation(p, q)


def test_an_expert_without_a_dominant_state_may_fall_below_the_sharper_bound() -> None:
    """Uniform on three states, and a policy that is always in one of them: 2/3, where the bound would be 3/4."""
    p, q = np.full(3, 1 / 3), np.array([0.0, 0.0, 1.0])
    value, phi = theory.attained(p, q)
    tv, mass = theory.total_variation(p, q), theory.expert_mass(p, q)
    assert value / tv == pytest.approx(2 / 3, abs=SOLVED) and theory.certificate(p, q, phi) / tv == pytest.approx(
        2 / 3, abs=SOLVED
    )
    assert theory.sharper_bound(mass) == pytest.approx(3 / 4)


def test_demonstrations_that_a_policy_never_meets_are_at_two_whatever_the_policy() -> None:
    """Recorded states and a policy that never visits exactly one of them: TV is 1 and D_cont 2, at every distance."""
    p, q = np.repeat([[1 / 50], [0.0]], 50, axis=1).ravel(), np.repeat([[0.0], [1 / 50]], 50, axis=1).ravel()
    assert theory.total_variation(p, q) == pytest.approx(1)
    assert theory.attained(p, q)[0] == pytest.approx(2) == theory.relaxed(p, q)[0]


@law
@given(PAIRS, st.integers(0, 99))
def test_a_function_with_a_negative_mean_is_no_coordinate_along_v(pair: tuple[np.ndarray, np.ndarray], seed: int) -> None:
    """The other coordinates cancel, so v = (A, 0): if A is below 0, it points the other way and A is not its length."""
    p, _ = pair
    g = np.random.default_rng(seed).uniform(-1, 1, len(p))
    v = theory.halved(p) @ theory.halves_embedding(g)
    assert v == pytest.approx([g @ p, 0], abs=EXACT) and np.linalg.norm(v) == pytest.approx(abs(g @ p), abs=EXACT)


def test_every_random_failure_has_an_atom_that_outweighs_the_rest_off_s() -> None:
    p, q = random_weights(3, 400)
    below = theory.attained(p, q)[0] < theory.LOWER * theory.total_variation(p, q)
    off = np.where(p < q, p, 0)[below]
    assert below.mean() > 0.05
    assert np.all(off.max(axis=-1) > off.sum(axis=-1) / 2) and np.all(theory.expert_mass(p, q)[below] < 9 / 16)


# --- The proof, line by line ---


@law
@given(PAIRS)
def test_the_corrected_proof(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """g = 1 on S and 1/2 off it is the coordinate of an embedding of halved atoms, whose objective is (1 + P) TV / 4."""
    p, q = pair
    phi = theory.halves_embedding(np.where(p >= q, 1.0, 0.5))
    value = theory.objective(phi, theory.halved(p), theory.halved(q))
    assert value == pytest.approx((1 + theory.expert_mass(p, q)) * theory.total_variation(p, q) / 4, abs=EXACT)


@law
@given(PAIRS, st.floats(0, 0.5))
def test_the_papers_second_case_is_below_zero(pair: tuple[np.ndarray, np.ndarray], beta: float) -> None:
    """g = beta on S and -1 off it: an embedding with this coordinate has the paper's value with the other sign."""
    p, q = pair
    mass, tv = theory.expert_mass(p, q), theory.total_variation(p, q)
    phi = theory.halves_embedding(np.where(p >= q, beta, -1.0))
    value = theory.objective(phi, theory.halved(p), theory.halved(q))
    assert value == pytest.approx(-(1 - (1 + beta) * mass) * (1 + beta) * tv, abs=EXACT)
    if mass < 0.5:
        assert value <= EXACT


@pytest.mark.parametrize(("mass", "printed", "true"), [(0.1, 1.6, 0.27778), (0.001, 1.996, 0.25025)])
def test_the_printed_objective_is_larger_than_the_divergence(mass: float, printed: float, true: float) -> None:
    """With alpha = |A| instead of A, as in step 1, the value of g = (1, -1) is up to eight times that of any embedding."""
    p, q, g = np.array([mass, 1 - mass]), np.array([0.0, 1.0]), np.array([1.0, -1.0])
    assert abs(g @ p) * (g @ (p - q)) / mass == pytest.approx(printed)
    assert theory.relaxed(p, q)[0] / mass == pytest.approx(true, abs=1e-5)


# --- Closed forms ---


@law
@given(st.floats(0, 1), st.floats(0, 1))
def test_two_atoms(first: float, second: float) -> None:
    p, q = np.array([first, 1 - first]), np.array([second, 1 - second])
    mass, tv = first if first >= second else 1 - first, abs(first - second)
    assert theory.attained(p, q)[0] == pytest.approx(2 * tv * max(2 * mass - 1, 0), abs=1e-10)
    assert theory.bound_with_atoms(np.array(mass)) == max(2 * (2 * mass - 1), 0)


@law
@given(st.integers(1, 4), st.integers(1, 4), st.floats(0.001, 0.999), st.floats(0, 1), st.integers(0, 99))
def test_two_likelihood_ratios(on: int, off: int, mass: float, share: float, seed: int) -> None:
    """For any number of atoms, the best g has one value on S and one off it, so the sharper bound is the exact value."""
    rng = np.random.default_rng(seed)
    parts = rng.dirichlet(np.ones(on)), rng.dirichlet(np.ones(off))
    p, q = (np.concatenate([x * parts[0], (1 - x) * parts[1]]) for x in (mass, mass * share))
    expected = mass / (4 * (1 - mass)) if mass <= 0.75 else 2 * (2 * mass - 1) * mass
    assert theory.relaxed(p, q)[0] == pytest.approx(expected * (1 - share), abs=EXACT)
    assert theory.sharper_bound(np.array(mass)) * mass == pytest.approx(expected)


def test_the_sharper_bound_by_hand() -> None:
    masses = np.array([0, 0.25, 0.5, 0.75, 0.875, 1])
    assert theory.sharper_bound(masses) == pytest.approx([1 / 4, 1 / 3, 1 / 2, 1, 3 / 2, 2])
    assert theory.bound_with_atoms(masses) == pytest.approx([0, 0, 0, 1, 3 / 2, 2])


def test_a_quarter_cannot_be_improved() -> None:
    ratios = [theory.relaxed(np.array([p, 1 - p]), np.array([0.0, 1.0]))[0] / p for p in (0.1, 0.01, 0.001, 1e-6)]
    assert ratios == sorted(ratios, reverse=True)
    assert theory.LOWER < ratios[-1] < theory.LOWER + 1e-6


@law
@given(st.integers(1, 7).flatmap(distributions))
def test_a_distribution_is_at_no_distance_from_itself(p: np.ndarray) -> None:
    value, phi = theory.attained(p, p)
    assert theory.relaxed(p, p)[0] == 0 == value
    assert theory.certificate(p, p, phi) == pytest.approx(0, abs=EXACT)


def test_the_divergence_is_not_symmetric() -> None:
    p, q = np.array([0.1, 0.9]), np.array([0.0, 1.0])
    assert theory.relaxed(p, q)[0] == pytest.approx(0.1 / 3.6) and theory.relaxed(q, p)[0] == pytest.approx(0.2)


# --- The relaxed optimum ---


@law
@given(st.integers(1, 5).flatmap(lambda atoms: st.tuples(distributions(atoms), distributions(atoms))))
def test_the_relaxed_optimum_is_that_of_all_edges_of_the_cube(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Every g with one free level on a fine grid and the others at -1 or 1, ordered or not."""
    p, q = pair
    levels, best = np.linspace(-1, 1, 2001), -np.inf
    for free, signs in itertools.product(range(len(p)), itertools.product([-1.0, 1.0], repeat=len(p))):
        g = np.tile(signs, (len(levels), 1))
        g[:, free] = levels
        best = max(best, np.max((g @ p) * (g @ (p - q))))
    value = theory.relaxed(p, q)[0]
    assert best - EXACT <= value <= best + 1e-6


def test_no_other_function_does_better() -> None:
    grid = np.array(list(itertools.product(np.linspace(-1, 1, 41), repeat=3)))
    p, q = random_weights(3, 30)
    best = np.max((grid @ p.T) * (grid @ (p - q).T), axis=0)
    value = theory.relaxed(p, q)[0]
    assert np.all(best <= value + EXACT) and np.all(value <= best + 0.005)


@law
@given(PAIRS)
def test_the_optimum_is_a_threshold_of_the_likelihood_ratio(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """g attains the value; it is 1 where p / q is above A / (A + B) and -1 below, and at most one atom lies in between."""
    p, q = pair
    value, g = theory.relaxed(p, q)
    a, b = float(g @ p), float(g @ (p - q))
    assert np.all(np.abs(g) <= 1) and np.sum(np.abs(g) < 1) <= 1
    assert a * b == pytest.approx(float(value), abs=EXACT)
    if value > 1e-9:
        assert min(a, b) > 0
        ahead = (a + b) * p - a * q
        assert np.all(g[ahead > 1e-9] == 1) and np.all(g[ahead < -1e-9] == -1)


@law
@given(PAIRS, st.randoms(use_true_random=False))
def test_neither_order_nor_halves_matter(pair: tuple[np.ndarray, np.ndarray], random: Any) -> None:
    p, q = pair
    order = random.sample(range(len(p)), len(p))
    value = theory.relaxed(p, q)[0]
    assert theory.relaxed(p[order], q[order])[0] == pytest.approx(value, abs=EXACT)
    assert theory.relaxed(theory.halved(p), theory.halved(q))[0] == pytest.approx(value, abs=EXACT)
    assert theory.halved(p).tolist() == [weight / 2 for weight in p for _ in range(2)]


# --- The true value ---


@law
@given(PAIRS)
def test_true_is_at_most_relaxed_and_equal_with_halves(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Two ways: by the ascent on halved atoms, and by the embedding constructed for them."""
    p, q = pair
    cut = theory.halved(p), theory.halved(q)
    value, g = theory.relaxed(p, q)
    assert theory.attained(p, q)[0] <= value + EXACT
    assert theory.attained(*cut)[0] == pytest.approx(value, abs=SOLVED)
    phi = theory.halves_embedding(g)
    assert phi.shape == (2 * len(p), 2) and np.allclose(np.linalg.norm(phi, axis=-1), 1)
    assert theory.objective(phi, *cut) == pytest.approx(value, abs=EXACT)


@law
@given(PAIRS, st.integers(2, 5), st.integers(0, 99))
def test_no_embedding_exceeds_what_is_attained_and_certified(pair: tuple[np.ndarray, np.ndarray], dim: int, seed: int) -> None:
    p, q = pair
    value, phi = theory.attained(p, q)
    certified, other = theory.certificate(p, q, phi), random_embedding(len(p), dim, seed=seed)
    assert np.allclose(np.linalg.norm(phi, axis=-1), 1)
    assert theory.objective(phi, p, q) == pytest.approx(value, abs=EXACT)
    assert value - EXACT <= certified <= value + SOLVED
    assert theory.objective(other, p, q) <= certified + EXACT
    assert certified <= theory.certificate(p, q, other) + SOLVED, "any embedding gives an upper bound"


def test_the_objective_is_the_papers_game() -> None:
    p, q = random_weights(4, 3)
    phi = random_embedding(3, 4, 5)
    assert theory.objective(phi, p, q) == pytest.approx([naive_objective(*row) for row in zip(phi, p, q, strict=True)])


def test_true_equals_a_search_of_the_plane() -> None:
    """Three unit vectors in a plane, of which the first is fixed: all angles of the others, in steps of two degrees."""
    angles = np.arange(0, 2 * np.pi, np.pi / 90)
    second, third = (grid.ravel() for grid in np.meshgrid(angles, angles))
    at = np.stack([np.zeros_like(second), second, third], axis=-1)
    phi = np.stack([np.cos(at), np.sin(at)], axis=-1)
    p, q = random_weights(3, 40, seed=1)
    best = [np.max(theory.objective(phi, *(np.tile(x, (len(at), 1)) for x in row))) for row in zip(p, q, strict=True)]
    values, found = theory.attained(p, q)
    ranks = np.linalg.matrix_rank(found, tol=1e-3)
    assert set(ranks) == {1, 2}, "both kinds of optimum occur, and none needs the third dimension"
    assert np.all(best <= values + EXACT) and np.all(values <= np.array(best) + 0.001)


def test_the_best_of_the_starts_counts_even_if_it_has_not_arrived() -> None:
    """Without sweeps the starts differ; the best of them is returned with its embedding."""
    p, q = (weights[0] for weights in random_weights(6, 1))
    values = []
    for restarts in (4, 64, 2048):
        value, phi = theory.attained(p, q, restarts=restarts, sweeps=0)
        assert theory.objective(phi, p, q) == pytest.approx(value, abs=EXACT)
        values.append(float(value))
    assert values[0] <= values[1] <= values[2] < theory.attained(p, q)[0], "the first starts are the same"
    assert values[0] < values[2]


def test_many_pairs_at_once_are_as_one_by_one() -> None:
    p, q = random_weights(4, 6)
    for function in (theory.total_variation, theory.expert_mass, lambda p, q: theory.relaxed(p, q)[0]):
        assert function(p, q).tolist() == [float(function(*row)) for row in zip(p, q, strict=True)]
    assert theory.relaxed(p, q)[1].tolist() == [theory.relaxed(*row)[1].tolist() for row in zip(p, q, strict=True)]
    one_by_one = [float(theory.attained(*row)[0]) for row in zip(p, q, strict=True)]
    assert theory.attained(p, q)[0] == pytest.approx(one_by_one, abs=SOLVED)


@pytest.mark.parametrize("function", [theory.total_variation, theory.expert_mass, theory.relaxed, theory.attained])
@pytest.mark.parametrize(
    ("p", "q", "said"),
    [
        ([0.5, 0.6], [0.5, 0.5], "p is .* sum to 1"),
        ([0.5, 0.5], [1.5, -0.5], "q is .* at least 0"),
        ([0.5, np.nan], [0.5, 0.5], "p is .* at least 0"),
    ],
)
def test_only_distributions_are_compared(function: Any, p: list[float], q: list[float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        function(np.array(p), np.array(q))


# --- A trained embedding ---

CELLS = (np.arange(64) + 0.5) / 32 - 1
"""Centres of 64 cells of [-1, 1]; no cell is heavy, so the relaxed optimum almost equals the true one."""


def densities(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The counter-example, spread over a line, or two normal distributions."""
    if name == "two levels":
        return np.where(CELLS < 0, 0.25, 0.75) / 32, np.where(CELLS < 0, 0.0, 1.0) / 32
    p, q = (np.exp(-0.5 * ((CELLS - centre) / 0.4) ** 2) for centre in (-0.2, 0.3))
    return p / p.sum(), q / q.sum()


@functools.partial(jax.jit, static_argnames="steps")
def train_embedding(p: Array, q: Array, x: Array, *, steps: int) -> tuple[Array, Array]:
    """Train an MLP to the unit sphere with the linear loss (Eq. 7); returns the embedding of each row of `x` and the losses."""

    def loss(net: MLP) -> Float[Array, ""]:
        phi = unit_sphere(net(x))
        anchor = p @ phi
        return q @ (phi @ anchor) - p @ (phi @ anchor)

    def step(carry: Any, _: None) -> tuple[Any, Array]:
        net, opt_state = carry
        value, gradient = jax.value_and_grad(loss)(net)
        return adam_step(net, gradient, opt_state, 3e-3), value

    net = MLP.init((x.shape[1], 64, 64, 8), key=jax.random.key(0))
    (net, _), losses = jax.lax.scan(step, (net, adam_init(net)), None, length=steps)
    return unit_sphere(net(x)), losses


@pytest.mark.parametrize("name", ["two levels", "normal"])
def test_a_trained_embedding_comes_close_to_the_exact_value_and_never_exceeds_it(name: str) -> None:
    p, q = densities(name)
    exact = float(theory.relaxed(p, q)[0])
    phi, losses = train_embedding(*(jnp.asarray(x, jnp.float32) for x in (p, q, 4 * CELLS[:, None])), steps=300)
    objectives = -np.asarray(losses, np.float64)
    assert np.all(objectives <= exact + 1e-6), "not at any step"
    assert objectives[0] < 0.5 * exact and objectives[-1] > 0.999 * exact
    unit = np.asarray(phi, np.float64) / np.linalg.norm(phi, axis=-1, keepdims=True)
    assert theory.objective(unit, p, q) == pytest.approx(objectives[-1], rel=1e-3)
    assert objectives[-1] > theory.LOWER * theory.total_variation(p, q)


def test_the_linear_loss_is_the_contrastive_one_where_logits_are_nearly_equal() -> None:
    """Eqs. 4 to 6 for cosines 0.8 and -0.6: log 2 + (-0.6 - 0.8) / (2T) is close at temperature 100 and far off at 0.07."""
    anchor, positive, negative = np.array([[1.0, 0.0], [0.8, 0.6], [-0.6, 0.8]])
    slope = anchor @ (negative - positive) / 2
    assert slope == pytest.approx((np.sum((anchor - positive) ** 2) - np.sum((anchor - negative) ** 2)) / 4) == -0.7
    rows = [jnp.asarray(row[None], jnp.float32) for row in (anchor, positive, negative)]

    def off(temperature: float) -> float:
        return temperature * (float(info_nce(*rows, temperature)[0]) - np.log(2)) - slope

    assert off(100.0) == pytest.approx(1.4**2 / 800, rel=0.01), "the next term of the series"
    assert 0.2 < off(1.0) < 0.25 and off(0.07) > 0.6


# --- The command ---


def test_random_pairs_are_a_function_of_their_seed() -> None:
    one, same, other = (theory.random_pairs(3, 50, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(one, same, strict=True))
    assert not np.intersect1d(one.mass, other.mass).size
    assert np.all(one.gap < SOLVED) and np.all(one.true <= one.relaxed + SOLVED)
    assert np.all(one.relaxed >= theory.sharper_bound(one.mass) - EXACT) and np.all(one.relaxed <= theory.UPPER + EXACT)


def test_shares_and_extremes_are_counted() -> None:
    mass, gap = np.full(4, 0.5), np.array([1e-9, 0, 0, 0])
    pairs = theory.Pairs(7, mass, np.array([0.5, 0.25, 1, 2]), np.array([0.5, 0.2499, 0, 1.5]), gap)
    figures = theory.measure([pairs])
    (row,) = figures["pairs"]
    assert row == {
        "atoms": 7,
        "draws": 4,
        "relaxed_min": 0.25,
        "relaxed_max": 2,
        "relaxed_below": 0,
        "true_min": 0,
        "true_max": 1.5,
        "true_below": 0.5,
        "gap": 1e-9,
    }
    assert "     7    0.2500  2.0000        0.0%    0.0000  1.5000       50.0%            1e-09" in theory.table(figures)


def test_computed_figures_equal_their_formulas() -> None:
    figures = theory.measure([theory.random_pairs(2, 5)])
    for row in figures["two_atoms"]:
        assert row["relaxed"] == pytest.approx(row["relaxed_formula"], abs=1e-9)
        assert row["true"] == pytest.approx(row["true_formula"], abs=1e-9)
    assert figures["two_atoms"][0]["relaxed"] < 0.2501
    counter = figures["counter_example"]
    assert (counter["p"], counter["q"], counter["tv"]) == ([0.25, 0.75], [0, 1], 0.25)
    assert [counter[name] for name in ("true", "halved", "relaxed")] == pytest.approx([0, 1 / 12, 1 / 12], abs=EXACT)


def test_json_is_one_object_and_nothing_else_and_imports_no_jax(tmp_path: Path) -> None:
    """The whole command, in a separate process; it draws no picture unless asked. docs/theory.md has its numbers."""
    code = "import sys; from pcil import cli; code = cli.main(sys.argv[1:]); assert 'jax' not in sys.modules; sys.exit(code)"
    command = [sys.executable, "-c", code, "theory", "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    figures = json.loads(result.stdout)
    assert list(figures) == ["pairs", "counter_example", "two_atoms"] and result.stderr == ""
    assert [row["atoms"] for row in figures["pairs"]] == list(theory.ATOMS) and not list(tmp_path.iterdir())
    for row in figures["pairs"]:
        assert row["relaxed_below"] == 0 and row["relaxed_min"] >= 0.25 and row["relaxed_max"] <= 2
        assert row["gap"] < SOLVED and row["true_min"] <= row["relaxed_min"]
    assert figures["pairs"][0]["true_below"] > 0.2 and figures["pairs"][-1]["true_below"] == 0
    page = (Path(__file__).parent.parent.parent / "docs" / "theory.md").read_text()
    cells = "| {atoms} |" + "".join(f" {{{x}_min:.4f}} | {{{x}_max:.4f}} | {{{x}_below:.1%}} |" for x in ("relaxed", "true"))
    assert all(cells.format(**row) in page for row in figures["pairs"])


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use only small pairs."""
    monkeypatch.setattr(theory, "ATOMS", (2, 3))


@pytest.mark.usefixtures("quick")
def test_the_command_prints_a_table_and_draws_where_it_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["theory"]) == 0
    out = capsys.readouterr().out
    assert "TV = 0.25, D_cont = 0.0000" in out and "Figure" not in out and not list(tmp_path.iterdir())
    assert cli.main(["theory", "--out", "."]) == 0
    assert capsys.readouterr().out == f"{out}Figure: theory.png\n"
    assert {path.name for path in tmp_path.iterdir()} == {"theory.png", "theory.pdf"}
    assert cli.main(["theory", "--out", "deep/er", "--json", "--seed", "3"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["pairs"][0]["atoms"] == 2 and err == "Figure: deep/er/theory.png\n"
    assert (tmp_path / "deep" / "er" / "theory.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.usefixtures("quick")
def test_without_matplotlib_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "pcil.theory.figure", raising=False)
    monkeypatch.delitem(sys.modules, "pcil.report.figures", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert cli.main(["theory", "--out", "."]) == 0
    told = "No figure is drawn without matplotlib; pip install '.[report]' in a clone brings it."
    assert capsys.readouterr().out.splitlines()[-1] == told
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("words", "said"), [("--out file", "--out names a folder"), ("--seed -1", "--seed is -1")])
def test_bad_input_is_one_sentence(words: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    assert cli.main(["theory", *words.split()]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and said in err
