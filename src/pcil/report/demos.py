"""A picture of demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pcil.errors import InputError
from pcil.report import figures  # chooses the backend of matplotlib

KINDS = (".png", ".pdf", ".svg")
MOST_ENTRIES = 24
"""Only the first entries of observations and of actions are drawn."""


def draw(demos: Any, path: Path) -> Path:
    """Draw the return (or the length, where there are no rewards) of each episode, and below it every entry of observations and
    actions over the steps, one line for each episode; return the path.

    `demos` are `pcil.Demonstrations`. `InputError` if the name of the file ends in nothing of `KINDS`.
    """
    if path.suffix not in KINDS:
        raise InputError(f"The picture can't be written to {path}; give a name that ends in {', '.join(KINDS)}.")
    plt, episodes = figures.plt, demos.episodes
    columns = [("observation", [episode.obs for episode in episodes])]
    columns += [("action", [episode.action for episode in episodes])] if demos.has_actions else []
    entries = [(f"{name} {i}", i, rows) for name, rows in columns for i in range(min(rows[0].shape[1], MOST_ENTRIES))]
    wide = 4
    tall = -(-len(entries) // wide)
    figure = plt.figure(figsize=(3 * wide, 2.2 + 1.5 * tall), layout="constrained")
    grid = figure.add_gridspec(tall + 1, wide, height_ratios=[1.4] + [1] * tall)
    top = figure.add_subplot(grid[0, :])
    values = demos.returns if demos.has_rewards else np.array([len(episode) for episode in episodes])
    colours = [plt.get_cmap("viridis")(place) for place in np.linspace(0, 0.9, len(episodes))]
    top.bar(range(len(episodes)), values, color=colours)
    top.set(xlabel="episode", ylabel="return" if demos.has_rewards else "length")
    top.set_title(figures.escape_label(f"{demos.task}: {len(episodes)} episodes, {demos.num_steps:,} steps"), loc="left")
    for place, (title, i, rows) in enumerate(entries):
        axis = figure.add_subplot(grid[1 + place // wide, place % wide])
        for colour, episode in zip(colours, rows, strict=True):
            axis.plot(episode[:, i], color=colour, linewidth=0.6, alpha=0.8)
        axis.set_title(title, fontsize=8, loc="left")
        axis.tick_params(labelsize=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
