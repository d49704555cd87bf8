"""Write the dataset that tests/demos/test_importers.py reads by LeRobot's own writer: python lerobot_files.py FOLDER

Run it in an environment of its own: lerobot 0.4.4 writes version 3, lerobot 0.3.3 (with numpy below 2.3) version 2.1.
Of what it writes, tests/demos/lerobot/ has meta/info.json and data/, which are all that is read.
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["shoulder", "elbow", "wrist"]},
    "observation.environment_state": {"dtype": "float32", "shape": (1,), "names": ["ball"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["left", "right"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
STEPS = (5, 4)


def main(folder: str) -> None:
    """Two episodes whose numbers follow from the episode and the time."""
    dataset = LeRobotDataset.create(repo_id="pcil/arm", fps=20, root=Path(folder), features=FEATURES, use_videos=False)
    separate = "task" in inspect.signature(dataset.add_frame).parameters  # version 2.1
    for episode, steps in enumerate(STEPS):
        for t in range(steps):
            frame = {
                "observation.state": np.array([episode, t, t / 2], np.float32),
                "observation.environment_state": np.array([t], np.float32),
                "action": np.array([t / 10, -t / 10], np.float32),
                "next.reward": np.array([t], np.float32),
                "next.done": np.array([t == steps - 1]),
            }
            if separate:
                dataset.add_frame(frame, task="reach")
            else:
                dataset.add_frame({**frame, "task": "reach"})
        dataset.save_episode()
    if hasattr(dataset, "finalize"):
        dataset.finalize()


if __name__ == "__main__":
    main(sys.argv[1])
