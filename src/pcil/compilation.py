"""JAX's persistent compilation cache, on by default: the second run of the same settings starts at once."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """`JAX_COMPILATION_CACHE_DIR` where it is set, else `pcil/jax` in the user's cache folder."""
    if given := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pcil" / "jax"


def use_cache() -> None:
    """Turn the cache on for this process; where the folder can't be written, compile without it."""
    import jax

    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # a user without a home raises the latter
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
