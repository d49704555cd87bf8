"""The figure of Theorem 1: `D_cont / TV` of many pairs of distributions, and the bounds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.layout_engine import ConstrainedLayoutEngine

from pcil import theory
from pcil.errors import InputError
from pcil.report.figures import GREY, INK, plt

HOLDS, FAILS = "#0072b2", "#d55e00"
"""Blue dots and vermilion crosses, which readers with any colour vision can tell apart."""


def draw(pairs: Sequence[theory.Pairs], folder: Path) -> Path:
    """Write theory.png and theory.pdf to `folder`, and return the path of the PNG.

    The left panel shows every pair with split atoms, the right one the same pairs with their original atoms.
    """
    mass, cut, whole = (np.concatenate([getattr(size, name) for size in pairs]) for name in ("mass", "relaxed", "true"))
    p, q = theory.COUNTER_EXAMPLE
    tv, grid = theory.total_variation(p, q), np.linspace(0, 1, 401)
    sharper, simple = "sharper bound:\n$1/(4(1-P))$, and\n$2(2P-1)$ from $3/4$", "$\\max(2(2P-1),\\ 0)$"
    fails = "Atoms as they are: it can fail where $P<9/16$"
    panels = [
        ("Atoms cut into halves: Theorem 1 holds", cut, theory.relaxed(p, q)[0] / tv, theory.sharper_bound, sharper),
        (fails, whole, theory.attained(p, q)[0] / tv, theory.bound_with_atoms, simple),
    ]
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), layout=ConstrainedLayoutEngine(wspace=0.06), sharey=True)
    for axis, (title, ratio, marked, bound, name) in zip(axes, panels, strict=True):
        below = ratio < theory.LOWER
        axis.scatter(mass[~below], ratio[~below], s=9, color=HOLDS, alpha=0.4, linewidth=0, label="a pair of distributions")
        axis.scatter(mass[below], ratio[below], s=22, color=FAILS, marker="x", linewidth=1, label="a pair below 0.25")
        axis.hlines([theory.LOWER, theory.UPPER], 0, 1, GREY, "--", linewidth=1.2, label="Theorem 1: 0.25 and 2")
        axis.plot(grid, bound(grid), color=INK, linewidth=1.5, label="what holds for every pair with this $P$")
        axis.text(0.73, 0.5, name, va="center", fontsize=9)
        star = (float(theory.expert_mass(p, q)), float(marked))
        axis.plot(*star, "*", markersize=15, color=INK, markeredgecolor="white")
        text = f"$p=(1/4,\\ 3/4)$, $q=(0,\\ 1)$: {marked:.2f}"
        box, arrow = {"facecolor": "white", "edgecolor": "none", "pad": 2}, {"arrowstyle": "->", "shrinkB": 9, "color": INK}
        axis.annotate(text, star, (0.25, 1.3), ha="center", fontsize=9, bbox=box, arrowprops=arrow)
        axis.set(title=title, xlabel="$P$: the expert's mass where $p\\geq q$", xlim=(0, 1), ylim=(-0.1, 2.15))
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("$D_{cont}\\,/\\,TV$")
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(folder / "theory.png", dpi=150)
        figure.savefig(folder / "theory.pdf", metadata={"CreationDate": None})
    except OSError as error:
        raise InputError(f"No figure can be written to {folder} ({error}); --out names a folder for it.") from error
    finally:
        plt.close(figure)
    return folder / "theory.png"
