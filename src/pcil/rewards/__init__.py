"""Imitation rewards, one file each; `REWARDS` is the list that tests, the command line and the docs read."""

from pcil.rewards.adversarial import DAC
from pcil.rewards.base import Embed, Metrics, Reward, label, states_read
from pcil.rewards.pcil import PCIL
from pcil.rewards.pwil import PWIL
from pcil.rewards.sil import POTIL, SIL
from pcil.rewards.task import TaskReward

REWARDS: dict[str, type[Reward]] = {
    "pcil": PCIL,
    "dac": DAC,
    "pwil": PWIL,
    "sil": SIL,
    "potil": POTIL,
    "expert": TaskReward,
}
"""Reward of each method, by the method's name."""

__all__ = ["DAC", "PCIL", "POTIL", "PWIL", "REWARDS", "SIL", "Embed", "Metrics", "Reward", "TaskReward", "label", "states_read"]
