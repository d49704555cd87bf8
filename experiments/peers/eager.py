"""PCIL as its authors ran it, one operation after another in PyTorch: a competitor of the race (`experiments/race.py`).

The algorithm is written from the facts that `docs/methods/pcil.md` and `docs/methods/drqv2.md` list, with the sizes of the
paper's table, temperature 1, and labels that are stored when an episode ends. `python eager.py --updates N` measures an update.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
import sys
import time
from collections.abc import Iterable

import numpy as np
import torch
from contest import Contest, Finished, requested
from torch import Tensor, nn
from torch.nn import functional

from pcil.envs.dmc import DMCEnv

BATCH, FEATURES, HIDDEN, RATE, GAMMA, TAU, REPEAT = 128, 50, 256, 1e-4, 0.99, 0.01, 2
SEED_STEPS, RANDOM_STEPS, NOISE_STEPS, NOISE_CLIP, PENALTY = 1000, 2000, 500_000, 0.3, 10.0


def layers(*sizes: int) -> nn.Sequential:
    """Linear layers with ReLU between them, orthogonal at the start."""
    parts: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        linear = nn.Linear(before, after)
        nn.init.orthogonal_(linear.weight)
        nn.init.zeros_(linear.bias)
        parts += [linear, nn.ReLU()]
    return nn.Sequential(*parts[:-1])


def trunk(obs: int) -> nn.Sequential:
    """What actor and critic see of an observation."""
    return nn.Sequential(layers(obs, FEATURES), nn.LayerNorm(FEATURES), nn.Tanh())


class Actor(nn.Module):
    """The mean action."""

    def __init__(self, obs: int, action: int) -> None:
        super().__init__()
        self.trunk, self.head = trunk(obs), layers(FEATURES, HIDDEN, HIDDEN, action)

    def forward(self, obs: Tensor) -> Tensor:
        return torch.tanh(self.head(self.trunk(obs)))


class Critic(nn.Module):
    """Two heads on one trunk."""

    def __init__(self, obs: int, action: int) -> None:
        super().__init__()
        self.trunk = trunk(obs)
        self.heads = nn.ModuleList(layers(FEATURES + action, HIDDEN, HIDDEN, 1) for _ in range(2))

    def forward(self, obs: Tensor, action: Tensor) -> list[Tensor]:
        both = torch.cat([self.trunk(obs), action], 1)
        return [head(both)[:, 0] for head in self.heads]


class Update:
    """Networks, optimisers and one update of encoder, critic, actor and slow critic."""

    def __init__(self, obs: int, action: int, n_step: int) -> None:
        self.actor, self.critic = Actor(obs, action), Critic(obs, action)
        self.slow = copy.deepcopy(self.critic)
        self.encoder = layers(FEATURES, HIDDEN, HIDDEN, HIDDEN, HIDDEN // 4)
        adam = lambda net: torch.optim.Adam(net.parameters(), lr=RATE)  # noqa: E731
        self.optimisers = {name: adam(getattr(self, name)) for name in ("encoder", "critic", "actor")}
        self.discount = GAMMA**n_step

    def embed(self, features: Tensor) -> Tensor:
        """The embedding on the unit sphere."""
        return functional.normalize(self.encoder(features), dim=1)

    def label(self, obs: Tensor, expert: Tensor) -> Tensor:
        """The reward of states: similarity to one expert state each."""
        with torch.no_grad():
            return torch.sum(self.embed(self.critic.trunk(obs)) * self.embed(self.critic.trunk(expert)), 1)

    def __call__(self, batch: Iterable[Tensor], expert: Tensor, partner: Tensor, noise: float) -> None:
        obs, action, reward, last = batch
        with torch.no_grad():
            expert, agent, partner = (self.critic.trunk(rows) for rows in (expert, obs, partner))
        self._step("encoder", self.contrast(expert, agent, partner))
        with torch.no_grad():
            value = torch.minimum(*self.slow(last, self.noisy(last, noise)))
        target = reward + self.discount * value
        first, second = self.critic(obs, action)
        self._step("critic", functional.mse_loss(first, target) + functional.mse_loss(second, target))
        self._step("actor", -torch.mean(torch.minimum(*self.critic(obs, self.noisy(obs, noise)))))
        with torch.no_grad():
            for slow, fast in zip(self.slow.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, TAU)

    def contrast(self, expert: Tensor, agent: Tensor, partner: Tensor) -> Tensor:
        """InfoNCE with expert anchors, and the penalty on the slope of the reward."""
        anchor, negative = self.embed(expert), self.embed(agent)
        positive = anchor[torch.randperm(len(anchor))]
        logits = torch.cat([torch.sum(anchor * positive, 1, keepdim=True), anchor @ negative.T], 1)
        loss = functional.cross_entropy(logits, torch.zeros(len(anchor), dtype=torch.long))
        u = torch.rand(len(expert), 1)
        mixed = (u * expert + (1 - u) * agent).requires_grad_()
        scalar = torch.sum(self.embed(mixed) * self.embed(partner).detach())
        (slope,) = torch.autograd.grad(scalar, mixed, create_graph=True)
        return loss + PENALTY * torch.mean((slope.norm(dim=1) - 1) ** 2)

    def noisy(self, obs: Tensor, noise: float) -> Tensor:
        """The actor's action with clipped noise; the gradient passes the bound."""
        mean = self.actor(obs)
        action = mean + torch.clamp(noise * torch.randn_like(mean), -NOISE_CLIP, NOISE_CLIP)
        return action + (torch.clamp(action, -1, 1) - action).detach()

    def _step(self, name: str, loss: Tensor) -> None:
        self.optimisers[name].zero_grad(set_to_none=True)
        loss.backward()
        self.optimisers[name].step()


def main(words: list[str]) -> None:
    """Train until the time is over, or measure an update."""
    torch.set_num_threads(1)
    if words:
        return measure(int(words[1]))
    contest = Contest(requested())
    torch.manual_seed(contest.seed)
    with contextlib.suppress(Finished):
        train(contest)
    return None


def train(contest: Contest) -> None:
    """Act, store labelled episodes, and update at every second step."""
    rng, env = np.random.default_rng(contest.seed), DMCEnv(contest.task)
    obs_dim, action_dim = env.observation_space.shape[0], env.action_space.shape[0]
    n = 1 if contest.task.startswith("walker") else 3
    update, replay = Update(obs_dim, action_dim, n), Replay(obs_dim, action_dim, n)
    expert = torch.as_tensor(np.concatenate([obs[1:] for obs, _ in contest.demos]))
    draw = lambda size: expert[torch.as_tensor(rng.integers(len(expert), size=size))]  # noqa: E731
    act = lambda obs: update.actor(torch.as_tensor(obs)[None])[0].detach().numpy()  # noqa: E731
    step = 0
    while True:
        obs, _ = env.reset(seed=int(rng.integers(2**31)))
        seen, actions, over = [obs], [], False
        while not over:
            noise = 1.0 + min(step / NOISE_STEPS, 1) * (0.1 - 1.0)
            if step < RANDOM_STEPS:
                action = rng.uniform(-1, 1, action_dim)
            else:
                action = np.clip(act(obs) + noise * rng.normal(size=action_dim), -1, 1)
            obs, _, terminated, truncated, _ = env.step(action.astype(np.float32))
            seen.append(obs)
            actions.append(action)
            over, step = terminated or truncated, step + 1
            if step >= SEED_STEPS and step % 2 == 0:
                update(replay.sample(rng), draw(BATCH), draw(BATCH), noise)
            if step % 50 == 0:
                contest.show(act, REPEAT * step)
        states = torch.as_tensor(np.stack(seen))
        replay.add(
            states, torch.as_tensor(np.stack(actions), dtype=torch.float32), update.label(states[1:], draw(len(actions)))
        )


class Replay:
    """Whole episodes of one length, labelled when they are added."""

    def __init__(self, obs_dim: int, action_dim: int, n: int, length: int = 500, episodes: int = 1000) -> None:
        self._obs = torch.zeros(episodes, length + 1, obs_dim)
        self._action, self._label = torch.zeros(episodes, length, action_dim), torch.zeros(episodes, length)
        self._n, self._length, self._added = n, length, 0
        self._powers = GAMMA ** torch.arange(n)

    def add(self, obs: Tensor, action: Tensor, label: Tensor) -> None:
        """The newest episode; the oldest one makes room."""
        row = self._added % len(self._obs)
        self._obs[row], self._action[row], self._label[row] = obs, action, label
        self._added += 1

    def sample(self, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Windows of n steps: the first state and action, the discounted sum of the labels, and the last state."""
        episode = torch.as_tensor(rng.integers(min(self._added, len(self._obs)), size=BATCH))
        start = torch.as_tensor(rng.integers(self._length - self._n + 1, size=BATCH))
        labels = self._label[episode[:, None], start[:, None] + torch.arange(self._n)]
        return (
            self._obs[episode, start],
            self._action[episode, start],
            labels @ self._powers,
            self._obs[episode, start + self._n],
        )


def measure(updates: int) -> None:
    """The median time of an update on random data of walker_walk's sizes, in milliseconds of processor time."""
    torch.manual_seed(0)
    update, times = Update(24, 6, 1), []
    rows = lambda size: torch.randn(BATCH, size)  # noqa: E731
    for _ in range(updates):
        batch, expert, partner = (rows(24), rows(6).clamp(-1, 1), torch.randn(BATCH), rows(24)), rows(24), rows(24)
        begin = time.process_time()
        update(batch, expert, partner, 0.1)
        times.append(time.process_time() - begin)
    print(json.dumps({"update_ms": 1000 * float(np.median(times[updates // 5 :]))}))


if __name__ == "__main__":
    main(sys.argv[1:])
