"""Settings by name. Every number has its source on its line.

"paper Table" is the paper's table of hyperparameters (Appendix B), "authors" the authors' release, "ours" our measurements
(`docs/log.md`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from pcil.agents import BC, DrQV2
from pcil.errors import InputError, brief
from pcil.nets.noise import LinearSchedule
from pcil.rewards import DAC, PCIL, POTIL, PWIL, SIL, TCN, TaskReward
from pcil.training.config import Run, changed


def paper(task: str) -> dict[str, Any]:
    """What the paper's text says; where it is silent, what the authors' code does.

    One sentence of the text is not followed: Appendix B gives the encoder "state s of a transition". Here, as in the authors'
    code, a step is paid for the state that it leads to (docs/methods/pcil.md, point 14).
    """
    return {
        "frames": 2_000_000,  # paper section 4.1
        "label": "stored",  # authors' train.py: rewards are computed when the episode ends
        "seed_frames": 2000,  # authors' cfgs/config.yaml
        "random_frames": 4000,  # authors' cfgs/config.yaml: 2000 agent steps (12000 for PCIL and DAC); the same for all here
        "update_every": 2,  # paper Table: agent update frequency
        "replay_steps": 500_000,  # paper Table
        "evaluate_every": 20_000,  # paper Figure 3
        "evaluate_episodes": 10,  # paper Figure 3
        "agent": DrQV2(
            batch_size=128,  # paper Table: RL batch size
            n_step=1 if task.startswith("walker") else 3,  # DrQ-v2 cfgs/task
            gamma=0.99,  # authors' cfgs/config.yaml
            learning_rate=1e-4,  # paper Table
            tau=0.01,  # paper Table
            feature_dim=50,  # DrQ-v2 cfgs/config.yaml
            hidden=256,  # paper Table
            noise=LinearSchedule(1.0, 0.1, 500_000),  # authors' cfgs/suite/dmc_task/medium.yaml
        ),
    }


def released(task: str) -> dict[str, Any]:
    """What the authors' code does, whatever the paper says."""
    settings = paper(task)
    return {
        **settings,
        "frames": 2_100_000,  # authors' cfgs/suite/dmc.yaml
        "random_frames": 24_000,  # authors' cfgs/suite/dmc.yaml: 12000 agent steps for PCIL and DAC
        "reward.batch_size": 256 if task.startswith("walker") else 128,  # authors' batch_size // bz_ratio
        "agent": dataclasses.replace(
            settings["agent"],
            batch_size=512 if task.startswith("walker") else 256,  # authors' cfgs/config.yaml, DrQ-v2 cfgs/task
            hidden=1024,  # authors' cfgs/suite/dmc.yaml
        ),
    }


def default(task: str) -> dict[str, Any]:
    """What our measurements favour."""
    del task
    return {
        "frames": 500_000,  # ours
        "label": "sampled",  # ours: stored rewards are stale
        "seed_frames": 2000,  # authors' cfgs/config.yaml
        "random_frames": 2000,  # ours
        "update_every": 2,  # paper Table
        "replay_steps": 500_000,  # paper Table
        "evaluate_every": 20_000,  # paper Figure 3
        "evaluate_episodes": 10,  # paper Figure 3
        "agent": DrQV2(
            batch_size=128,  # paper Table
            n_step=1,  # ours
            learning_rate=5e-4,  # ours
            standardise=True,  # ours: experts learn several times faster
            noise=LinearSchedule(1.0, 0.1, 30_000),  # ours
        ),
    }


PRESETS: dict[str, Callable[[str], dict[str, Any]]] = {"default": default, "paper": paper, "released": released}

BC_SETTINGS: dict[str, Any] = {
    "frames": 100_000,  # authors' train_bc.py: 50k updates, each counted as an agent step
    "seed_frames": 0,  # nothing is played
    "random_frames": 0,  # nothing is played
    "update_every": 1,  # authors' train_bc.py
    "reward": TaskReward(task_weight=0.0),  # none is used
}

PWIL_AS_RELEASED: dict[str, Any] = {
    "random_frames": 4000,  # authors' cfgs: 2000 agent steps
    "agent.noise": LinearSchedule(0.1, 0.1, 1),  # authors' cfgs: a constant 0.1
    "reward": PWIL(
        batch_size=0,  # nothing is learned
        inputs="trunk",  # authors' agent/pwil.py
        alpha=5.0,  # authors' agent/pwil.py
        beta=5.0,  # authors' agent/pwil.py
        subsampling=1,  # authors' agent/pwil.py
        refresh=5000,  # authors' train.py: 10000 agent steps
        prefill_steps=0,  # authors' train.py
    ),
    "reward.batch_size": 0,  # nothing is learned
}

SIL_AS_RELEASED: dict[str, Any] = {
    "random_frames": 0,  # authors' cfgs
    "agent.noise": LinearSchedule(0.1, 0.1, 1),  # authors' cfgs: a constant 0.1
}

EASY = ("finger_spin", "hopper_stand", "pendulum_swingup", "walker_stand", "walker_walk")  # DrQ-v2 cfgs/task


def bc_as_released(task: str) -> dict[str, Any]:
    """BC with the batch of the task."""
    batch = 256 if task.startswith("walker") else 128  # authors' agent/bc.py: batch_size // bz_ratio
    return {**BC_SETTINGS, "agent": BC(batch_size=batch, hidden=1024)}  # authors' agent/bc.py, dmc.yaml


def expert_as_released(task: str) -> dict[str, Any]:
    """DrQ-v2 on the task's reward, with the frames and the exploration of its group of tasks."""
    return {
        "frames": 1_100_000 if task in EASY else 3_100_000,  # DrQ-v2 cfgs/task/easy.yaml, medium.yaml
        "random_frames": 4000,  # DrQ-v2 cfgs/config.yaml: 2000 agent steps
        "agent.noise": LinearSchedule(
            1.0, 0.1, 100_000 if task in EASY else 500_000
        ),  # DrQ-v2 cfgs/task/easy.yaml, medium.yaml
        "reward": TaskReward(),
    }


METHOD_SETTINGS: dict[tuple[str, str], dict[str, Any] | Callable[[str], dict[str, Any]]] = {
    ("pcil", "paper"): {"reward": PCIL(temperature=0.07)},  # paper Table
    ("pcil", "released"): {"reward": PCIL(temperature=1.0, hidden=1024)},  # authors' pcil.py: T is never applied; dmc.yaml
    ("pcil", "default"): {"reward": PCIL(temperature=1.0, learning_rate=5e-4)},  # ours: 0.07 does not learn
    ("dac", "paper"): {"reward": DAC()},  # authors' agent/dac.py
    ("dac", "released"): {"reward": DAC(hidden=1024)},  # authors' agent/dac.py, dmc.yaml
    ("dac", "default"): {"reward": DAC(learning_rate=5e-4)},  # ours
    ("pwil", "paper"): {"reward": PWIL()},  # Dadashi et al. 2021, on all states
    ("pwil", "released"): PWIL_AS_RELEASED,
    ("pwil", "default"): {"reward": PWIL(), "label": "stored"},  # as paper
    ("sil", "paper"): {"reward": SIL(learning_rate=1e-4)},  # paper Table; otherwise Papagiannis and Li 2020: no text for SIL
    ("sil", "released"): {"reward": SIL(), **SIL_AS_RELEASED},  # Papagiannis and Li 2020: the release has POTIL alone
    ("sil", "default"): {"reward": SIL(every=1000), "label": "stored"},  # ours: a faster critic leaves nothing to learn
    ("potil", "paper"): {"reward": POTIL()},  # authors' agent/potil.py: no text for it
    ("potil", "released"): {"reward": POTIL(), **SIL_AS_RELEASED, "reward.batch_size": 0},  # authors' agent/potil.py
    ("potil", "default"): {"reward": POTIL(), "label": "stored"},  # as paper
    ("tcn", "paper"): {"reward": TCN(temperature=0.07)},  # paper Appendix C
    ("tcn", "released"): {"reward": TCN(temperature=0.07, hidden=1024)},  # not in the release: Appendix C; size of dmc.yaml
    ("tcn", "default"): {"reward": TCN(temperature=0.07, learning_rate=5e-4)},  # Appendix C; rate: ours
    ("pcil-gail", "paper"): {"reward": PCIL(temperature=0.07, head="gail")},  # paper Appendix C
    ("pcil-gail", "released"): {"reward": PCIL(temperature=1.0, hidden=1024, head="gail")},  # head not in the release; as pcil
    ("pcil-gail", "default"): {"reward": PCIL(temperature=1.0, learning_rate=5e-4, head="gail")},  # as pcil
    ("tcn-gail", "paper"): {"reward": TCN(temperature=0.07, head="gail")},  # paper Appendix C
    ("tcn-gail", "released"): {"reward": TCN(temperature=0.07, hidden=1024, head="gail")},  # not in the release; as tcn
    ("tcn-gail", "default"): {"reward": TCN(temperature=0.07, learning_rate=5e-4, head="gail")},  # as tcn
    ("bc", "paper"): {**BC_SETTINGS, "agent": BC()},  # authors' agent/bc.py; width of the paper's Table
    ("bc", "released"): bc_as_released,
    ("bc", "default"): {**BC_SETTINGS, "agent": BC(standardise=True)},  # as paper; scaled observations: ours
    ("expert", "paper"): {"reward": TaskReward()},
    ("expert", "released"): expert_as_released,
    ("expert", "default"): {"reward": TaskReward()},
}
"""What a method sets on top of a preset, some by the task; a dotted name changes one setting of the agent or of the reward."""
METHODS = tuple(dict.fromkeys(method for method, _ in METHOD_SETTINGS))


def make(task: str, method: Any = "pcil", preset: Any = "default", **changes: Any) -> Run:
    """The run of a method with a preset, and any of its settings changed: `seed=2`, `**{"agent.gamma": 0.98}`.

    Unknown names raise `InputError`.
    """
    _known("method", method, METHODS)
    _known("preset", preset, PRESETS)
    own = METHOD_SETTINGS[method, preset]
    settings: dict[str, Any] = {**PRESETS[preset](task), **(own(task) if callable(own) else own)}
    nested = {name: settings.pop(name) for name in list(settings) if "." in name}
    run = Run(task=task, method=method, preset=preset, **settings)
    if not run.reward.needs_demos:
        nested.pop("reward.batch_size", None)
    nested = {name: value for name, value in nested.items() if name.partition(".")[0] not in changes}
    return changed(run, nested | changes)


def _known(kind: str, name: Any, names: Any) -> None:
    if not isinstance(name, str) or name not in names:
        raise InputError(f"There is no {kind} {brief(name)}; the {kind}s are {', '.join(names)}.")
