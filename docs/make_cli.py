"""Write docs/cli.md from the help of each command: `python docs/make_cli.py`; with `--check`, exit 1 if it is stale."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path

PAGE = Path(__file__).with_name("cli.md")
TERMINAL = {"COLUMNS": "100", "NO_COLOR": "1", "FORCE_COLOR": "0"}
"""What the help depends on is fixed while it is made."""

INTRODUCTION = """\
# Command line

Made from the help of each command by `python docs/make_cli.py`; do not edit.

Exit codes: 0 success, 2 bad input (one sentence on standard error says what was wrong and what would be right), 130 and 143
where Ctrl-C and SIGTERM stopped a run. A command with `--json` prints nothing else on standard output. `--reward
my.module:MyReward` takes a reward of your own in place of the method's.
"""


@contextlib.contextmanager
def _terminal() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in TERMINAL}
    os.environ.update(TERMINAL)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value


def help_of(*words: str) -> str:
    """What `pcil WORDS --help` prints, at a fixed width and without colour."""
    from pcil.cli import main

    written = io.BytesIO()
    text = io.TextIOWrapper(written, encoding="utf-8")  # the boxes are drawn with other characters where that is not UTF-8
    with _terminal(), contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    text.flush()
    return "\n".join(line.rstrip() for line in written.getvalue().decode().strip().splitlines())


def _reward_options(text: str) -> str:
    """The box of `--reward.*` options out of the help of `pcil train`."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if "reward options" in line)
    end = next(i for i in range(start, len(lines)) if lines[i].startswith("╰"))
    return "\n".join(lines[start : end + 1])


def page() -> str:
    """The whole of cli.md."""
    from pcil.cli import COMMANDS
    from pcil.training.presets import METHODS

    parts = [INTRODUCTION, _block(help_of())]
    for command in COMMANDS:
        parts += [f"## pcil {command}\n", _block(help_of(command))]
        if command == "train":
            for method in METHODS[1:]:
                options = _reward_options(help_of("train", "--method", method))
                parts += [f"With `--method {method}` the reward's options are:\n", _block(options)]
    return "\n".join(parts)


def _block(text: str) -> str:
    return f"```text\n{text}\n```\n"


def main(words: list[str]) -> int:
    """Write the page, or say whether it is fresh."""
    fresh = page()
    if words == ["--check"]:
        stale = not PAGE.exists() or PAGE.read_text(encoding="utf-8") != fresh
        if stale:
            print(f"{PAGE.name} is stale: run python docs/make_cli.py", file=sys.stderr)
        return int(stale)
    PAGE.write_text(fresh, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
