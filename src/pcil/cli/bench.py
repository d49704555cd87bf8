"""`pcil bench`."""

import json

from pcil.cli import arguments
from pcil.cli.arguments import Json
from pcil.errors import InputError


def bench(
    task: str = "walker_walk",
    preset: str = "default",
    seconds: float = 20.0,
    json_output: Json = False,
) -> int:
    """Measure the speed of each part, and its ratio to a lower bound, on one thread.

    Args:
        task: The environment, which also determines the sizes of the networks.
        preset: The preset of PCIL whose update is measured.
        seconds: The approximate duration of the measurement.
        json_output: Print one JSON object and nothing else.
    """
    from pcil import bench

    if not 0 < seconds < 86_400:
        raise InputError(f"--seconds is {seconds}; it must be above 0 and below a day.")
    figures = bench.measure(task, preset, seconds)
    print(json.dumps(figures) if json_output else bench.table(figures))
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("bench", bench, argv)
