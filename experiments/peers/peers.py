"""The peers of the race (`experiments/race.py`), run with the versions of `requirements.txt`.

`imitation` has the settings that its authors published for seals/Walker2d (its folder `benchmarking/`); Stable-Baselines3 has
its defaults and is given the task's reward.
"""

from __future__ import annotations

import contextlib
import itertools
from typing import Any

import numpy as np
import torch
from contest import Contest, Finished, requested
from imitation.algorithms.adversarial.airl import AIRL
from imitation.algorithms.adversarial.gail import GAIL
from imitation.algorithms.bc import BC
from imitation.data.types import Trajectory
from imitation.policies.base import FeedForward32Policy, NormalizeFeaturesExtractor
from imitation.rewards.reward_nets import BasicRewardNet, BasicShapedRewardNet, NormalizedRewardNet
from imitation.util.networks import RunningNorm
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from pcil.envs.dmc import DMCEnv

REPEAT = 2
NORMALIZED = {
    "features_extractor_class": NormalizeFeaturesExtractor,
    "features_extractor_kwargs": {"normalize_class": RunningNorm},
}
PUBLISHED_PPO: dict[str, Any] = {
    "batch_size": 128,
    "clip_range": 0.4,
    "gae_lambda": 0.92,
    "gamma": 0.98,
    "max_grad_norm": 0.6,
    "n_epochs": 20,
    "vf_coef": 0.6167177795726859,
    "policy_kwargs": {"activation_fn": torch.nn.ReLU, "net_arch": {"pi": [64, 64], "vf": [64, 64]}, **NORMALIZED},
}
ADVERSARIAL: dict[str, tuple[Any, Any, dict[str, float]]] = {
    "imitation GAIL": (GAIL, BasicRewardNet, {"ent_coef": 0.0007566389899529574, "learning_rate": 1.943992487657563e-5}),
    "imitation AIRL": (AIRL, BasicShapedRewardNet, {"ent_coef": 0.002003867232707145, "learning_rate": 3.052170958603811e-5}),
}


def main() -> None:
    """Train the competitor that is requested until its time is over."""
    torch.set_num_threads(1)
    request = requested()
    contest, name = Contest(request), request["competitor"]
    torch.manual_seed(contest.seed)
    with contextlib.suppress(Finished):
        if name == "imitation BC":
            clone(contest)
        elif name in ADVERSARIAL:
            compete(contest, *ADVERSARIAL[name])
        else:
            agent = {"SB3 SAC": SAC, "SB3 TD3": TD3}[name]("MlpPolicy", DMCEnv(contest.task), seed=contest.seed, device="cpu")
            agent.learn(10**9, callback=Watch(contest))


class Watch(BaseCallback):
    """Shows an agent of Stable-Baselines3 to the contest at every 100th step."""

    def __init__(self, contest: Contest) -> None:
        super().__init__()
        self._contest = contest

    def _on_step(self) -> bool:
        if self.n_calls % 100 == 0:
            self._contest.show(lambda obs: self.model.predict(obs, deterministic=True)[0], REPEAT * self.num_timesteps)
        return True


def trajectories(contest: Contest) -> list[Trajectory]:
    """The demonstrations as `imitation` takes them; its episodes are of one length, so the time limit is a terminal state."""
    return [Trajectory(obs=obs, acts=action, infos=None, terminal=True) for obs, action in contest.demos]


def clone(contest: Contest) -> None:
    """Behavioural cloning."""
    env = DMCEnv(contest.task)
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    policy = FeedForward32Policy(**spaces, lr_schedule=lambda _: float(torch.finfo(torch.float32).max), **NORMALIZED)
    trainer = BC(
        **spaces,
        demonstrations=trajectories(contest),
        policy=policy,
        rng=np.random.default_rng(contest.seed),
        batch_size=32,
        l2_weight=0.0014680228143404998,
        optimizer_kwargs={"lr": 0.0003034620018780926},
        device="cpu",
    )
    for updates in itertools.count(500, 500):  # an update is counted as an agent step
        trainer.train(n_batches=500, log_interval=10**9, progress_bar=False)
        contest.show(lambda obs: trainer.policy.predict(obs, deterministic=True)[0], REPEAT * updates)


def compete(contest: Contest, trainer: Any, network: Any, settings: dict[str, float]) -> None:
    """An adversarial reward with PPO; a round has 16,384 steps of eight environments."""
    env = DummyVecEnv([lambda: DMCEnv(contest.task) for _ in range(8)])
    env.seed(contest.seed)
    agent = PPO("MlpPolicy", env, n_steps=16384 // 8, seed=contest.seed, device="cpu", **PUBLISHED_PPO, **settings)
    reward = network(env.observation_space, env.action_space, normalize_input_layer=RunningNorm)
    game = trainer(
        demonstrations=trajectories(contest),
        demo_batch_size=512,
        gen_replay_buffer_capacity=16384,
        n_disc_updates_per_round=16,
        venv=env,
        gen_algo=agent,
        reward_net=NormalizedRewardNet(reward, RunningNorm),
    )
    act = lambda obs: agent.predict(obs, deterministic=True)[0]  # noqa: E731
    game.train(10**9, callback=lambda _: contest.show(act, REPEAT * agent.num_timesteps))


if __name__ == "__main__":
    main()
