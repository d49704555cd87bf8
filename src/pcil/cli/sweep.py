"""`pcil sweep`: train the runs of a file, or of tasks, methods and seeds."""

import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from pcil.cli import arguments
from pcil.errors import InputError
from pcil.modules import Trust

_OF_TASKS = {"--methods", "--seeds", "--preset", "--frames"}
"""The options that apply to tasks; a file has these settings itself."""


def main(argv: list[str]) -> int:
    def sweep(
        what: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FILE|TASK...", help_behavior_hint="")],
        /,
        out: Path,
        methods: tuple[str, ...] = ("pcil",),
        seeds: tuple[int, ...] = (1, 2, 3),
        preset: str = "default",
        frames: int | None = None,
        jobs: int | None = None,
        address: str | None = None,
        trust: Trust = (),
    ) -> int:
        """Train many runs in parallel; the same command skips what is done and resumes the rest.

        Exit code 1 means that a run failed; the others were finished nevertheless.

        Args:
            what: The runs, in a TOML file (docs/sweeps.md says how), or tasks, each with every method and seed.
            out: Each run's folder is OUT/TASK/METHOD/SEED.
            methods: The methods, if tasks are given.
            seeds: The seeds, if tasks are given.
            preset: The preset, as in pcil train, if tasks are given.
            frames: The frames of each run, if tasks are given; by default as in pcil train.
            jobs: The number of simultaneous runs; by default as many as there are cores for.
            address: The address of a Ray cluster, such as 10.0.0.1:6379; by default runs are trained on this machine.
            trust: Modules that the file may name and whose code is then run, such as my.module.
        """
        from pcil import files, sweep
        from pcil.sweep import plans
        from pcil.training import progress

        arguments.within(1, 100_000, jobs=1 if jobs is None else jobs)
        if not what:
            raise InputError("Nothing is named; give a FILE.toml, or tasks such as walker_walk.")
        out = files.expanded(out)
        if not what[0].endswith(".toml"):
            table: dict[str, Any] = {"tasks": list(what), "methods": list(methods), "seeds": list(seeds), "preset": preset}
            table |= {} if frames is None else {"frames": frames}
            plan = plans.of_table("The command", table, out, None)
        elif other := [*what[1:], *sorted({argument.partition("=")[0] for argument in argv} & _OF_TASKS)]:
            raise InputError(f"{other[0]} is given beside {what[0]}; a file says itself what its runs are.")
        else:
            plan = plans.read(Path(what[0]), out, trust)
        return sweep.sweep(plan, out, jobs, address, progress.Screen(file=sys.stdout))

    return arguments.call("sweep", sweep, argv)
