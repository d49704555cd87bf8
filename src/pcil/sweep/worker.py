"""The process of one run of a sweep. It runs `pcil train` itself, so that killing it leaves no child process behind."""

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
"""How long to wait for the lock of the folder: the previous process of the run may still be ending."""

TOPOLOGY = Path("/sys/devices/system/cpu")
"""The folder in which Linux describes which logical cores are threads of one physical core."""


def train(argv: list[str], folder: Path, cores: int) -> int:
    """Run `pcil train` with `argv` for the run in `folder`, bound to this number of cores, and return the exit code."""
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
    """Bind this process to `count` cores that no other run of a sweep uses on this machine, until the result is closed.

    A process reserves a core by binding a Unix socket to the core's name in the abstract namespace, which all users of a Linux
    machine share, and which needs no files; the kernel frees the name when the process ends. Second hardware threads of a core
    are taken last. If there are not enough free cores, or if the system does not support this, the process is not bound. It may
    then be slower, but its results are the same.
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
    """Wait for the previous process of the run to end; `pcil train` reports a lock that stays taken."""
    until = time.monotonic() + PATIENCE_SECONDS
    with contextlib.suppress(InputError):
        while lock.exists() and time.monotonic() < until:
            with files.locked(lock) as free:
                if free:
                    return
            time.sleep(0.5)


def _stop_at_end_of_input() -> None:
    """Stop when standard input ends: the sweep closes this pipe, and the system does so if the sweep is killed."""
    while os.read(0, 1):
        pass
    signal.raise_signal(signal.SIGTERM)


def main() -> int:
    """Train the run; the arguments of this process are its folder, its number of cores and the argv of `pcil train`."""
    threading.Thread(target=_stop_at_end_of_input, daemon=True).start()
    folder, cores, *argv = sys.argv[1:]
    return train(argv, Path(folder), int(cores))


if __name__ == "__main__":
    sys.exit(main())
