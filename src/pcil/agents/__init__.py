"""Agents, one file each; `AGENTS` is the registry."""

from pcil.agents.base import Actor, Agent
from pcil.agents.bc import BC
from pcil.agents.drqv2 import DrQV2

AGENTS: dict[str, type[Agent]] = {"drqv2": DrQV2, "bc": BC}
"""The agent classes by their names in settings and files."""

__all__ = ["AGENTS", "BC", "Actor", "Agent", "DrQV2"]
