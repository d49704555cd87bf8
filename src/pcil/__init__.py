"""Policies from demonstrations: Policy Contrastive Imitation Learning (ICML 2023) and its baselines.

    run = pcil.train("walker_walk", method="pcil", seed=1, frames=200_000, out="runs/ww")
    policy = pcil.load_policy("runs/ww")
    action = policy(obs)

Names load on first use, so that `import pcil` and `pcil --help` stay fast.
"""

import importlib

__version__ = "0.2.0.dev0"
__all__ = [
    "Agent",
    "Callback",
    "Demonstrations",
    "Episode",
    "InputError",
    "Policy",
    "Reward",
    "RunError",
    "export_onnx",
    "load_policy",
    "make_env",
    "record",
    "train",
]

_HOME = {
    "Agent": ("pcil.agents", "Agent"),
    "Callback": ("pcil.training.callbacks", "Callback"),
    "Demonstrations": ("pcil.demos", "Demonstrations"),
    "Episode": ("pcil.types", "Episode"),
    "InputError": ("pcil.errors", "InputError"),
    "Policy": ("pcil.policy", "Policy"),
    "Reward": ("pcil.rewards", "Reward"),
    "RunError": ("pcil.errors", "RunError"),
    "export_onnx": ("pcil.export", "export_onnx"),
    "load_policy": ("pcil.policy", "load_policy"),
    "make_env": ("pcil.envs", "make"),
    "record": ("pcil.demos", "record"),
    "train": ("pcil.training.runs", "train"),
}


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'pcil' has no attribute {name!r}")
    module, attribute = _HOME[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    """The public names, also those that are not loaded yet."""
    return sorted({*globals(), *__all__} - {"importlib"})
