"""Imitation rewards, one file each; `REWARDS` is the registry that tests, the command line and the docs read."""

from pcil.rewards.adversarial import DAC
from pcil.rewards.base import Embed, Inputs, Metrics, Reward, label, select
from pcil.rewards.pcil import PCIL
from pcil.rewards.pwil import PWIL
from pcil.rewards.sil import POTIL, SIL
from pcil.rewards.task import TaskReward
from pcil.rewards.tcn import TCN

REWARDS: dict[str, type[Reward]] = {
    "pcil": PCIL,
    "dac": DAC,
    "pwil": PWIL,
    "sil": SIL,
    "potil": POTIL,
    "tcn": TCN,
    "expert": TaskReward,
}
"""The reward classes, by the name of their method; further methods are the same classes with other settings."""

__all__ = [
    "DAC",
    "PCIL",
    "POTIL",
    "PWIL",
    "REWARDS",
    "SIL",
    "TCN",
    "Embed",
    "Inputs",
    "Metrics",
    "Reward",
    "TaskReward",
    "label",
    "select",
]
