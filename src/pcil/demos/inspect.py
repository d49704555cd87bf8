"""What `pcil demos` shows: the demonstrations that ship; sizes, returns and ranges of a dataset, and what looks wrong."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcil.demos import Demonstrations, shipped_tasks

HUGE = 1e6
"""An absolute value from which on float32 resolves less than a tenth."""
OFFSET = 1e3
"""How many times its standard deviation an entry may be away from 0 before float32 costs it digits."""
FEWEST = 4
"""The smallest number of episodes of which one may be called an outlier."""


def shipped() -> list[dict[str, Any]]:
    """One row per shipped dataset. All values are computed from the data, except those that only `info` has (else None)."""
    rows = []
    for demos in map(Demonstrations.load, shipped_tasks()):
        dims = {"observation_dim": demos.obs.shape[1], "action_dim": demos.action.shape[1]}
        counts = {"episodes": len(demos.episodes), "steps": demos.num_steps}
        returns = {"return_mean": demos.return_mean, "return_std": demos.return_std}
        returns |= {"return_min": float(demos.returns.min()), "return_max": float(demos.returns.max())}
        known = {key: demos.info.get(key) for key in ("expert", "frames", "seeds_tried")}
        rows.append({"task": demos.task, **dims, **counts, **returns, **known, "hash": demos.hash})
    return rows


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The rows of `shipped` as a plain-text table, one line per dataset."""
    sizes = f"{'obs':>4}{'act':>4}{'episodes':>9}{'steps':>7}"
    lines = [f"{'task':<18}{sizes}{'return':>15}{'min':>7}{'max':>7}{'tries':>6}  {'hash':<10}expert"]
    for row in rows:
        sizes = f"{row['observation_dim']:>4}{row['action_dim']:>4}{row['episodes']:>9}{row['steps']:>7}"
        returns = f"{row['return_mean']:.1f} +- {row['return_std']:.1f}"
        returns = f"{returns:>15}{row['return_min']:>7.1f}{row['return_max']:>7.1f}"
        tries = "" if row["seeds_tried"] is None else row["seeds_tried"]
        lines.append(f"{row['task']:<18}{sizes}{returns}{tries:>6}  {row['hash'][:8]:<10}{row['expert']}")
    return lines


def summary(demos: Demonstrations) -> dict[str, Any]:
    """Everything that `pcil demos PATH` shows, as JSON has it.

    Returns are None where there are no rewards, and actions have no ranges where there are none. An outlier is an episode whose
    return or length lies more than 1.5 interquartile ranges outside the middle half.
    """
    lengths = np.array([len(episode) for episode in demos.episodes])
    returns = demos.returns if demos.has_rewards else None
    numbers: dict[str, Any] = {"length": lengths, "return": returns}
    about: dict[str, Any] = {"task": demos.task, "episodes": len(demos.episodes), "steps": demos.num_steps}
    about |= {"actions": demos.has_actions, "rewards": demos.has_rewards}
    about["terminated"] = sum(bool(episode.terminated) for episode in demos.episodes)
    for name, values in numbers.items():
        for what in ("min", "mean", "max", "std"):
            about[f"{name}_{what}"] = None if values is None else float(getattr(values, what)())
    about |= {"observation_dim": demos.obs.shape[1], "action_dim": demos.action.shape[1] if demos.has_actions else None}
    about["observation_ranges"] = _ranges(np.concatenate([episode.obs for episode in demos.episodes]))
    about["action_ranges"] = _ranges(demos.action) if demos.has_actions else []
    about["outliers"] = [
        {"episode": int(i), "what": name, "value": float(values[i])}
        for name, values in numbers.items()
        if values is not None
        for i in _outliers(values)
    ]
    return about | {"origin": demos.origin._asdict(), "hash": demos.hash}


def _ranges(rows: np.ndarray) -> list[dict[str, Any]]:
    """Lowest, mean and highest value and standard deviation of each entry, and a note where it is constant, huge, or far from 0
    for how little it varies."""
    rows = rows.astype(np.float64)
    low, high, mean, std = rows.min(0), rows.max(0), rows.mean(0), rows.std(0)
    notes = [
        "constant" if lowest == highest else "huge" if most >= HUGE else "offset" if abs(centre) > OFFSET * spread else ""
        for lowest, highest, most, centre, spread in zip(low, high, np.abs(rows).max(0), mean, std, strict=True)
    ]
    columns = zip(low.tolist(), mean.tolist(), high.tolist(), std.tolist(), notes, strict=True)
    return [dict(zip(("min", "mean", "max", "std", "note"), row, strict=True)) for row in columns]


def _outliers(values: np.ndarray) -> np.ndarray:
    """The indices of the values that lie more than 1.5 interquartile ranges outside the middle half."""
    first, third = np.percentile(values, [25, 75])
    margin = 1.5 * (third - first) + 1e-9 * np.abs(values).max()
    return np.flatnonzero((values < first - margin) | (values > third + margin)) if len(values) >= FEWEST else np.array([], int)


def lines(about: dict[str, Any]) -> list[str]:
    """A `summary` as text."""

    def spread(name: str) -> str:
        return f"{about[f'{name}_mean']:.4g} on average, from {about[f'{name}_min']:.4g} to {about[f'{name}_max']:.4g}"

    episodes, origin = about["episodes"], about["origin"]
    told = [
        f"{about['task']}: {episodes} episode{'s'[: episodes - 1]}, {about['steps']:,} steps, {about['terminated']} terminated",
        f"length: {spread('length')} steps",
        f"return: {spread('return')}" if about["rewards"] else "return: there are no rewards",
    ]
    if origin["env_id"]:
        told.append(f"environment: {origin['env_id']}")
    if origin["step_seconds"]:
        told.append(f"time step: {origin['step_seconds']:.6g} s")
    for name, size in (("observation", about["observation_dim"]), ("action", about["action_dim"])):
        if size is None:
            told.append("actions: there are none")
            continue
        told.append(f"{name}s of {size} number{'s'[: size - 1]}" + (", in [-1, 1]:" if name == "action" else ":"))
        told.append(f"{'entry':>7}{'min':>12}{'mean':>12}{'max':>12}{'std':>12}")
        for i, row in enumerate(about[f"{name}_ranges"]):
            numbers = "".join(f"{row[key]:>12.4g}" for key in ("min", "mean", "max", "std"))
            told.append(f"{i:>7}{numbers}" + (f"  {NOTES[row['note']]}" if row["note"] else ""))
    for found in about["outliers"]:
        told.append(f"outlier: episode {found['episode']} has a {found['what']} of {found['value']:.4g}")
    return told


NOTES = {
    "constant": "constant",
    "huge": "huge: float32 resolves no tenths of it",
    "offset": "far from 0 for how little it varies: float32 costs it digits",
}
