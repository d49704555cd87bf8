"""Settings by name. Every number has its source on its line.

"paper Table" is the paper's table of hyperparameters (Appendix B), "authors" the authors' release, "ours" our measurements
(`docs/log.md`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from pcil import modules
from pcil.errors import InputError, brief
from pcil.nets.noise import LinearSchedule
from pcil.training.config import REGISTRIES, Run, changed, part_of_run, renamed, taken


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
        "agent": "drqv2",  # paper section 4.1
        "agent.batch_size": 128,  # paper Table: RL batch size
        "agent.n_step": 1 if task.startswith("walker") else 3,  # DrQ-v2 cfgs/task
        "agent.gamma": 0.99,  # authors' cfgs/config.yaml
        "agent.learning_rate": 1e-4,  # paper Table
        "agent.tau": 0.01,  # paper Table
        "agent.feature_dim": 50,  # DrQ-v2 cfgs/config.yaml
        "agent.hidden": 256,  # paper Table
        "agent.noise": LinearSchedule(1.0, 0.1, 500_000),  # authors' cfgs/suite/dmc_task/medium.yaml
    }


def released(task: str) -> dict[str, Any]:
    """What the authors' code does, whatever the paper says."""
    return {
        **paper(task),
        "frames": 2_100_000,  # authors' cfgs/suite/dmc.yaml
        "random_frames": 24_000,  # authors' cfgs/suite/dmc.yaml: 12000 agent steps for PCIL and DAC
        "reward.batch_size": 256 if task.startswith("walker") else 128,  # authors' batch_size // bz_ratio
        "agent.batch_size": 512 if task.startswith("walker") else 256,  # authors' cfgs/config.yaml, DrQ-v2 cfgs/task
        "agent.hidden": 1024,  # authors' cfgs/suite/dmc.yaml
    }


def default(task: str) -> dict[str, Any]:
    """What our measurements favour, and what the paper says elsewhere."""
    return {
        **paper(task),
        "frames": 500_000,  # ours
        "keep_best": True,  # ours: falls at the moment of an evaluation
        "label": "sampled",  # ours: stored rewards are stale
        "random_frames": 2000,  # ours
        "agent.n_step": 1,  # ours
        "agent.learning_rate": 5e-4,  # ours
        "agent.normalize_observations": True,  # ours: experts learn several times faster
        "agent.noise": LinearSchedule(1.0, 0.1, 30_000),  # ours
        "agent.cloning": None,  # ours: far fewer frames where demonstrations have actions
        "agent.averaging_rate": 0.003,  # ours: the worst starts are better
    }


def reward_only(task: str) -> dict[str, Any]:
    """`default` with an agent that learns from its reward alone, to compare rewards: it neither clones nor is averaged, and the
    policy of the moment is evaluated."""
    return {**default(task), "keep_best": False, "agent.cloning": False, "agent.averaging_rate": 1.0}


PRESETS: dict[str, Callable[[str], dict[str, Any]]] = {
    "default": default,
    "reward-only": reward_only,
    "paper": paper,
    "released": released,
}

BC_SETTINGS: dict[str, Any] = {
    "frames": 100_000,  # authors' train_bc.py: 50k updates, each counted as an agent step
    "seed_frames": 0,  # nothing is played
    "random_frames": 0,  # nothing is played
    "update_every": 1,  # authors' train_bc.py
    "keep_best": False,  # nothing pays a policy
    "reward": "expert",  # none is used
    "reward.task_weight": 0.0,  # none is used
    "agent": "bc",
    "agent.batch_size": 128,  # paper Table
    "agent.n_step": 1,  # a single step is cloned
    "agent.learning_rate": 1e-4,  # authors' agent/bc.py
}

PWIL_AS_RELEASED: dict[str, Any] = {
    "random_frames": 4000,  # authors' cfgs: 2000 agent steps
    "agent.noise": LinearSchedule(0.1, 0.1, 1),  # authors' cfgs: a constant 0.1
    "reward.inputs": "trunk",  # authors' agent/pwil.py
    "reward.alpha": 5.0,  # authors' agent/pwil.py
    "reward.beta": 5.0,  # authors' agent/pwil.py
    "reward.subsampling": 1,  # authors' agent/pwil.py
    "reward.refresh": 5000,  # authors' train.py: 10000 agent steps
    "reward.prefill_steps": 0,  # authors' train.py
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
    return {"agent.batch_size": batch, "agent.hidden": 1024}  # authors' agent/bc.py, dmc.yaml


def expert_as_released(task: str) -> dict[str, Any]:
    """DrQ-v2 on the task's reward, with the frames and the exploration of its group of tasks."""
    frames, steps = (1_100_000, 100_000) if task in EASY else (3_100_000, 500_000)  # DrQ-v2 cfgs/task/easy.yaml, medium.yaml
    return {
        "frames": frames,
        "random_frames": 4000,  # DrQ-v2 cfgs/config.yaml: 2000 agent steps
        "agent.noise": LinearSchedule(1.0, 0.1, steps),
    }


Settings = dict[str, Any] | Callable[[str], dict[str, Any]]
"""Settings by dotted names, or a function that gives them for a task."""

PCIL_SETTINGS: dict[str, Settings] = {
    "every preset": {"reward": "pcil"},
    "paper": {"reward.temperature": 0.07},  # paper Table
    "released": {"reward.temperature": 1.0, "reward.hidden": 1024},  # authors' pcil.py: T is never applied; dmc.yaml
    "default": {"reward.temperature": 1.0, "reward.learning_rate": 5e-4},  # ours: 0.07 does not learn
}

TCN_SETTINGS: dict[str, Settings] = {
    "every preset": {"reward": "tcn", "reward.temperature": 0.07},  # paper Appendix C
    "released": {"reward.hidden": 1024},  # not in the release; size of dmc.yaml
    "default": {"reward.learning_rate": 5e-4},  # ours
}

METHOD_SETTINGS: dict[str, dict[str, Settings]] = {
    "pcil": PCIL_SETTINGS,
    "dac": {
        "every preset": {"reward": "dac"},  # authors' agent/dac.py
        "released": {"reward.hidden": 1024},  # authors' cfgs/suite/dmc.yaml
        "default": {"reward.learning_rate": 5e-4},  # ours
    },
    "pwil": {
        "every preset": {"reward": "pwil"},  # Dadashi et al. 2021, on all states
        "released": PWIL_AS_RELEASED,
        "default": {"label": "stored"},  # as paper
    },
    "sil": {
        "every preset": {"reward": "sil"},  # Papagiannis and Li 2020: no text for it, and the release has POTIL alone
        "paper": {"reward.learning_rate": 1e-4},  # paper Table
        "released": SIL_AS_RELEASED,
        "default": {"reward.every": 1000, "label": "stored"},  # ours: a faster critic leaves nothing to learn
    },
    "potil": {
        "every preset": {"reward": "potil"},  # authors' agent/potil.py: no text for it
        "released": {**SIL_AS_RELEASED, "reward.batch_size": 0},  # authors' agent/potil.py
        "default": {"label": "stored"},  # as paper
    },
    "tcn": TCN_SETTINGS,
    "pcil-gail": {
        **PCIL_SETTINGS,
        "every preset": {"reward": "pcil", "reward.head": "gail"},  # paper Appendix C; not in the release
    },
    "tcn-gail": {
        **TCN_SETTINGS,
        "every preset": {"reward": "tcn", "reward.temperature": 0.07, "reward.head": "gail"},  # paper Appendix C
    },
    "bc": {
        "every preset": BC_SETTINGS,  # authors' agent/bc.py; width of the paper's Table
        "released": bc_as_released,
    },
    "expert": {"every preset": {"reward": "expert"}, "released": expert_as_released},
}
"""What a method changes of every preset, and then of single ones, for some methods by task; dotted names are settings of the
agent or the reward."""
METHODS = tuple(METHOD_SETTINGS)


def make(task: str, method: Any = "pcil", preset: Any = "default", **changes: Any) -> Run:
    """The run of a method with a preset, and any of its settings changed: `seed=2`, `**{"agent.gamma": 0.98}`.

    `agent` and `reward` may be an instance, a name in the registry, or `my.module:MyAgent`; one that is not the method's own
    has the defaults of its class. Unknown names raise `InputError`.
    """
    _known("method", method, METHODS)
    _known("preset", preset, PRESETS)
    changes, settings = renamed(changes), PRESETS[preset](task)
    for name in ("every preset", "default" if preset == "reward-only" else preset):
        own = METHOD_SETTINGS[method].get(name, {})
        settings |= own(task) if callable(own) else own
    made: dict[str, Any] = {}
    for part in REGISTRIES:
        usual, own, asked = settings.pop(part), taken(settings, part), taken(changes, part)
        named = changes.pop(part, usual)
        made[part] = modules.instance(f"--{part}", part_of_run(part, named)) if isinstance(named, str) else named
        if named != usual:
            own = {}
        elif part == "agent":
            own = {name: value for name, value in own.items() if hasattr(made[part], name)}
        elif not made[part].needs_demos:
            own.pop("batch_size", None)
        made[part] = changed(made[part], own | asked)
    settings |= changes
    known = {field.name for field in dataclasses.fields(Run)}
    plain = {name: settings.pop(name) for name in list(settings) if name in known}
    return changed(Run(task=task, method=method, preset=preset, **made, **plain), settings)


def _known(kind: str, name: Any, names: Any) -> None:
    if not isinstance(name, str) or name not in names:
        raise InputError(f"There is no {kind} {brief(name)}; the {kind}s are {', '.join(names)}.")
