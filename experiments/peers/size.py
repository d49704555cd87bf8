"""Megabytes on disk of packages with all that they require: python experiments/peers/size.py NAME ..."""

import sys
from importlib import metadata

from packaging.requirements import Requirement


def closure(names: list[str]) -> dict[str, metadata.Distribution]:
    """The packages and what they require in this environment, without extras."""
    found: dict[str, metadata.Distribution] = {}
    while names:
        name = names.pop().lower().replace("_", "-")
        if name in found:
            continue
        try:
            found[name] = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        for text in found[name].requires or ():
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                names.append(requirement.name)
    return found


def megabytes(names: list[str]) -> float:
    """The sizes of the files that these packages installed."""
    paths = {path.locate() for package in closure(names).values() for path in package.files or ()}
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


if __name__ == "__main__":
    print(round(megabytes(sys.argv[1:])))
