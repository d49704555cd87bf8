"""Agents: what learns to act, given windows of experience and a reward, one file each; `AGENTS` is the list."""

from pcil.agents.base import Actor, Agent
from pcil.agents.bc import BC
from pcil.agents.drqv2 import DrQV2

AGENTS: dict[str, type[Agent]] = {"drqv2": DrQV2, "bc": BC}
"""Every class of agent by its name in settings and files."""

__all__ = ["AGENTS", "BC", "Actor", "Agent", "DrQV2"]
