"""Imitation in tasks that may end early, with and without absorbing states: one with a goal, and one with a fall.

Run python experiments/early_ends.py; interrupted runs resume, and finished ones are skipped.
InvertedPendulum-v5 needs `pip install '.[mujoco]'`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pcil
from pcil import demos
from pcil.envs.toy import Reach
from pcil.training.evaluate import environments_for, evaluate

FOLDER = Path("runs/early_ends")
METHODS, SEEDS, FRAMES, STARTS = ("pcil", "dac"), (1, 2, 3), 10_000, 50


def balance(obs: np.ndarray) -> np.ndarray:
    """A linear controller that keeps the pole of InvertedPendulum-v5 up for the whole 1000 steps."""
    return np.clip(obs @ np.array([0.1, 3.0, 0.2, 0.5]), -1, 1)[None].astype(np.float32)


EXPERTS = {"toy/reach-v0": lambda obs: Reach.optimal_action(obs).astype(np.float32), "InvertedPendulum-v5": balance}


def main() -> None:
    """Print a line for each task, method and setting: the mean length of an episode, in steps, for each seed."""
    for task, expert in EXPERTS.items():
        place = FOLDER / task.replace("/", "-")
        if not (dataset := place / "demos").exists():
            recorded = demos.record(expert, pcil.make_env(task), 10, task=task, seed=0, info={})
            recorded.save(dataset)
            print(f"{task}: demonstrations of {recorded.num_steps / 10:.1f} steps")
        for method in METHODS:
            for name, settings in (("default", {}), ("off", {"agent.absorbing": False})):
                lengths = []
                for seed in SEEDS:
                    out = place / method / name / str(seed)
                    run = pcil.train(task, method=method, seed=seed, frames=FRAMES, demos=str(dataset), out=out, **settings)
                    with environments_for(task, STARTS) as (_, copies):
                        lengths.append(evaluate(run.policy, copies, seed=0, episodes=STARTS).lengths.mean())
                print(f"{task} {method} absorbing {name}:", *(f"{length:.1f}" for length in lengths), flush=True)


if __name__ == "__main__":
    main()
