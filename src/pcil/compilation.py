"""Starting JAX: its devices, and its persistent compilation cache, so that later runs start faster."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path
from typing import Any

from pcil.errors import InputError


def cache_folder() -> Path:
    """`JAX_COMPILATION_CACHE_DIR` if it is set, else `pcil/jax` in the user's cache folder."""
    if given := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pcil" / "jax"


def start() -> None:
    """Initialise JAX's devices; `InputError` if there are none, or none of the platform in `JAX_PLATFORMS`.

    A plugin that fails, such as CUDA's without a GPU, is reported in one line on standard error instead of JAX's traceback.
    """
    import jax

    _check_limits()
    config: Any = jax.config
    failed: list[str] = []

    def note_failure(record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[1]:
            failed.append(" ".join(str(record.exc_info[1]).split())[:200])
        return not record.exc_info

    logger = logging.getLogger("jax._src.xla_bridge")
    logger.addFilter(note_failure)
    try:
        devices = jax.devices()
    except Exception as error:  # JAX raises various types
        message = " ".join(str(error).split()).partition(" (set JAX_PLATFORMS")[0]
        reason = "; ".join(filter(None, [*failed, message])) or "there is no such device here"
        setting = f" with JAX_PLATFORMS={asked}" if (asked := config.jax_platforms) else ""
        raise InputError(
            f"JAX can't start{setting} ({reason[:300]}); unset JAX_PLATFORMS or set it to cpu, and for a GPU "
            "pip install '.[cuda]' in a clone."
        ) from error
    finally:
        logger.removeFilter(note_failure)
    if failed and not config.jax_platforms:
        logger.warning("A plugin of JAX does not work here (%s); JAX computes on %s.", failed[0], devices[0].platform)


def _check_limits() -> None:
    """`InputError` if resource limits are too low for XLA, which would crash without a message."""
    try:
        import resource
    except ImportError:  # on Windows
        return
    for limit, least, unit in ((resource.RLIMIT_NOFILE, 64, "ulimit -n"), (resource.RLIMIT_AS, 2**31, "ulimit -v, in bytes")):
        if 0 <= (given := resource.getrlimit(limit)[0]) < least:
            raise InputError(f"This process may have too little ({unit}: {given:,}); it must be at least {least:,}.")


def use_cache() -> None:
    """Start JAX, and enable the cache for this process if its folder can be written."""
    import jax

    start()
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError if there is no home directory
        return
    warnings.filterwarnings(
        "ignore", "Error (reading|writing) persistent compilation cache"
    )  # the program is then compiled again
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
