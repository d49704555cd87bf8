"""Code shared by the benchmarks. Import it first: it requests one thread, which works only before JAX is imported."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pcil import bench

bench.use_one_thread()


def processor_ms(work: Callable[[], Any], times: int) -> float:
    """Mean processor time of one call; other processes on the machine do not change it."""
    before = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - before) / times * 1e3


def print_row(name: str, *cells: str) -> None:
    """Print one line of a table."""
    print(f"{name:<30}{''.join(f'{cell:>16}' for cell in cells)}", flush=True)
