"""`pcil sweep`."""

import sys
from pathlib import Path

from pcil.cli import arguments
from pcil.modules import Trust


def sweep(file: Path, /, out: Path, jobs: int | None = None, address: str | None = None, trust: Trust = ()) -> int:
    """Train every run of a file, side by side; the same command skips what is done and resumes the rest.

    Exit code 1 says that a run failed; the others were finished all the same.

    Args:
        file: The runs, in TOML; docs/sweeps.md says how.
        out: Each run's folder is OUT/TASK/METHOD/SEED.
        jobs: Runs at the same time; by default as many as there are cores for.
        address: A Ray cluster, such as 10.0.0.1:6379; by default one is started on this machine, and stopped at the end.
        trust: Modules that the file may name as tasks or rewards, whose code is then run, such as my.module.
    """
    from pcil import files, sweep
    from pcil.training import progress

    arguments.within(1, 100_000, jobs=1 if jobs is None else jobs)
    return sweep.sweep(file, files.expanded(out), jobs, address, progress.Screen(file=sys.stdout), trust)


def main(words: list[str]) -> int:
    return arguments.call("sweep", sweep, words)
