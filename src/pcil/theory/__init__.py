"""Theorem 1 of the paper, `0.25 TV <= D_cont <= 2 TV`, computed on finite distributions (`pcil theory`).

`p` is the expert's distribution, `q` the policy's, `d = p - q`, and `S` the atoms with `p >= q`. An embedding `Phi` maps each
atom to the unit sphere; with `v` and `w` its means under `p` and `q`, `D_cont` is the largest `v . (v - w)`. What holds, what
does not, and the proofs are in docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pcil.errors import InputError

Weights = Float[np.ndarray, "*pairs atoms"]
"""A number for each atom, of one pair of distributions or of many at once."""
Embedding = Float[np.ndarray, "*pairs atoms dim"]
"""A unit vector for each atom."""
Values = Float[np.ndarray, "*pairs"]

LOWER, UPPER = 0.25, 2.0
"""The theorem's two constants."""
COUNTER_EXAMPLE = np.array([0.25, 0.75]), np.array([0.0, 1.0])
"""`p` and `q` with `TV = 0.25` and `D_cont = 0`."""
ATOMS = (2, 3, 5, 10, 30)
"""Sizes of the random pairs."""


def total_variation(p: Weights, q: Weights) -> Values:
    """Half the sum of `|p - q|`: in [0, 1], as the paper defines it."""
    return np.asarray(np.abs(_difference(p, q)).sum(axis=-1) / 2)


def expert_mass(p: Weights, q: Weights) -> Values:
    """`P = p(S)`: how much of the expert lies where the policy comes no more often than it."""
    return np.asarray(np.where(_difference(p, q) >= 0, p, 0).sum(axis=-1))


def objective(phi: Embedding, p: Weights, q: Weights) -> Values:
    """`v . (v - w)`: the mean reward of the expert above that of the policy, the negative of the loss in Eqs. 6 to 8."""
    v, u = (np.einsum("...n,...nk->...k", weights, phi) for weights in (p, _difference(p, q)))
    return np.asarray((v * u).sum(axis=-1))


def relaxed(p: Weights, q: Weights) -> tuple[Values, Weights]:
    """The largest `A B` over all `g` from the atoms to [-1, 1], with `A = sum g p` and `B = sum g d`, and that `g`.

    No embedding exceeds it: take for `g` the coordinate of `Phi` along `v`. The points `(A, B)` form a zonotope with a
    generator `(p_i, d_i)` for each atom. `A B` is a saddle, so it is largest on the boundary, and since `-g` does as well as
    `g`, on the upper half of it. That half starts at `g = -1` and raises one atom after the other to 1, the largest `p / q`
    first; on each of its edges `A B` is a quadratic. Sorting is the whole cost.
    """
    d = _difference(p, q)
    order = np.argsort(-np.arctan2(d, p), axis=-1)
    p, d = (np.take_along_axis(weights, order, axis=-1) for weights in (p, d))
    a, b = (2 * (np.cumsum(weights, axis=-1) - weights) - weights.sum(axis=-1, keepdims=True) for weights in (p, d))
    with np.errstate(all="ignore"):  # along an axis A B is linear, and any place will do
        flat = np.nan_to_num(-(a * d + b * p) / (4 * p * d))
    t = np.stack([np.zeros_like(a), np.clip(flat, 0, 1), np.ones_like(a)])  # both ends, and where the slope is 0
    height = (a + 2 * t * p) * (b + 2 * t * d)
    t = np.take_along_axis(t, height.argmax(axis=0, keepdims=True), axis=0)[0]
    later = np.arange(p.shape[-1]) - height.max(axis=0).argmax(axis=-1)[..., None]
    g = np.empty_like(t)
    np.put_along_axis(g, order, np.where(later == 0, 2 * t - 1, -np.sign(later)), axis=-1)
    return np.asarray(height.max(axis=(0, -1))), g


def halved(weights: Weights) -> Float[np.ndarray, "*pairs 2*atoms"]:
    """Each atom cut into two equal ones, next to each other, as if a fair coin were thrown with every sample."""
    return np.repeat(weights / 2, 2, axis=-1)


def halves_embedding(g: Weights) -> Float[np.ndarray, "*pairs 2*atoms dim"]:
    """The embedding of halved atoms at `(g, h)` and `(g, -h)`: then `v = (A, 0)`, and `objective` is `A B`.

    So with halved atoms the relaxed optimum is attained, in two dimensions.
    """
    h = np.sqrt(1 - g * g)
    return np.stack([np.repeat(g, 2, axis=-1), np.stack([h, -h], axis=-1).reshape(*g.shape[:-1], -1)], axis=-1)


def attained(p: Weights, q: Weights, *, restarts: int = 4, sweeps: int = 1000, seed: int = 0) -> tuple[Values, Embedding]:
    """The true `D_cont`, and an embedding that has it; `certificate` says how close to the optimum it is.

    In the Gram matrix `G` of the embedding the objective is linear, `sum_ij p_i d_j G_ij`: a semidefinite programme with unit
    diagonal. Three dimensions hold an optimum, since vectors of given lengths that can sum to 0 at all can do so in a plane.
    In four, each vector in turn moves to where the others want it, from random starts, until nothing improves.
    """
    d = _difference(p, q)[..., None, :, None]  # an axis for the restarts, one for the coordinates
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
    return np.asarray(np.maximum(value.max(axis=-1), 0)), phi  # a constant embedding has 0


def certificate(p: Weights, q: Weights, phi: Embedding) -> Values:
    """A number that `D_cont` cannot exceed, by weak duality; near an optimal `phi` it is near the optimum.

    With `C` the symmetric part of `p d^T`, any `y`, and `e` the largest eigenvalue of `C - diag y`, or 0 if that is negative,
    `<C, G> = sum y + <C - diag y, G> <= sum y + n e`, because `G` is semidefinite with trace `n`. An optimum has
    `y_i = sum_j C_ij G_ij`.
    """
    product = p[..., :, None] * _difference(p, q)[..., None, :]
    c = (product + np.swapaxes(product, -1, -2)) / 2
    y = (phi * (c @ phi)).sum(axis=-1)
    largest = np.linalg.eigvalsh(c - np.eye(p.shape[-1]) * y[..., None])[..., -1]
    return np.asarray(y.sum(axis=-1) + p.shape[-1] * np.maximum(largest, 0))


def sharper_bound(mass: Values) -> Values:
    """The best lower bound of `D_cont / TV` that knows only `P`, where no atom is in the way; 0.25 at 0 and 2 at 1.

    It is `A B / TV` of the best `g` that is 1 on `S` and constant off it, and exact wherever `p / q` takes two values only.
    """
    return np.where(mass <= 0.75, 0.25 / (1 - np.minimum(mass, 0.75)), 2 * (2 * mass - 1))


def bound_with_atoms(mass: Values) -> Values:
    """What `D_cont / TV` is at least for every pair, from one vector on `S` and its opposite off it; two atoms have no more."""
    return np.asarray(np.maximum(2 * (2 * mass - 1), 0))


class Pairs(NamedTuple):
    """Random pairs of distributions on equally many atoms; `relaxed`, `true` and `gap` are multiples of `TV`."""

    atoms: int
    mass: Float[np.ndarray, " draws"]
    """`expert_mass`."""
    relaxed: Float[np.ndarray, " draws"]
    """`D_cont` with atoms halved, by `halves_embedding`."""
    true: Float[np.ndarray, " draws"]
    """`D_cont` with atoms as they are."""
    gap: Float[np.ndarray, " draws"]
    """How much more either of the two might be, by the relaxed optimum and by `certificate`."""


def random_pairs(atoms: int, draws: int = 300, seed: int = 0) -> Pairs:
    """Both distributions from Dirichlet(1/2, ..., 1/2), so that rare atoms and heavy ones come together."""
    p, q = np.random.default_rng([seed, atoms]).dirichlet(np.full(atoms, 0.5), (2, draws))
    tv, (most, g), (true, phi) = total_variation(p, q), relaxed(p, q), attained(p, q, seed=seed)
    built = objective(halves_embedding(g), halved(p), halved(q))
    gap = np.maximum(certificate(p, q, phi) - true, most - built)
    return Pairs(atoms, expert_mass(p, q), built / tv, true / tv, gap / tv)


def measure(pairs: Sequence[Pairs]) -> dict[str, Any]:
    """What `pcil theory --json` prints."""
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
    """The figures for a person."""
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
    """`p - q`, once it is sure that both are distributions."""
    for name, weights in (("p", p), ("q", q)):
        if not (np.all(weights >= 0) and np.allclose(weights.sum(axis=-1), 1, rtol=0, atol=1e-9)):
            raise InputError(f"{name} is {weights}; probabilities are at least 0 and sum to 1.")
    return p - q
