"""`pcil demos`."""

import json

from pcil.cli import arguments
from pcil.cli.arguments import Json


def demos(json_output: Json = False) -> int:
    """List the demonstrations that ship.

    Args:
        json_output: Print one JSON list and nothing else.
    """
    from pcil.demos import shipped, table

    rows = shipped()
    print(json.dumps(rows) if json_output else "\n".join(table(rows)))
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("demos", demos, argv)
