"""The networks. Each is written once for two backends: `xp=jnp` in compiled code, `xp=np` for acting on the host.

Weights are `[in, out]`. Every linear layer starts orthogonal with gain 1 and bias 0 (authors' code: utils.py, `weight_init`).
"""

from __future__ import annotations

import dataclasses
import itertools
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.errors import InputError

LAYER_NORM_EPSILON = 1e-5
SCALER_RATE = 1e-3
"""The smallest weight of a new batch in the running statistics of observations."""
SCALER_FLOOR = 1e-6
"""The smallest standard deviation of an entry relative to its mean; the float32 mean is not more accurate than this."""
LEAST_DEVIATION = 1e-20
"""The smallest standard deviation of an entry that is always 0; dividing by it does not overflow."""
SCALED_BOUND = 10.0
"""Scaled observations are clipped to this many standard deviations."""


def orthogonal(key: PRNGKeyArray, shape: tuple[int, int]) -> Float[Any, "in out"]:
    """A random matrix with orthonormal rows or columns, whichever are fewer."""
    return jax.nn.initializers.orthogonal()(key, shape, jnp.float32)


def _rows(vector: Float[Any, " dim"], x: Float[Any, "*batch dim"]) -> Float[Any, "*ones dim"]:
    """`vector` with leading axes of size 1, so that it has the rank of `x` and no rank is promoted implicitly."""
    return vector.reshape((1,) * (x.ndim - 1) + vector.shape)


def _add(x: Float[Any, "*batch dim"], bias: Float[Any, " dim"]) -> Float[Any, "*batch dim"]:
    return x + _rows(bias, x)


class MLP(eqx.Module):
    """Linear layers with ReLU between them; the last layer is linear."""

    weights: tuple[Float[Any, "_ _"], ...]
    biases: tuple[Float[Any, " _"], ...]

    @classmethod
    def init(cls, sizes: tuple[int, ...], *, key: PRNGKeyArray) -> MLP:
        """`sizes` are the widths of input, hidden layers and output."""
        keys = jax.random.split(key, len(sizes) - 1)
        shapes = list(itertools.pairwise(sizes))
        weights = tuple(orthogonal(k, shape) for k, shape in zip(keys, shapes, strict=True))
        return cls(weights, tuple(jnp.zeros(out) for _, out in shapes))

    def __call__(self, x: Float[Any, "*batch in"], xp: ModuleType = jnp) -> Float[Any, "*batch out"]:
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = xp.maximum(_add(x @ weight, bias), 0)
        return _add(x @ self.weights[-1], self.biases[-1])


class Normalizer(eqx.Module):
    """Standardises observations to mean 0 and standard deviation 1, and clips them to `[-SCALED_BOUND, SCALED_BOUND]`."""

    mean: Float[Any, " obs"]
    deviation: Float[Any, " obs"]

    def __call__(self, obs: Float[Any, "*batch obs"], xp: ModuleType = jnp) -> Float[Any, "*batch obs"]:
        scaled = (obs - _rows(self.mean, obs)) / _rows(self.deviation, obs)
        return xp.minimum(xp.maximum(scaled, -SCALED_BOUND), SCALED_BOUND)


class Trunk(eqx.Module):
    """Linear layer, layer normalisation and tanh: maps observations to features in (-1, 1) (authors' code: agent/drqv2.py)."""

    weight: Float[Any, "obs features"]
    bias: Float[Any, " features"]
    scale: Float[Any, " features"]
    offset: Float[Any, " features"]
    normalizer: Normalizer | None = None
    """Normalises observations first if the trunk is given them in the environment's units."""

    @classmethod
    def init(cls, obs_dim: int, feature_dim: int, *, key: PRNGKeyArray) -> Trunk:
        return cls(
            orthogonal(key, (obs_dim, feature_dim)),
            jnp.zeros(feature_dim),
            jnp.ones(feature_dim),
            jnp.zeros(feature_dim),
        )

    def __call__(self, obs: Float[Any, "*batch obs"], xp: ModuleType = jnp) -> Float[Any, "*batch features"]:
        obs = obs if self.normalizer is None else self.normalizer(obs, xp)
        x = _add(obs @ self.weight, self.bias)
        share = 1 / x.shape[-1]  # np.mean takes longer than the rest of the layer
        centred = x - x.sum(axis=-1, keepdims=True) * share
        variance = (centred * centred).sum(axis=-1, keepdims=True) * share
        normal = centred / xp.sqrt(variance + LAYER_NORM_EPSILON)
        return xp.tanh(_add(normal * _rows(self.scale, normal), self.offset))

    def without_last(self) -> Trunk:
        """The equivalent trunk for observations without their last entry, assuming that this entry is always 0."""
        if self.normalizer is None:
            return dataclasses.replace(self, weight=self.weight[:-1])
        last = self.normalizer(jnp.zeros_like(self.normalizer.mean))[-1]
        shorter = Normalizer(self.normalizer.mean[:-1], self.normalizer.deviation[:-1])
        return dataclasses.replace(self, weight=self.weight[:-1], bias=self.bias + last * self.weight[-1], normalizer=shorter)


class Scaler(eqx.Module):
    """Running mean and variance of observations.

    Scaled observations do not depend on the units of an entry: they are the same for `x` and for `a x + b`.
    """

    mean: Float[Any, " obs"]
    variance: Float[Any, " obs"]
    count: Float[Any, ""]
    """The number of batches so far."""

    @classmethod
    def init(cls, obs_dim: int) -> Scaler:
        return cls(jnp.zeros(obs_dim), jnp.ones(obs_dim), jnp.zeros(()))

    def update(self, obs: Float[Array, "batch obs"]) -> Scaler:
        """Update with a batch: an average over all batches at first, then an exponential one over about `1 / SCALER_RATE`.

        Mixing a batch of mean `m` and variance `v` at rate `r` into `mean` and `variance` gives the mixture's variance,
        `(1 - r) variance + r v + r (1 - r) (m - mean)^2`. Moments are computed relative to the batch's first row, which avoids
        cancellation for values far from 0 and makes the mean of a constant entry exact.
        """
        rate = jnp.maximum(1 / (self.count + 1), SCALER_RATE)
        distance = obs - obs[:1]
        centre = jnp.mean(distance, axis=0)
        shift = (obs[0] - self.mean) + centre
        spread = jnp.mean((distance - centre[None]) ** 2, axis=0)
        variance = (1 - rate) * self.variance + rate * spread + ((1 - rate) * rate * shift) * shift
        return Scaler(self.mean + rate * shift, variance, self.count + 1)

    @property
    def normalizer(self) -> Normalizer:
        """The current normaliser. It maps an entry that was always constant to 0, or to the bound once it changes."""
        deviation = jnp.sqrt(self.variance + (SCALER_FLOOR * self.mean) ** 2)
        return Normalizer(self.mean, jnp.maximum(deviation, LEAST_DEVIATION))


def scaled(scaler: Scaler | None, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch obs"]:
    """Observations as the networks get them in an update."""
    return obs if scaler is None else scaler.normalizer(obs)


def unscaled(trunk: Trunk, scaler: Scaler | None) -> Trunk:
    """A trunk for observations in the environment's units, from a trunk for scaled observations."""
    return dataclasses.replace(trunk, normalizer=scaler and scaler.normalizer)


class Actor(eqx.Module):
    """The actor, whose output is the mean action: trunk, two hidden layers, tanh."""

    trunk: Trunk
    head: MLP

    @classmethod
    def init(cls, obs_dim: int, action_dim: int, feature_dim: int, hidden: int, *, key: PRNGKeyArray) -> Actor:
        trunk_key, head_key = jax.random.split(key)
        head = MLP.init((feature_dim, hidden, hidden, action_dim), key=head_key)
        return cls(Trunk.init(obs_dim, feature_dim, key=trunk_key), head)

    def __call__(self, obs: Float[Any, "*batch obs"], xp: ModuleType = jnp) -> Float[Any, "*batch action"]:
        return xp.tanh(self.head(self.trunk(obs, xp), xp))


def unpacked(actor: Actor, like: Actor, scaler: Scaler | None, *, absorbing: bool) -> tuple[Actor, Scaler | None]:
    """An actor of normalized observations and their statistics, from an actor of observations in the environment's units.

    The statistics are kept as if there had been so many batches that new ones change them slowly, since other statistics would
    make the actor another function. With `absorbing`, observations have one more entry, which the actor gives the weight 0.
    `InputError` if the actor's sizes are not those of `like`, or if it normalizes observations and there is no `scaler`.
    """
    normalizer, more = actor.trunk.normalizer, int(absorbing)
    weight = jnp.pad(jnp.asarray(actor.trunk.weight), ((0, more), (0, 0)))
    plain = Actor(dataclasses.replace(actor.trunk, weight=weight, normalizer=None), actor.head)
    sizes = [[leaf.shape for leaf in jax.tree.leaves(each)] for each in (plain, like)]
    if sizes[0] != sizes[1]:
        raise InputError(f"its arrays have shapes {sizes[0]}, and those of this run's actor have {sizes[1]}")
    if scaler is None and normalizer is not None:
        raise InputError("it normalizes observations; set agent.normalize_observations to True")
    if scaler is not None:
        obs_dim = scaler.mean.shape[0]
        mean, deviation = (normalizer.mean, normalizer.deviation) if normalizer else (jnp.zeros(obs_dim - more), 1.0)
        variance = jnp.broadcast_to(jnp.asarray(deviation) ** 2, obs_dim - more)
        rows = jnp.pad(jnp.asarray(mean), (0, more)), jnp.pad(variance, (0, more), constant_values=1.0)
        scaler = Scaler(*rows, jnp.float32(1 / SCALER_RATE))
    return jax.tree.map(jnp.array, plain), scaler


class Critic(eqx.Module):
    """Twin Q-functions with a common trunk; imitation rewards may use the trunk's features."""

    trunk: Trunk
    heads: tuple[MLP, MLP]

    @classmethod
    def init(cls, obs_dim: int, action_dim: int, feature_dim: int, hidden: int, *, key: PRNGKeyArray) -> Critic:
        trunk_key, *head_keys = jax.random.split(key, 3)
        sizes = (feature_dim + action_dim, hidden, hidden, 1)
        first, second = (MLP.init(sizes, key=k) for k in head_keys)
        return cls(Trunk.init(obs_dim, feature_dim, key=trunk_key), (first, second))

    def __call__(
        self, obs: Float[Any, "*batch obs"], action: Float[Any, "*batch action"]
    ) -> tuple[Float[Any, "*batch"], Float[Any, "*batch"]]:
        return self.values(self.trunk(obs), action)

    def values(
        self, features: Float[Any, "*batch features"], action: Float[Any, "*batch action"]
    ) -> tuple[Float[Any, "*batch"], Float[Any, "*batch"]]:
        """Both Q-values, from features of the trunk."""
        x = jnp.concatenate([features, action], axis=-1)
        first, second = (head(x)[..., 0] for head in self.heads)
        return first, second


def unit_sphere(x: Float[Any, "*batch dim"]) -> Float[Any, "*batch dim"]:
    """Each row scaled to length 1, with a finite gradient at 0."""
    return x / jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True) + 1e-12)
