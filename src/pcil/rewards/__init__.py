"""Imitation rewards, one file each; `REWARDS` is the list that tests, the command line and the docs read."""

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
"""Every class of reward, by the name of the method that it is for; other methods are the same classes set otherwise."""

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
