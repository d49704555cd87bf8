"""How often imitation reaches a goal that ends the episode, with and without the absorbing state.

python experiments/early_ends.py; each run resumes, and is skipped once it is done.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pcil
from pcil import demos
from pcil.envs.toy import Reach
from pcil.evaluate import environments_for, evaluate

TASK, FOLDER = "toy/reach-v0", Path("runs/early_ends")
METHODS, SEEDS, EPISODES = ("pcil", "dac"), (1, 2, 3), 100


def main() -> None:
    """One line a method and setting: the shares of 100 starts from which each seed reaches the goal."""
    dataset = FOLDER / "demos"
    if not dataset.exists():
        expert = lambda obs: Reach.optimal_action(obs).astype(np.float32)  # noqa: E731
        demos.record(expert, pcil.make_env(TASK), 10, task=TASK, seed=0, info={"expert": "the optimal policy"}).save(dataset)
    for method in METHODS:
        for absorbing in (None, False):
            settings = {} if absorbing is None else {"agent.absorbing": absorbing}
            shares = []
            for seed in SEEDS:
                out = FOLDER / method / ("default" if absorbing is None else "off") / str(seed)
                run = pcil.train(TASK, method=method, seed=seed, frames=30_000, demos=str(dataset), out=out, **settings)
                with environments_for(TASK, EPISODES) as copies:
                    result = evaluate(run.policy, copies, seed=0, episodes=EPISODES)
                shares.append(float(np.mean(result.lengths < Reach.NUM_STEPS)))
            print(f"{method:5} absorbing {'default' if absorbing is None else 'off':8}", *(f"{share:6.0%}" for share in shares))


if __name__ == "__main__":
    main()
