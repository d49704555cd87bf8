"""Change the source in one place at a time and show the changes that no test notices: `make mutants FILES="losses noise"`.

The changes are those of Cosmic Ray and three more: a call removed, two arguments swapped, None returned. Each is made in a copy
of the source and tested in a separate process, forked from one that has already imported JAX. `mutants.toml` has the tests that
are assigned to each file and the changes that are known to make no difference; `docs/mutants.md` has the results.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from cosmic_ray.ast import Visitor, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).parent.parent
COMPARISONS = "Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is"
BINARY = "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_FloorDiv Pow_Mul BitOr_BitAnd BitAnd_BitOr"
OPERATORS = [
    *(f"core/ReplaceComparisonOperator_{pair}" for pair in COMPARISONS.split()),
    *(f"core/ReplaceBinaryOperator_{pair}" for pair in BINARY.split()),
    *(f"core/ReplaceUnaryOperator_Delete_{name}" for name in ("Not", "USub", "Invert")),
    *(f"core/{name}" for name in ("NumberReplacer", "AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue")),
    *(f"core/{name}" for name in ("ReplaceAndWithOr", "ReplaceOrWithAnd", "ZeroIterationForLoop")),
]
HEAVY = ["jax", "equinox", "optax", "gymnasium", "scipy", "hypothesis", "pytest", "beartype", "h5py", "tyro", "minari"]
HEAVY += ["orbax.checkpoint", "ot", "mujoco"]
"""Modules imported once, so that the children need not import them; POT alone takes seconds."""
LONGEST = 60
"""The maximum number of seconds of processor time for one test, since a change can make a loop endless."""
PATIENCE = 10
"""How many times longer the tests of a change may take by the clock than the processor time that they may take."""
SYMMETRIC = {"minimum", "maximum", "min", "max"}
"""Functions whose two arguments may be swapped."""


class Mutant(NamedTuple):
    """One change of a file: the first changed line before and after, and the whole changed text."""

    file: str
    number: int
    before: str
    after: str
    code: str


class Positions(Visitor):
    """The positions at which an operator can change a file, in Cosmic Ray's order."""

    def __init__(self, operator: Any) -> None:
        self.operator, self.found = operator, []

    def visit(self, node: Any) -> Any:
        self.found += [start for start, _ in self.operator.mutation_positions(node)]
        return node


def annotations(tree: ast.AST) -> list[ast.AST]:
    """Type annotations, whose changes no test needs to notice."""
    found: list[Any] = [getattr(node, name, None) for node in ast.walk(tree) for name in ("annotation", "returns")]
    return [node for node in found if node is not None]


def edits(text: str, tree: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Nodes and their replacements by our operators."""
    source = lambda node: ast.get_source_segment(text, node) or ""  # noqa: E731
    for node in ast.walk(tree):
        if isinstance(node, ast.Return) and node.value is not None and source(node.value) != "None":
            yield node.value, "None"
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield node, "None"
        elif isinstance(node, ast.Call) and swaps(node, source(node.func)):
            first, second = map(source, node.args[:2])
            whole, start = source(node), source(node.func)
            rest = whole[len(start) :].replace(first, "\0", 1).replace(second, first, 1).replace("\0", second, 1)
            if first != second:
                yield node, start + rest


def swaps(call: ast.Call, function: str) -> bool:
    """Whether a call has two arguments whose order may matter."""
    two = call.args[:2]
    return len(two) == 2 and not any(isinstance(a, ast.Starred) for a in two) and function.split(".")[-1] not in SYMMETRIC


def mutants(name: str, text: str) -> list[Mutant]:
    """Every distinct mutant of a file that differs from the original."""
    tree, lines = ast.parse(text), text.splitlines()
    typed = {(n, c) for node in annotations(tree) for n, c in spots(node)}
    codes: list[str] = []
    for operator_name in OPERATORS:
        operator = get_operator(operator_name)()
        positions = Positions(operator)
        positions.walk(get_ast(text))
        wanted = [
            i for i, (n, c) in enumerate(positions.found) if (n, c) not in typed and not lines[n - 1][c:].startswith("*,")
        ]
        codes += [mutate_code(text, operator, i) or text for i in wanted]
    offsets = [0, *(len(line) + 1 for line in lines)]
    begin = lambda n, c: sum(offsets[:n]) + c  # noqa: E731
    for node, new in edits(text, tree):
        start, end = begin(node.lineno, node.col_offset), begin(node.end_lineno, node.end_col_offset)
        codes.append(text[:start] + new + text[end:])
    made = []
    for code in dict.fromkeys(codes):
        changed = code.splitlines()
        number = next((i for i, (a, b) in enumerate(zip(lines, changed, strict=False)) if a != b), None)
        if number is not None and parses(code):
            made.append(Mutant(name, number + 1, lines[number].strip(), changed[number].strip(), code))
    return made


def spots(node: Any) -> Iterator[tuple[int, int]]:
    """The positions (line, column) that a node covers."""
    for line in range(node.lineno, node.end_lineno + 1):
        first = node.col_offset if line == node.lineno else 0
        last = node.end_col_offset if line == node.end_lineno else 200
        yield from ((line, column) for column in range(first, last))


def parses(code: str) -> bool:
    try:
        ast.parse(code)
    except SyntaxError:
        return False
    return True


class Alarm:
    """Ends the process if a test takes too long, even in compiled code. How busy the machine is makes no difference."""

    def pytest_runtest_logstart(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, LONGEST)


def killed(copy: Path, tests: list[str], limit: float) -> tuple[bool, float]:
    """Whether a test fails or the limit of processor time is exceeded, and the processor time that the tests took."""
    began, child = time.monotonic(), os.fork()
    if child == 0:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 1))
        quiet = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(quiet, stream)
        sys.path[:0] = [str(copy)]
        os.environ["PYTHONPATH"] = str(copy)
        import pytest

        code = 1
        words = "-x -q -n 0 -p no:cacheprovider --durations 0 -W ignore::pytest.PytestAssertRewriteWarning"
        try:
            code = int(pytest.main([*words.split(), *tests], plugins=[Alarm()]))
        finally:
            os._exit(code)
    while time.monotonic() - began < PATIENCE * limit:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            return status != 0, used.ru_utime + used.ru_stime
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True, limit


def main() -> int:
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    known = {(e["file"], e["to"]) for e in table["equivalent"]}
    wider = {"settings": table["settings"]}
    guards = {name: [test for word in words for test in wider.get(word, [word])] for name, words in table["guards"].items()}
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", help=f"from src/pcil without .py: {', '.join(guards)}; a folder means its files")
    parser.add_argument("--number", "-n", type=int, help="number of mutants, drawn at random; by default all of them")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--skip", type=int, default=0, help="skip this number of mutants at the start, to continue a campaign")
    options = parser.parse_args()
    called = {name: {name, *name.split("/")} for name in guards}
    chosen = [name for name in guards if not options.files or called[name] & set(options.files)]
    if missing := [name for name in options.files if not any(name in names for names in called.values())]:
        parser.error(f"no tests guard {', '.join(missing)}; the files are {', '.join(guards)}")
    os.chdir(ROOT)
    os.environ.setdefault("MUJOCO_GL", "disabled")
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # a changed program is compiled again
    for heavy in HEAVY:
        importlib.import_module(heavy)

    texts = {name: (ROOT / "src/pcil" / f"{name}.py").read_text() for name in chosen}
    every = [mutant for name, text in texts.items() for mutant in mutants(name, text)]
    if options.number and options.number < len(every):
        every = sorted(
            random.Random(options.seed).sample(every, options.number), key=lambda m: (chosen.index(m.file), m.number)
        )
    every, survivors = every[options.skip :], list[Mutant]()
    sys.dont_write_bytecode = True
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        shutil.copytree(ROOT / "src/pcil", copy / "pcil", ignore=shutil.ignore_patterns("__pycache__"))
        for name in chosen:
            own = [mutant for mutant in every if mutant.file == name]
            failed, seconds = killed(copy, guards[name], 600)
            if failed:
                print(f"The tests that guard {name} fail as it is: {' '.join(guards[name])}")
                return 2
            path, left, began = copy / "pcil" / f"{name}.py", len(survivors), time.monotonic()
            for done, mutant in enumerate(own):
                if done % 10 == 0:
                    print(f"{name}: {done} of {len(own)} after {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
                path.write_text(mutant.code)
                if not killed(copy, guards[name], 20 + 3 * seconds)[0]:
                    survivors.append(mutant)
                    note = " (known to make no difference)" if (name, mutant.after) in known else ""
                    print(f"{name}.py:{mutant.number} survived{note}\n  - {mutant.before}\n  + {mutant.after}", flush=True)
            path.write_text(texts[name])
            alike = sum((m.file, m.after) in known for m in survivors[left:])
            dead, real = len(own) - len(survivors) + left, len(own) - alike
            print(f"{name}: {dead} of {real} killed, {alike} more make no difference", flush=True)
    new = [m for m in survivors if (m.file, m.after) not in known]
    real = len(every) - len(survivors) + len(new)
    print(f"In all {real - len(new)} of {real} killed ({(real - len(new)) / max(real, 1):.1%})")
    return 1 if new else 0


if __name__ == "__main__":
    sys.exit(main())
