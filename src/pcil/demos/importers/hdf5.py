"""HDF5 files as D4RL and robomimic write them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pcil.demos.hdf5 import Damage, read
from pcil.demos.importers.tables import Keys, Source, Table, chosen, split, unnamed
from pcil.errors import InputError

SIGNATURE = b"\x89HDF\r\n\x1a\n"


def is_hdf5(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(SIGNATURE)) == SIGNATURE


def read_hdf5(path: Path, keys: Keys) -> Source:
    """The episodes of a file with flat arrays (D4RL), or with a group for each episode (robomimic)."""
    try:
        ((_, parts),) = read(path, None)
    except Damage as error:
        raise InputError(f"{path} can't be read as HDF5: {error}.") from error
    found = {name: arrays[0] for name, arrays in parts.items() if arrays}
    dropped = [name for name, arrays in parts.items() if not arrays]
    episodes = sorted({match[1] for name in parts if (match := re.match(r"data/(demo_\d+)/", name))}, key=_number)
    if episodes:
        return _robomimic(path, found, dropped, episodes, keys)
    shown = [f"{name}, which is no rows of numbers" for name in dropped]
    plain = {name: array for name, array in found.items() if "/" not in name} or found
    used, names = chosen(plain, keys, str(path))
    return Source("HDF5 of flat arrays (D4RL)", split(used, str(path)), names, shown + unnamed(found, names))


def _robomimic(path: Path, found: dict[str, np.ndarray], dropped: list[str], episodes: list[str], keys: Keys) -> Source:
    """All low-dimensional observations of `obs/` side by side in alphabetical order, unless some are named."""
    tables, left = list[Table](), dict[str, None]()
    names = dict[str, list[str]]()
    prefix = f"data/{episodes[0]}/obs/"
    usual = sorted(name.removeprefix(prefix) for name in found if name.startswith(prefix))
    wanted = list(keys.obs) or usual
    for episode in episodes:
        place, where = f"data/{episode}/", f"{episode} of {path}"
        own = {name.removeprefix(place): array for name, array in found.items() if name.startswith(place)}
        before = {name.removeprefix("obs/"): array for name, array in own.items() if name.startswith("obs/")}
        after = {name.removeprefix("next_obs/"): array for name, array in own.items() if name.startswith("next_obs/")}
        inner = Keys(wanted, keys.action, keys.reward)
        used, names = chosen({name: array for name, array in own.items() if "/" not in name} | before, inner, where)
        left |= dict.fromkeys(name.removeprefix("obs/") for name in own if not name.startswith("next_obs/"))
        if set(wanted) <= after.keys():
            used["next_obs"] = chosen(after, Keys(wanted), where)[0]["obs"]
        done = used.pop("terminated", np.zeros(1)).reshape(-1)
        others = ("truncated", "episode", "ends", "time")
        (table,) = split({name: column for name, column in used.items() if name not in others}, where)
        tables.append(table._replace(terminated=bool(done[-1])))
    shared = sorted({name.split("/", 2)[2] for name in dropped if name.startswith("data/demo_")})
    shown = [f"{name}, which is no rows of numbers" for name in shared]
    return Source("robomimic", tables, names, shown + unnamed(left, names))


def _number(name: str) -> int:
    return int(name.rpartition("_")[2])
