"""Parse the arguments of commands with `tyro`; errors are one sentence instead of tyro's framed box."""

import contextlib
import dataclasses
import functools
import io
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from pcil.errors import InputError, brief
from pcil.modules import Trust

if TYPE_CHECKING:
    from pcil.training.callbacks import Callback

Execute = Callable[..., int]
"""`(run, folder, callbacks) -> exit code`. The types are not spelled out, because `tyro` would have to resolve them here."""
Json = Annotated[bool, tyro.conf.arg(name="json")]
"""The option of commands that can print one JSON object or list and nothing else."""
SEVERAL = ("callbacks", "action-bounds")
"""The options of `pcil train` that take several values."""


def call(name: str, function: Callable[..., int], argv: list[str]) -> int:
    """Call `function` with the arguments in `argv`, or print its help and return 0; `InputError` if the arguments are invalid.

    `tyro` prints errors in a box on standard error and exits. Standard error is captured only during parsing, not while
    `function` runs.
    """

    @functools.wraps(function)
    def bind(*positional: Any, **named: Any) -> Callable[[], int]:
        return functools.partial(function, *positional, **named)

    if {"-h", "--help"} & set(argv):
        argv = ["--help"]  # tyro's help would omit positional arguments that it has parsed before
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
    """Call `execute` with the run, the folder and the callbacks from the arguments of `pcil train`."""
    from pcil import envs, modules
    from pcil.training import presets
    from pcil.training.config import REGISTRIES, Run

    argv = [_renamed(argument) for argument in argv]
    given = peek(argv)
    if "settings" in given:
        return _train_again(argv, execute)
    task = envs.task_name(given.get("task", "walker_walk"))
    changes: dict[str, Any] = {"label": given["label"]} if given.get("label") in ("sampled", "stored") else {}
    for part in REGISTRIES.keys() & given.keys():
        modules.admit(f"--{part}", modules.of_class(given[part], REGISTRIES[part]), None)
        changes[part] = given[part]
        argv = without(argv, part)
    default = presets.make(task, given.get("method", "pcil"), given.get("preset", "default"), **changes)
    if "reward" in given and "method" not in given:
        default = dataclasses.replace(default, method=given["reward"])  # the results are named after the reward
    if "task" not in given and not {"-h", "--help"} & set(argv):
        raise InputError(f"The task is missing; name one of {', '.join(envs.TASKS)}, or any Gymnasium id.")

    def train(
        out: Path,
        run: Annotated[Run, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = default,
        callbacks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = (),
        action_bounds: tuple[float, float] | None = None,
    ) -> int:
        """Train a policy, or resume where a run stopped.

        The defaults shown are those of the chosen method and preset. --reward and --agent take a name, or a class of your own
        such as my.module:MyReward; --settings FILE takes all settings from the run.json of another run.

        Args:
            out: The run's folder; one that holds the same run resumes it.
            callbacks: Further loggers: wandb, mlflow, or your own, such as my.module:MyLogger.
            action_bounds: Bounds of the actions, for an environment whose actions have none. They become the argument
                "action-bounds" of the environment.
        """
        modules.admit("The task", modules.of_task(task), None)
        modules.admit("--env-kwargs", modules.of_task("", run.env_kwargs), None)
        env_kwargs = run.env_kwargs | ({envs.BOUNDS: list(action_bounds)} if action_bounds else {})
        return execute(dataclasses.replace(run, task=task, env_kwargs=env_kwargs), out, _callbacks(callbacks))

    return call("train", train, argv)


def _train_again(argv: list[str], execute: Execute) -> int:
    def train(settings: str, out: Path, callbacks: tuple[str, ...] = (), trust: Trust = ()) -> int:
        """Train a policy with the settings of another run, or resume where a run stopped.

        Args:
            settings: The run.json of a run, or its content as one argument in JSON.
            out: The run's folder; one that holds the same run resumes it.
            callbacks: Further loggers: wandb, mlflow, or your own, such as my.module:MyLogger.
            trust: Modules that the settings may name, whose code is then run, such as my.module.
        """
        return execute(_run_of(settings, trust), out, _callbacks(callbacks))

    return call("train", train, argv)


def _run_of(settings: str, trust: Sequence[str]) -> Any:
    """The run of a `run.json`, by its path or its content; `trust` are the modules that it may name."""
    from pcil import files, modules
    from pcil.training import config

    source = "--settings" if settings.lstrip().startswith("{") else settings
    try:
        table = files.parse_json(settings.encode()) if source == "--settings" else files.read_json(Path(settings))
        run = config.run_of_file(source, table.get("run", table), trust)
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{source} holds no settings of a run ({error}); give the run.json of one.") from error
    modules.admit(source, modules.of_task(run.task, run.env_kwargs), trust)
    return run


def _callbacks(specs: Sequence[str]) -> "list[Callback]":
    """Create an object of each named class."""
    from pcil import modules
    from pcil.training.callbacks import Callback
    from pcil.training.loggers import LOGGERS

    modules.admit("--callbacks", [name for spec in specs for name in modules.of_class(spec, LOGGERS)], None)
    expected = f"{', '.join(LOGGERS)} or my.module:MyLogger"
    classes = [LOGGERS.get(spec) or modules.load("--callbacks", spec, Callback, expected) for spec in specs]
    return [modules.instance("--callbacks", kind) for kind in classes]


def _renamed(argument: str) -> str:
    """An argument in which an option's old name is replaced by the current one, with a note on standard error."""
    from pcil.training.config import RENAMED

    option, equals, value = argument.partition("=")
    name = option.removeprefix("--").replace("-", "_")
    if not option.startswith("--") or name not in RENAMED:
        return argument
    print(f"pcil: {option} is now called --{RENAMED[name].replace('_', '-')}.", file=sys.stderr)
    return f"--{RENAMED[name].replace('_', '-')}{equals}{value}"


def peek(argv: list[str]) -> dict[str, str]:
    """The raw values of the options, and of the task; needed because the available options depend on the method."""
    given, rest, several = {}, iter(argv), False
    for argument in rest:
        if argument.startswith("--"):
            name, equals, value = argument[2:].partition("=")
            given[name] = value if equals else next(rest, "")
            several = name in SEVERAL and not equals
        elif not argument.startswith("-") and not several:
            given["task"] = argument
    return given


def without(argv: list[str], name: str) -> list[str]:
    """`argv` without `--name VALUE` and `--name=VALUE`."""
    left, rest = [], iter(argv)
    for argument in rest:
        if argument == f"--{name}":
            next(rest, None)
        elif not argument.startswith(f"--{name}="):
            left.append(argument)
    return left


def _complaint(box: str) -> str:
    """The error message in `tyro`'s box as one sentence: the rows above the first rule, and the suggestion below it.

    Depending on the terminal, the frame consists of lines and colours, or of blanks. Help texts are indented by 8.
    """
    plain = re.sub(r"\x1b\[[\d;]*m", "", box)
    rows = [row.rstrip(" │") for row in re.findall(r"^[│ ] (.*)$", plain, flags=re.MULTILINE)]
    rule = next((i for i, row in enumerate(rows) if row and not row.strip("─-")), len(rows))
    wrong = " ".join(row.strip() for row in rows[:rule] if row.strip() and not row.startswith(" " * 8))
    wrong = wrong.rstrip(".").replace(". E", "; e") or "The arguments do not fit"
    meant = dict(zip(rows[rule + 1 :], rows[rule + 2 :], strict=False))
    for header, prefix in (("Argument helptext:", "it takes"), ("Perhaps you meant:", "perhaps you meant")):
        if header in meant:
            wrong += f"; {prefix} {meant[header].strip()}"
    return wrong


def within(least: int, most: int, **options: int) -> None:
    """`InputError` if the value of an option is out of its limits."""
    for name, value in options.items():
        if not least <= value <= most:
            limit = f"at least {least}" if value < least else f"at most {most:,}"
            raise InputError(f"--{name} is {brief(value)}; it must be {limit}.")
