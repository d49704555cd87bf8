"""Theorem 1 of the paper, `0.25 TV <= D_cont <= 2 TV`, computed for finite distributions (`pcil theory`).

`p` is the expert's distribution, `q` the policy's, `d = p - q`, and `S` the set of atoms with `p >= q`. An embedding `Phi` maps
each atom to the unit sphere. With its means `v` and `w` under `p` and `q`, `D_cont` is the maximum of `v . (v - w)` over all
embeddings. See docs/theory.md for the results and their proofs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pcil.errors import InputError

Weights = Float[np.ndarray, "*pairs atoms"]
"""One number per atom, for one pair of distributions or a batch of pairs."""
Embedding = Float[np.ndarray, "*pairs atoms dim"]
"""One unit vector per atom."""
Values = Float[np.ndarray, "*pairs"]

LOWER, UPPER = 0.25, 2.0
"""The constants of the theorem."""
COUNTER_EXAMPLE = np.array([0.25, 0.75]), np.array([0.0, 1.0])
"""`p` and `q` with `TV = 0.25` and `D_cont = 0`."""
ATOMS = (2, 3, 5, 10, 30)
"""The numbers of atoms of the random pairs."""


def total_variation(p: Weights, q: Weights) -> Values:
    """Half the sum of `|p - q|`, in [0, 1], as in the paper."""
    return np.asarray(np.abs(_difference(p, q)).sum(axis=-1) / 2)


def expert_mass(p: Weights, q: Weights) -> Values:
    """`P = p(S)`: the expert's probability of the atoms that the policy visits at most as often as the expert."""
    return np.asarray(np.where(_difference(p, q) >= 0, p, 0).sum(axis=-1))


def objective(phi: Embedding, p: Weights, q: Weights) -> Values:
    """`v . (v - w)`: the expert's mean reward minus the policy's, which is the negative loss of Eqs. 6 to 8."""
    v, u = (np.einsum("...n,...nk->...k", weights, phi) for weights in (p, _difference(p, q)))
    return np.asarray((v * u).sum(axis=-1))


def relaxed(p: Weights, q: Weights) -> tuple[Values, Weights]:
    """The maximum of `A B` over functions `g` from the atoms to [-1, 1], with `A = sum g p` and `B = sum g d`, and its `g`.

    It is an upper bound of `D_cont`: take as `g` the coordinate of `Phi` along `v`. The points `(A, B)` form a zonotope with
    one generator `(p_i, d_i)` per atom. `A B` is a saddle, so its maximum is on the boundary and, by the symmetry `g -> -g`, on
    the upper half of it. That half starts at `g = -1` and raises one atom after the other to 1, in decreasing order of `p / q`.
    On each edge `A B` is quadratic. The cost is that of sorting.
    """
    d = _difference(p, q)
    order = np.argsort(-np.arctan2(d, p), axis=-1)
    p, d = (np.take_along_axis(weights, order, axis=-1) for weights in (p, d))
    a, b = (2 * (np.cumsum(weights, axis=-1) - weights) - weights.sum(axis=-1, keepdims=True) for weights in (p, d))
    with np.errstate(all="ignore"):  # where A B is linear, its maximum is at one of the ends
        flat = np.nan_to_num(-(a * d + b * p) / (4 * p * d))
    t = np.stack([np.zeros_like(a), np.clip(flat, 0, 1), np.ones_like(a)])  # both ends and the stationary point
    height = (a + 2 * t * p) * (b + 2 * t * d)
    t = np.take_along_axis(t, height.argmax(axis=0, keepdims=True), axis=0)[0]
    later = np.arange(p.shape[-1]) - height.max(axis=0).argmax(axis=-1)[..., None]
    g = np.empty_like(t)
    np.put_along_axis(g, order, np.where(later == 0, 2 * t - 1, -np.sign(later)), axis=-1)
    return np.asarray(height.max(axis=(0, -1))), g


def halved(weights: Weights) -> Float[np.ndarray, "*pairs 2*atoms"]:
    """Each atom split into two adjacent ones of equal weight, as if each sample came with a fair coin toss."""
    return np.repeat(weights / 2, 2, axis=-1)


def halves_embedding(g: Weights) -> Float[np.ndarray, "*pairs 2*atoms dim"]:
    """The embedding of split atoms at `(g, h)` and `(g, -h)`: then `v = (A, 0)`, and `objective` is `A B`.

    So with split atoms the relaxed optimum is attained in two dimensions.
    """
    h = np.sqrt(1 - g * g)
    return np.stack([np.repeat(g, 2, axis=-1), np.stack([h, -h], axis=-1).reshape(*g.shape[:-1], -1)], axis=-1)


def attained(p: Weights, q: Weights, *, restarts: int = 4, sweeps: int = 1000, seed: int = 0) -> tuple[Values, Embedding]:
    """The true `D_cont` and an embedding that attains it; `certificate` bounds the distance to the optimum.

    The objective is linear in the Gram matrix `G` of the embedding, `sum_ij p_i d_j G_ij`: a semidefinite programme with unit
    diagonal. It has a solution in three dimensions, since vectors of given lengths that can sum to 0 at all can do so in a
    plane. This is coordinate ascent in four dimensions from random starts: each vector in turn moves to its optimum given the
    others, until nothing improves.
    """
    d = _difference(p, q)[..., None, :, None]  # one axis for restarts, one for coordinates
    p = p[..., None, :, None]
    phi = np.random.default_rng(seed).standard_normal((*p.shape[:-3], restarts, p.shape[-2], 4))
    phi /= np.linalg.norm(phi, axis=-1, keepdims=True)
    value = np.full(phi.shape[:-2], -np.inf)
    for sweep in range(sweeps + 1):
        before, v, u = value, (p * phi).sum(axis=-2), (d * phi).sum(axis=-2)
        value = (v * u).sum(axis=-1)
        if sweep == sweeps or np.max(value - before) < 1e-14:
            break
        for i in range(p.shape[-2]):
            p_i, d_i, own = p[..., i, :], d[..., i, :], phi[..., i, :]
            pull = p_i * (u - d_i * own) + d_i * (v - p_i * own)
            length = np.linalg.norm(pull, axis=-1, keepdims=True)
            moved = np.divide(pull, length, out=own.copy(), where=length > 0)
            v, u = v + p_i * (moved - own), u + d_i * (moved - own)
            phi[..., i, :] = moved
    best = value.argmax(axis=-1)[..., None]
    phi = np.take_along_axis(phi, best[..., None, None], axis=-3)[..., 0, :, :]
    return np.asarray(np.maximum(value.max(axis=-1), 0)), phi  # a constant embedding attains 0


def certificate(p: Weights, q: Weights, phi: Embedding) -> Values:
    """An upper bound of `D_cont` by weak duality; it is tight for an optimal `phi`.

    With `C` the symmetric part of `p d^T`, any `y`, and `e` the largest eigenvalue of `C - diag y`, or 0 if that is negative,
    `<C, G> = sum y + <C - diag y, G> <= sum y + n e`, because `G` is positive semidefinite with trace `n`. At an
    optimum `y_i = sum_j C_ij G_ij`.
    """
    product = p[..., :, None] * _difference(p, q)[..., None, :]
    c = (product + np.swapaxes(product, -1, -2)) / 2
    y = (phi * (c @ phi)).sum(axis=-1)
    largest = np.linalg.eigvalsh(c - np.eye(p.shape[-1]) * y[..., None])[..., -1]
    return np.asarray(y.sum(axis=-1) + p.shape[-1] * np.maximum(largest, 0))


def sharper_bound(mass: Values) -> Values:
    """The best lower bound of `D_cont / TV` as a function of `P`, for split atoms; 0.25 at 0 and 2 at 1.

    It is the maximum of `A B / TV` over `g` that are 1 on `S` and constant outside, and exact if `p / q` takes only two values.
    """
    return np.where(mass <= 0.75, 0.25 / (1 - np.minimum(mass, 0.75)), 2 * (2 * mass - 1))


def bound_with_atoms(mass: Values) -> Values:
    """A lower bound of `D_cont / TV` without split atoms, from opposite vectors on and off `S`; exact for two atoms."""
    return np.asarray(np.maximum(2 * (2 * mass - 1), 0))


class Pairs(NamedTuple):
    """Random pairs of distributions with the same number of atoms; `relaxed`, `true` and `gap` are divided by `TV`."""

    atoms: int
    mass: Float[np.ndarray, " draws"]
    """`expert_mass`."""
    relaxed: Float[np.ndarray, " draws"]
    """`D_cont` with split atoms, attained by `halves_embedding`."""
    true: Float[np.ndarray, " draws"]
    """`D_cont` of the original atoms."""
    gap: Float[np.ndarray, " draws"]
    """An upper bound of the error of both values, from the relaxed optimum and `certificate`."""


def random_pairs(atoms: int, draws: int = 300, seed: int = 0) -> Pairs:
    """Draw both distributions from Dirichlet(1/2, ..., 1/2), which mixes rare and frequent atoms."""
    p, q = np.random.default_rng([seed, atoms]).dirichlet(np.full(atoms, 0.5), (2, draws))
    tv, (most, g), (true, phi) = total_variation(p, q), relaxed(p, q), attained(p, q, seed=seed)
    built = objective(halves_embedding(g), halved(p), halved(q))
    gap = np.maximum(certificate(p, q, phi) - true, most - built)
    return Pairs(atoms, expert_mass(p, q), built / tv, true / tv, gap / tv)


def measure(pairs: Sequence[Pairs]) -> dict[str, Any]:
    """The output of `pcil theory --json`."""
    rows = []
    for size in pairs:
        row: dict[str, Any] = {"atoms": size.atoms, "draws": len(size.mass)}
        for name, ratio in (("relaxed", size.relaxed), ("true", size.true)):
            below = np.mean(ratio < LOWER)
            row |= {f"{name}_min": float(ratio.min()), f"{name}_max": float(ratio.max()), f"{name}_below": float(below)}
        rows.append(row | {"gap": float(size.gap.max())})
    p, q = COUNTER_EXAMPLE
    values = {"tv": total_variation(p, q), "true": attained(p, q)[0], "relaxed": relaxed(p, q)[0]}
    values["halved"] = attained(halved(p), halved(q))[0]
    counter = {"p": p.tolist(), "q": q.tolist()} | {name: float(value) for name, value in values.items()}
    mass = np.array([1e-4, 0.001, 0.01, 0.1, 0.3, 0.5, 0.6, 0.75, 0.9])
    p, q = np.stack([mass, 1 - mass], axis=-1), np.tile([0.0, 1.0], (len(mass), 1))  # so that `TV` is `P`
    columns = (mass, sharper_bound(mass), relaxed(p, q)[0] / mass, bound_with_atoms(mass), attained(p, q)[0] / mass)
    names = ("P", "relaxed_formula", "relaxed", "true_formula", "true")
    two_atoms = [dict(zip(names, row, strict=True)) for row in np.stack(columns, axis=-1).tolist()]
    return {"pairs": rows, "counter_example": counter, "two_atoms": two_atoms}


def table(figures: dict[str, Any]) -> str:
    """The results as plain text."""
    rows, counter, kinds = figures["pairs"], figures["counter_example"], ("relaxed", "true")
    over = f"{'':6}   {'atoms cut into halves':^27}   {'atoms as they are':^27}"
    cells = "".join(f"   {{{kind}_min:7.4f}}{{{kind}_max:8.4f}}{{{kind}_below:12.1%}}" for kind in kinds)
    lines = [f"D_cont / TV of random pairs, {rows[0]['draws']} of each size; Theorem 1 says 0.25 to 2", "", over]
    lines += [f"{'atoms':>6}" + 2 * f"   {'min':>7}{'max':>8}{'below 0.25':>12}" + "   optimal within"]
    lines += [f"{row['atoms']:6}{cells.format(**row)}   {row['gap']:14.0e}" for row in rows]
    lines += ["", "The counter-example, p = {p}, q = {q}: TV = {tv:g}, D_cont = {true:.4f}".format(**counter)]
    lines += ["With its atoms cut into halves D_cont = {halved:.4f}; relaxed optimum {relaxed:.4f}".format(**counter)]
    lines += ["", "D_cont / TV of two atoms, p = (P, 1 - P), q = (0, 1)", "", over]
    lines += [f"{'P':>6}" + 2 * f"   {'formula':>15}{'computed':>12}"]
    cells = "".join(f"   {{{kind}_formula:15.5f}}{{{kind}:12.5f}}" for kind in kinds)
    lines += [f"{row['P']:6g}{cells.format(**row)}" for row in figures["two_atoms"]]
    return "\n".join(line.rstrip() for line in lines)


def _difference(p: Weights, q: Weights) -> Weights:
    """`p - q`; `InputError` unless both are distributions."""
    for name, weights in (("p", p), ("q", q)):
        if not (np.all(weights >= 0) and np.allclose(weights.sum(axis=-1), 1, rtol=0, atol=1e-9)):
            raise InputError(f"{name} is {weights}; probabilities are at least 0 and sum to 1.")
    return p - q
