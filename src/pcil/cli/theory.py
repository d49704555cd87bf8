"""`pcil theory`."""

import json
import sys
from pathlib import Path

from pcil.cli import arguments
from pcil.cli.arguments import Json
from pcil.errors import shown


def theory(out: Path | None = None, seed: int = 0, json_output: Json = False) -> int:
    """Check the paper's Theorem 1 numerically, and draw it where --out names a folder.

    Args:
        out: The folder for theory.png and theory.pdf; without it there is no figure.
        seed: The seed of the random pairs.
        json_output: Print one JSON object and nothing else.
    """
    from pcil import theory

    arguments.within(0, 2**31 - 1, seed=seed)
    pairs = [theory.random_pairs(atoms, seed=seed) for atoms in theory.ATOMS]
    figures = theory.measure(pairs)
    drawn = ""
    if out is not None:
        try:
            from pcil.theory.figure import draw
        except ImportError:
            drawn = "No figure is drawn without matplotlib; pip install '.[report]' in a clone brings it."
        else:
            drawn = shown(f"Figure: {draw(pairs, out)}")
    print(json.dumps(figures) if json_output else theory.table(figures))
    if drawn:
        print(drawn, file=sys.stderr if json_output else sys.stdout)
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("theory", theory, argv)
