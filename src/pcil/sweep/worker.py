"""The process that trains one run of a sweep: it becomes `pcil train`, so that whatever kills it leaves no process behind."""

from __future__ import annotations

import contextlib
import os
import re
import runpy
import shlex
import signal
import socket
import sys
import threading
import time
import traceback
from pathlib import Path

from pcil import files
from pcil.errors import InputError

PATIENCE_SECONDS = 60.0
"""How long it waits for another process to let go of the folder: one that it replaces may live a little longer."""

TOPOLOGY = Path("/sys/devices/system/cpu")
"""Where Linux says which cores are two threads of one."""


def train(argv: list[str], folder: Path, cores: int) -> int:
    """Train the run in `folder` that the arguments of `pcil train` give, on so many cores of its own. Returns the exit code."""
    print(f"{socket.gethostname()}, process {os.getpid()}: pcil train {shlex.join(argv)}", flush=True)
    _wait_until_free(folder / ".lock")
    held = own_cores(cores)
    sys.argv = ["pcil", "train", *argv]
    try:
        runpy.run_module("pcil", run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        held.close()
    return 1


def own_cores(count: int) -> contextlib.ExitStack:
    """Bind this process to so many cores that no other run of a sweep has on this machine, until what it returns is closed.

    A core is whose socket has its name, in the namespace that all users of a Linux machine share and that no file is in; a
    killed run frees its own. Second threads of a core are taken last. Without as many free ones, or where the system can't
    bind, nothing is bound: a run that wanders between cores is slower, and its result the same.
    """
    names, cores = contextlib.ExitStack(), set()
    with contextlib.suppress(AttributeError):
        for core in sorted(os.sched_getaffinity(0), key=lambda core: (_is_second_thread(core), core)):
            with contextlib.ExitStack() as attempt, contextlib.suppress(OSError):
                attempt.enter_context(socket.socket(socket.AF_UNIX)).bind(f"\0pcil-core-{core}")
                names.push(attempt.pop_all())
                cores.add(core)
            if len(cores) == count:
                os.sched_setaffinity(0, cores)
                return names
    names.close()
    return names


def _is_second_thread(core: int) -> bool:
    try:
        threads = (TOPOLOGY / f"cpu{core}" / "topology" / "thread_siblings_list").read_text()
    except OSError:
        return False
    return int(re.split("[-,]", threads)[0]) != core


def _wait_until_free(lock: Path) -> None:
    """Give the process that this one replaces time to end; `pcil train` says what is wrong with a lock that is never free."""
    until = time.monotonic() + PATIENCE_SECONDS
    with contextlib.suppress(InputError):
        while lock.exists() and time.monotonic() < until:
            with files.locked(lock) as free:
                if free:
                    return
            time.sleep(0.5)


def _stop_at_end_of_input() -> None:
    """Who started this process asks it to stop by closing the pipe that is its input; that of a dead one the system closes."""
    while os.read(0, 1):
        pass
    signal.raise_signal(signal.SIGTERM)


def main() -> int:
    """The run whose folder, number of cores and arguments of `pcil train` are this process's arguments."""
    threading.Thread(target=_stop_at_end_of_input, daemon=True).start()
    folder, cores, *argv = sys.argv[1:]
    return train(argv, Path(folder), int(cores))


if __name__ == "__main__":
    sys.exit(main())
