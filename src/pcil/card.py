"""The model card of a saved policy: `README.md` with the front matter that Hugging Face's hub reads. It is only a file."""

from __future__ import annotations

import json
import math
from typing import Any


def card(task: str, info: dict[str, Any], licence: str | None = None, name: str = "FOLDER") -> str:
    """The text of the card, from the content of `policy.json` alone; what `info` lacks is left out. `load_policy` finds the
    policy by its `name`."""
    method = str(info.get("method", "policy"))
    front = {
        "license": licence or "unknown",
        "library_name": "pcil",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["imitation-learning", "reinforcement-learning", method, task],
    }
    if "return_mean" in info:
        kind = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
        paid = {"type": "mean_reward", "name": "mean_reward", "value": _return(info), "verified": False}
        results = [{"task": kind, "dataset": {"name": task, "type": task}, "metrics": [paid]}]
        front["model-index"] = [{"name": f"{method}-{task}", "results": results}]
    rows = {"task": _code(task), "method": _code(method)}
    if "preset" in info:
        rows["method"] += f", preset {_code(info['preset'])}, seed {info.get('seed')}"
    if "demos" in info:
        rows["data"] = _code(info["demos"]) if info["demos"] else "none: it learned from the task's own reward"
    if "frames" in info:
        frames = f"{info['frames']:,}" if isinstance(info["frames"], int) else _plain(info["frames"])
        rows["frames"] = f"{frames} control steps of the environment, {info.get('action_repeat', 1)} for each action"
    if "return_mean" in info:
        rows["return"] = _return(info)
    rows["command"] = _code(info.get("command") or _command(task, info))
    rows["licence"] = licence or "not chosen; whoever shares this policy chooses one, here and in `license` above"
    lines = ["---", *(f"{name}: {json.dumps(value)}" for name, value in front.items()), "---", ""]  # JSON is YAML
    lines += [f"# {_plain(method)} on {_plain(task)}", "", "| | |", "|---|---|"]
    lines += [f"| {name} | {value} |" for name, value in rows.items()]
    lines += ["", "`pcil train --settings run.json --out DIR`, with the `run.json` of its run, trains it with every setting."]
    lines += ["", "```python", "import pcil", "", f'policy = pcil.load_policy("{name}")', "action = policy(obs)", "```", ""]
    return "\n".join(lines)


def _return(info: dict[str, Any]) -> str:
    """The mean return, with Student's 95% interval over the episodes of the evaluation where there were several."""
    mean, deviation, episodes = info["return_mean"], info.get("return_std"), info.get("return_episodes", 0)
    if deviation is None or episodes < 2:
        return f"{mean:.1f}"
    from scipy.special import stdtrit

    half = float(stdtrit(episodes - 1, 0.975)) * deviation / math.sqrt(episodes - 1)
    return f"{mean:.1f} [{mean - half:.1f}, {mean + half:.1f}], a mean over {episodes} episodes and its 95% interval"


def _command(task: str, info: dict[str, Any]) -> str:
    names = ("method", "preset", "seed", "frames")
    words = [f"--{name} {info[name]}" for name in names if info.get(name) is not None]
    words += [f"--env-kwargs '{json.dumps(info['env_kwargs'])}'"] if info.get("env_kwargs") else []
    return " ".join(["pcil train", task, *words, "--out DIR"])


def _code(text: Any) -> str:
    return f"`{_plain(text)}`"


def _plain(text: Any) -> str:
    """Text for a cell of a table: without line breaks, bars and backticks, which would end it."""
    return "".join(" " if c in "|`<>" or not c.isprintable() else c for c in str(text))
