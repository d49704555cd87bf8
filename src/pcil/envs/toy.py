"""Environments with known solutions: two toys with their optimal policies and five probes with their values.

The probes get more complex one by one, so that the first one on which an agent fails tells which part is broken: 1 the value
loss, 2 the observations that the critic is given, 3 discounting and bootstrapping, 4 the gradient of the policy, 5 the
observations that the policy is given.
"""

from __future__ import annotations

import abc
from typing import Any

import gymnasium
import numpy as np

from pcil.envs.dmc import checked_action


class PointMass(gymnasium.Env[np.ndarray, np.ndarray]):
    """A point in the square [-1, 1]^2 that moves by `SPEED` times the action and earns 1 - its distance to the origin.

    An episode starts at a uniformly random position and is truncated after `NUM_STEPS` steps.
    """

    SPEED = 0.1
    NUM_STEPS = 50
    ends_early = False

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._position, self._steps = np.zeros(2), 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Place the point uniformly in the square."""
        super().reset(seed=seed)
        self._position, self._steps = self.np_random.uniform(-1.0, 1.0, 2), 0
        return self._position.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move the point; the reward is that of the new position, in [1 - sqrt(2), 1]."""
        moved = self._position + self.SPEED * checked_action(action, (2,))
        self._position, self._steps = np.clip(moved, -1.0, 1.0), self._steps + 1
        reward = 1.0 - float(np.sqrt(np.sum(self._position**2)))
        return self._position.astype(np.float32), reward, False, self._steps >= self.NUM_STEPS, {}

    @classmethod
    def optimal_action(cls, obs: np.ndarray) -> np.ndarray:
        """Move towards the origin along each axis. The axes are independent, so every step minimises the distance."""
        return np.clip(-np.asarray(obs) / cls.SPEED, -1.0, 1.0)


class Reach(gymnasium.Env[np.ndarray, np.ndarray]):
    """A point on the line [-2, 2] that moves by `SPEED` times the action; an episode terminates when it reaches the goal.

    The observation is `[position, goal]`, the reward minus the distance. An episode is truncated after `NUM_STEPS` steps.
    """

    SPEED = 0.1
    NUM_STEPS = 40
    REACHED = 0.08

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-2.0, 2.0, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._state, self._steps = np.zeros(2), 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Place point and goal uniformly in [-1, 1]."""
        super().reset(seed=seed)
        self._state, self._steps = self.np_random.uniform(-1.0, 1.0, 2), 0
        return self._state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move the point; the episode terminates within `REACHED` of the goal."""
        self._state[0] = np.clip(self._state[0] + self.SPEED * checked_action(action, (1,))[0], -2.0, 2.0)
        self._steps += 1
        distance = float(abs(self._state[0] - self._state[1]))
        reached = distance < self.REACHED
        over = not reached and self._steps >= self.NUM_STEPS
        return self._state.astype(np.float32), -distance, reached, over, {"is_success": reached}

    @classmethod
    def optimal_action(cls, obs: np.ndarray) -> np.ndarray:
        """Move towards the goal."""
        return np.clip((obs[..., 1:] - obs[..., :1]) / cls.SPEED, -1.0, 1.0)


class Probe(gymnasium.Env[np.ndarray, np.ndarray], abc.ABC):
    """An environment with a scalar observation and a scalar action; by default it terminates after one step."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._obs = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start with the probe's first observation."""
        super().reset(seed=seed)
        self._obs = np.array([self._first_obs()], np.float32)
        return self._obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return the probe's reward for this action in this observation."""
        reward = self._pay(float(self._obs[0]), float(checked_action(action, (1,))[0]))
        next_obs = self._next_obs(float(self._obs[0]))
        self._obs = np.array([0.0 if next_obs is None else next_obs], np.float32)
        return self._obs, reward, next_obs is None, False, {}

    @abc.abstractmethod
    def value(self, obs: float, discount: float) -> float:
        """The discounted return of the optimal policy from `obs`."""

    def _first_obs(self) -> float:
        return 0.0

    def _next_obs(self, obs: float) -> float | None:
        """The observation after `obs`; None if the episode terminates."""
        del obs
        return None

    @abc.abstractmethod
    def _pay(self, obs: float, action: float) -> float:
        """The reward of an action in an observation."""

    def _random_sign(self) -> float:
        return float(self.np_random.choice([-1.0, 1.0]))


class ConstantReward(Probe):
    """Probe 1: reward 1, always. A value that is not 1 means that the value loss or its optimizer is broken."""

    def value(self, obs: float, discount: float) -> float:
        """1."""
        del obs, discount
        return 1.0

    def _pay(self, obs: float, action: float) -> float:
        del obs, action
        return 1.0


class ObservedReward(Probe):
    """Probe 2: the reward is the observation, +1 or -1. A value that differs means that the critic gets wrong observations."""

    def value(self, obs: float, discount: float) -> float:
        """The observation."""
        del discount
        return obs

    def _first_obs(self) -> float:
        return self._random_sign()

    def _pay(self, obs: float, action: float) -> float:
        del action
        return obs


class DelayedReward(Probe):
    """Probe 3: two steps, observations 0 and 1, and reward 1 in the second. The first value is the discount."""

    def value(self, obs: float, discount: float) -> float:
        """1 in the second step, the discount in the first."""
        return 1.0 if obs > 0.5 else discount

    def _next_obs(self, obs: float) -> float | None:
        return 1.0 if obs < 0.5 else None

    def _pay(self, obs: float, action: float) -> float:
        del action
        return 1.0 if obs > 0.5 else 0.0


class ActionReward(Probe):
    """Probe 4: the reward is -(action - 0.5)^2. A policy that does not go to 0.5 has a broken gradient."""

    def value(self, obs: float, discount: float) -> float:
        """0, with the best action."""
        del obs, discount
        return 0.0

    def optimal_action(self, obs: float) -> float:
        """0.5."""
        del obs
        return 0.5

    def _pay(self, obs: float, action: float) -> float:
        return -((action - self.optimal_action(obs)) ** 2)


class ObservedActionReward(ActionReward):
    """Probe 5: the reward is -(action - 0.5 * observation)^2 with observation +1 or -1: the policy must use its observation."""

    def optimal_action(self, obs: float) -> float:
        """Half of the observation."""
        return 0.5 * obs

    def _first_obs(self) -> float:
        return self._random_sign()
