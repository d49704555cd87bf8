"""Imitation rewards, one file each; `REWARDS` is the list that tests, the command line and the docs read."""

from pcil.rewards.adversarial import DAC
from pcil.rewards.base import Embed, Metrics, Reward, label
from pcil.rewards.pcil import PCIL
from pcil.rewards.task import TaskReward

REWARDS: dict[str, type[Reward]] = {
    "pcil": PCIL,
    "dac": DAC,
    "expert": TaskReward,
}
"""Reward of each method, by the method's name."""

__all__ = ["DAC", "PCIL", "REWARDS", "Embed", "Metrics", "Reward", "TaskReward", "label"]
