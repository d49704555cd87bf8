"""The command line. A command imports its dependencies when it runs, so that `pcil --help` is fast."""

import importlib
import io
import os
import sys
from collections.abc import Callable, Sequence

from pcil import errors
from pcil.errors import InputError

COMMANDS = {
    "train": "Train a policy, or resume where a run stopped.",
    "evaluate": "Roll out the policy of a run, without exploration.",
    "demos": "List the demonstrations that ship, or say what a dataset holds.",
    "import": "Make a dataset of demonstrations from other files.",
    "record": "Record demonstrations from a trained policy.",
    "film": "Film a trained policy.",
    "play": "Show a trained policy in a window.",
    "export": "Write a trained policy as an ONNX file.",
    "theory": "Check the paper's Theorem 1 numerically, and draw it.",
    "report": "Draw figures, tables and a page from runs.",
    "sweep": "Train many runs in parallel.",
    "bench": "Measure the speed of each part, and its ratio to a lower bound.",
    "doctor": "Say what is installed, what is wrong, and what to do.",
}
"""The summary of each command; `pcil.cli.<command>` has its `main(argv)`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 on success, 2 on invalid input, 1 if a run failed, 130 or 143 on a signal."""
    # XLA has its own threads; more BLAS threads in NumPy would only slow down the small matrix products of this package.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # for terminals that can't show every character
    argv = list(sys.argv[1:] if arguments is None else arguments)
    return exit_code(lambda: _command(argv), resumes=argv[:1] in (["train"], ["sweep"]))


def exit_code(command: Callable[[], int | None], *, resumes: bool = False) -> int:
    """Run a command and return its exit code. What it raises becomes a sentence on standard error, unless it is a bug of ours.

    `resumes` says that the same command goes on after an interruption.
    """
    try:
        code = command()
        sys.stdout.flush()
        return code or 0
    except KeyboardInterrupt:
        again = "; the same command goes on from the last checkpoint" if resumes else ""
        print(f"pcil: stopped{again}.", file=sys.stderr)
        return 130
    except BrokenPipeError:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())  # else Python would report the error again at exit
        return 141
    except Exception as error:
        if not (found := errors.as_message(error)):
            raise
        message, code = found
        print(f"pcil: {message}.", file=sys.stderr)
        return code


def _command(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if argv[0] == "--version":
        print(f"pcil {importlib.import_module('pcil').__version__}")
        return 0
    if argv[0] not in COMMANDS:
        raise InputError(f"There is no command {argv[0]!r}; the commands are {', '.join(COMMANDS)}.")
    return importlib.import_module(f"pcil.cli.{argv[0]}").main(argv[1:])


def _overview() -> str:
    lines = ["usage: pcil COMMAND ...", "", "Policies from demonstrations.", "", "commands:"]
    lines += [f"  {name:<10}{summary}" for name, summary in COMMANDS.items()]
    return "\n".join([*lines, "", "pcil COMMAND --help tells more; pcil --version prints the version."])
