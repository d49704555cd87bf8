"""From the words of a command to a function's arguments, by `tyro`; what does not fit is one sentence, not a framed box."""

import contextlib
import dataclasses
import functools
import importlib
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcil.errors import InputError, brief

if TYPE_CHECKING:
    from pcil.training.config import Run


def call(name: str, function: Callable[..., int], words: list[str]) -> int:
    """Call `function` with the arguments that `words` give, or show its help and return 0.

    `InputError` says what does not fit. `tyro` prints that in a box on standard error and exits; only its parsing is listened
    to, so what `function` itself writes there goes there at once.
    """
    import tyro

    @functools.wraps(function)
    def bind(*positional: Any, **named: Any) -> Callable[[], int]:
        return functools.partial(function, *positional, **named)

    if {"-h", "--help"} & set(words):
        words = ["--help"]  # tyro's help leaves out the positional arguments that it has read before
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            bound = tyro.cli(bind, prog=f"pcil {name}", args=words)
    except SystemExit as end:
        if not end.code:
            return 0
        raise InputError(f"{_complaint(box.getvalue())}; pcil {name} --help tells more.") from None
    return bound()


def train(words: list[str], execute: Callable[["Run", Path], int], trust: Sequence[str] | None = None) -> int:
    """Call `execute` with the run and the folder that the words of `pcil train` give.

    Where a file gives the words, `trust` are the modules that it may name; where a person typed them, it is None.
    """
    import tyro

    from pcil import envs, modules
    from pcil.training import presets
    from pcil.training.config import Run

    given = peek(words)
    task = envs.task_name(given.get("task", "walker_walk"))
    changes: dict[str, Any] = {"label": given["label"]} if given.get("label") in ("sampled", "stored") else {}
    if "reward" in given:
        modules.admit("--reward", [given["reward"].partition(":")[0]], trust)
        changes["reward"] = _load_reward(given["reward"])
        words = without(words, "reward")
    default = presets.make(task, given.get("method", "pcil"), given.get("preset", "default"), **changes)
    if "reward" in given and "method" not in given:
        default = dataclasses.replace(default, method=given["reward"])  # its results go by its own name
    if "task" not in given and not {"-h", "--help"} & set(words):
        raise InputError(f"The task is missing; name one of {', '.join(envs.TASKS)}, or any Gymnasium id.")

    def train(out: Path, run: Annotated[Run, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = default) -> int:
        """Train a policy, or resume where a run stopped.

        The settings shown are those of the chosen method and preset. --reward my.module:MyReward takes a reward of your own
        in place of the method's.

        Args:
            out: The run's folder; one that holds the same run resumes it.
        """
        modules.admit("The task", modules.of_task(task), trust)
        modules.admit("--env-kwargs", modules.of_task("", run.env_kwargs), trust)
        return execute(dataclasses.replace(run, task=task), out)

    return call("train", train, words)


def _load_reward(spec: str) -> Any:
    """An instance of the reward class that `module:Class` names."""
    from pcil.rewards import Reward

    module, _, name = spec.partition(":")
    try:
        kind = getattr(importlib.import_module(module), name)
        if not (isinstance(kind, type) and issubclass(kind, Reward)):
            raise TypeError(f"{name} is no subclass of pcil.Reward")
        return kind()
    except Exception as error:  # the module is a person's own and may raise anything
        raise InputError(
            f"--reward {spec!r} can't be loaded ({type(error).__name__}: {error}); it must look like my.module:MyReward."
        ) from error


def peek(words: list[str]) -> dict[str, str]:
    """The values of the options as they are given, before the method has decided which options there are."""
    given, rest = {}, iter(words)
    for word in rest:
        if word.startswith("--") and "=" in word:
            name, value = word[2:].split("=", 1)
            given[name] = value
        elif word.startswith("--"):
            given[word[2:]] = next(rest, "")
        elif not word.startswith("-"):
            given["task"] = word
    return given


def without(words: list[str], name: str) -> list[str]:
    """`words` without `--name VALUE` and `--name=VALUE`."""
    left, rest = [], iter(words)
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
