"""How JAX starts: on which devices, and with its persistent cache, so that the second run of a kind starts at once."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path
from typing import Any

from pcil.errors import InputError


def cache_folder() -> Path:
    """`JAX_COMPILATION_CACHE_DIR` where it is set, else `pcil/jax` in the user's cache folder."""
    if given := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pcil" / "jax"


def start() -> None:
    """Start JAX's devices; `InputError` where there are none, or none of the kind that `JAX_PLATFORMS` asks for.

    A plugin that does not work here, such as CUDA's without a GPU, is one line on standard error, where JAX has a traceback.
    """
    import jax

    _check_limits()
    config: Any = jax.config
    failed: list[str] = []

    def heard(record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[1]:
            failed.append(" ".join(str(record.exc_info[1]).split())[:200])
        return not record.exc_info

    logger = logging.getLogger("jax._src.xla_bridge")
    logger.addFilter(heard)
    try:
        devices = jax.devices()
    except Exception as error:  # JAX has no one type for it
        told = " ".join(str(error).split()).partition(" (set JAX_PLATFORMS")[0]
        reason = "; ".join(filter(None, [*failed, told])) or "there is no such device here"
        setting = f" with JAX_PLATFORMS={asked}" if (asked := config.jax_platforms) else ""
        raise InputError(
            f"JAX can't start{setting} ({reason[:300]}); unset JAX_PLATFORMS or set it to cpu, and for a GPU "
            "pip install '.[cuda]' in a clone."
        ) from error
    finally:
        logger.removeFilter(heard)
    if failed and not config.jax_platforms:
        logger.warning("A plugin of JAX does not work here (%s); JAX computes on %s.", failed[0], devices[0].platform)


def _check_limits() -> None:
    """`InputError` where the shell's limits are too low for compiled code, which would end the process without a word."""
    try:
        import resource
    except ImportError:  # on Windows
        return
    for limit, least, unit in ((resource.RLIMIT_NOFILE, 64, "ulimit -n"), (resource.RLIMIT_AS, 2**31, "ulimit -v, in bytes")):
        if 0 <= (given := resource.getrlimit(limit)[0]) < least:
            raise InputError(f"This process may have too little ({unit}: {given:,}); it must be at least {least:,}.")


def use_cache() -> None:
    """Start JAX, and turn the cache on for this process; where its folder can't be written, compile without it."""
    import jax

    start()
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # a user without a home raises the latter
        return
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")  # then it is compiled again
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
