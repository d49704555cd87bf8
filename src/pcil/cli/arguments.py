"""From the arguments of a command to those of a function, by `tyro`; what does not fit is one sentence, not a framed box."""

import contextlib
import dataclasses
import functools
import io
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcil.errors import InputError, brief
from pcil.modules import Trust

if TYPE_CHECKING:
    from pcil.training.callbacks import Callback

Execute = Callable[..., int]
"""Trains a run: `(run, folder, callbacks) -> exit code`. Its types are not named, for `tyro` would resolve them here."""
SEVERAL = ("callbacks",)
"""Options of `pcil train` that take more than one value."""


def call(name: str, function: Callable[..., int], argv: list[str]) -> int:
    """Call `function` with the arguments that `argv` gives, or show its help and return 0.

    `InputError` says what does not fit. `tyro` prints that in a box on standard error and exits; only its parsing is listened
    to, so what `function` itself writes there goes there at once.
    """
    import tyro

    @functools.wraps(function)
    def bind(*positional: Any, **named: Any) -> Callable[[], int]:
        return functools.partial(function, *positional, **named)

    if {"-h", "--help"} & set(argv):
        argv = ["--help"]  # tyro's help leaves out the positional arguments that it has read before
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            bound = tyro.cli(bind, prog=f"pcil {name}", args=argv)
    except SystemExit as end:
        if not end.code:
            return 0
        raise InputError(f"{_complaint(box.getvalue())}; pcil {name} --help tells more.") from None
    return bound()


def train(argv: list[str], execute: Execute) -> int:
    """Call `execute` with the run, the folder and the callbacks that the arguments of `pcil train` give."""
    import tyro

    from pcil import envs, modules
    from pcil.training import presets
    from pcil.training.config import REGISTRIES, Run

    argv = [_renamed(word) for word in argv]
    given = peek(argv)
    if "settings" in given:
        return call("train", functools.partial(_train_again, execute), argv)
    task = envs.task_name(given.get("task", "walker_walk"))
    changes: dict[str, Any] = {"label": given["label"]} if given.get("label") in ("sampled", "stored") else {}
    for part in REGISTRIES.keys() & given.keys():
        modules.admit(f"--{part}", modules.of_class(given[part]), None)
        changes[part] = given[part]
        argv = without(argv, part)
    default = presets.make(task, given.get("method", "pcil"), given.get("preset", "default"), **changes)
    if "reward" in given and "method" not in given:
        default = dataclasses.replace(default, method=given["reward"])  # its results go by its own name
    if "task" not in given and not {"-h", "--help"} & set(argv):
        raise InputError(f"The task is missing; name one of {', '.join(envs.TASKS)}, or any Gymnasium id.")

    def train(
        out: Path,
        run: Annotated[Run, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = default,
        callbacks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODULE:CLASS ...")] = (),
    ) -> int:
        """Train a policy, or resume where a run stopped.

        The settings shown are those of the chosen method and preset. --reward and --agent take one by its name, or
        my.module:MyReward, one of your own; --settings FILE takes all settings from the run.json of another run.

        Args:
            out: The run's folder; one that holds the same run resumes it.
            callbacks: Loggers of your own, such as my.module:MyLogger, which are told how the run goes.
        """
        modules.admit("The task", modules.of_task(task), None)
        modules.admit("--env-kwargs", modules.of_task("", run.env_kwargs), None)
        return execute(dataclasses.replace(run, task=task), out, _callbacks(callbacks))

    return call("train", train, argv)


def _train_again(
    execute: Execute,
    settings: str,
    out: Path,
    callbacks: tuple[str, ...] = (),
    trust: Trust = (),
) -> int:
    """Train a policy with the settings of another run, or resume where a run stopped.

    Args:
        settings: The run.json of a run, or what it holds, as one word of JSON.
        out: The run's folder; one that holds the same run resumes it.
        callbacks: Loggers of your own, such as my.module:MyLogger, which are told how the run goes.
        trust: Modules that the settings may name, whose code is then run, such as my.module.
    """
    from pcil import files, modules
    from pcil.training import config

    source = "--settings" if settings.lstrip().startswith("{") else settings
    try:
        table = files.parse_json(settings.encode()) if source == "--settings" else files.read_json(Path(settings))
        run = config.run_of_file(source, table.get("run", table), trust)
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{source} holds no settings of a run ({error}); give the run.json of one.") from error
    modules.admit(source, modules.of_task(run.task, run.env_kwargs), trust)
    return execute(run, out, _callbacks(callbacks))


def _callbacks(specs: Sequence[str]) -> "list[Callback]":
    """An object of each class that was named."""
    from pcil import modules
    from pcil.training.callbacks import Callback

    modules.admit("--callbacks", [name for spec in specs for name in modules.of_class(spec)], None)
    classes = [modules.load("--callbacks", spec, Callback, "my.module:MyLogger") for spec in specs]
    return [modules.instance("--callbacks", kind) for kind in classes]


def _renamed(word: str) -> str:
    """A word of the command line with a setting by the name that it has today, which is said of an older one."""
    from pcil.training.config import RENAMED

    option, equals, value = word.partition("=")
    name = option.removeprefix("--").replace("-", "_")
    if not option.startswith("--") or name not in RENAMED:
        return word
    print(f"pcil: {option} is now called --{RENAMED[name].replace('_', '-')}.", file=sys.stderr)
    return f"--{RENAMED[name].replace('_', '-')}{equals}{value}"


def peek(argv: list[str]) -> dict[str, str]:
    """The values of the options as they are given, before the method has decided which options there are."""
    given, rest, several = {}, iter(argv), False
    for word in rest:
        if word.startswith("--"):
            name, equals, value = word[2:].partition("=")
            given[name] = value if equals else next(rest, "")
            several = name in SEVERAL and not equals
        elif not word.startswith("-") and not several:
            given["task"] = word
    return given


def without(argv: list[str], name: str) -> list[str]:
    """`argv` without `--name VALUE` and `--name=VALUE`."""
    left, rest = [], iter(argv)
    for word in rest:
        if word == f"--{name}":
            next(rest, None)
        elif not word.startswith(f"--{name}="):
            left.append(word)
    return left


def _complaint(box: str) -> str:
    """What `tyro` says in a box, with the option that was meant: the rows up to the first rule, then that option.

    The frame depends on the terminal: lines and colours, or blanks. Help texts are indented by 8.
    """
    plain = re.sub(r"\x1b\[[\d;]*m", "", box)
    rows = [row.rstrip(" │") for row in re.findall(r"^[│ ] (.*)$", plain, flags=re.MULTILINE)]
    rule = next((i for i, row in enumerate(rows) if row and not row.strip("─-")), len(rows))
    wrong = " ".join(row.strip() for row in rows[:rule] if row.strip() and not row.startswith(" " * 8))
    wrong = wrong.rstrip(".").replace(". E", "; e") or "The arguments do not fit"
    meant = dict(zip(rows[rule + 1 :], rows[rule + 2 :], strict=False))
    for header, words in (("Argument helptext:", "it takes"), ("Perhaps you meant:", "perhaps you meant")):
        if header in meant:
            wrong += f"; {words} {meant[header].strip()}"
    return wrong


def within(least: int, most: int, **options: int) -> None:
    """`InputError` where the number of an option is out of its limits."""
    for name, value in options.items():
        if not least <= value <= most:
            limit = f"at least {least}" if value < least else f"at most {most:,}"
            raise InputError(f"--{name} is {brief(value)}; it must be {limit}.")
