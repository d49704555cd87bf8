"""Agents: what learns to act, given windows of experience and a reward."""

from pcil.agents.base import Agent
from pcil.agents.bc import BC
from pcil.agents.drqv2 import DrQV2

__all__ = ["BC", "Agent", "DrQV2"]
