"""What holds for the source as a whole: who imports whom, how long files are, and what must not appear in them."""

from __future__ import annotations

import ast
import graphlib
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

import pcil
from pcil import presets
from pcil.rewards import REWARDS

PACKAGE = Path(pcil.__file__).parent
ROOT = Path(__file__).parent.parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
LONGEST = 350
LAYERS = [
    "errors types seeds files modules compilation",
    "losses transport optimiser networks noise theory hdf5",
    "envs arrays minari_files demos replay policy rewards agents",
    "config presets evaluate checkpoint metrics learner state loop fit runs progress",
    "representation film reporting",
    "bench doctor arguments plans worker executors cluster sweep sweeping cli",
]
"""A part imports from its own layer and those above it in this list; `report` stands aside, for `REPORTERS` alone."""
REPORTERS = {"plans", "cli", "representation", "film", "reporting"}
LAYER = {part: depth for depth, parts in enumerate(LAYERS) for part in parts.split()}
LOADERS = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
"""Modules that run code out of a file which they read."""


def part(path: Path) -> str:
    """The module or package directly below `pcil` that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> Iterator[str]:
    """Full names of all that a file imports, at its top and inside its functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def parts_imported(path: Path) -> set[str]:
    """The parts of the package that a file imports."""
    return {name.split(".")[1] for name in imported(path) if name.startswith("pcil.")}


PARTS = {part(path) for path in SOURCES} - {"__init__", "__main__", "report"}


def test_every_part_has_its_layer() -> None:
    assert set(LAYER) == PARTS


@pytest.mark.parametrize("path", [path for path in SOURCES if part(path) in LAYER], ids=lambda path: path.stem)
def test_imports_go_one_way(path: Path) -> None:
    allowed = {name for name, depth in LAYER.items() if depth <= LAYER[part(path)]}
    if part(path) in REPORTERS:
        allowed.add("report")
    assert parts_imported(path) <= allowed


def test_no_parts_import_each_other_in_a_circle() -> None:
    graph = {name: set() for name in LAYER}
    for path in SOURCES:
        if part(path) in LAYER:
            graph[part(path)] |= parts_imported(path) - {part(path), "report"}
    order = list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError
    assert set(order) == set(LAYER) and order.index("errors") < order.index("types") < order.index("loop") < order.index("cli")


def test_agents_and_rewards_know_nothing_of_each_other() -> None:
    found = {name: set().union(*(parts_imported(path) for path in SOURCES if part(path) == name)) for name in LAYER}
    assert "rewards" not in found["agents"] and "agents" not in found["rewards"]


def test_the_report_imports_no_jax() -> None:
    """In a fresh process, so that what its imports import counts too; it takes nothing of the package but the error, the
    readers of files and the theory."""
    names = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in SOURCES if part(path) == "report"]
    code = f"import sys, {', '.join(names)}; print(*sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "pcil.report.page" in loaded and not {"jax", "equinox", "gymnasium", "mujoco", "sklearn"} & set(loaded)
    assert set().union(*(parts_imported(path) for path in SOURCES if part(path) == "report")) == {
        "report",
        "errors",
        "files",
        "theory",
    }
    lazily = {name for path in SOURCES if part(path) == "report" for name in imported(path)}
    assert not any(re.match(r"(jax|equinox|optax)\b", name) for name in lazily)


@pytest.mark.parametrize(
    "code",
    [
        "from pcil.cli import main; assert main(['report', RESULTS, '--out', 'out']) == 0",
        "sys.path.insert(0, EXPERIMENTS); import results; assert results.main(['--check']) in (0, 1)",
    ],
)
def test_figures_and_tables_are_made_of_results_alone_without_jax(code: str) -> None:
    places = f"RESULTS, EXPERIMENTS = {str(ROOT / 'results' / 'pcil-200k.csv')!r}, {str(ROOT / 'experiments')!r}"
    none = "assert not {'jax', 'equinox', 'optax'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", f"import sys; {places}; {code}; {none}"], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: "/".join(path.relative_to(PACKAGE).parts))
def test_no_file_is_too_long(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= LONGEST


def test_public_names_are_those_that_load() -> None:
    assert set(pcil.__all__) == set(pcil._HOME) and sorted(pcil.__all__) == pcil.__all__
    for name in pcil.__all__:
        module, attribute = pcil._HOME[name]
        assert getattr(pcil, name) is getattr(sys.modules[module], attribute)
        assert getattr(pcil, name).__doc__, f"pcil.{name} says what it is"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = pcil.nothing


TEXT = {tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
"""Kinds of tokens that hold words of strings; from Python 3.12 on an f-string is several tokens."""


def code_words(path: Path) -> Iterator[tuple[int, str]]:
    """Line and word of identifiers and strings; comments, docstrings and the package's own name in imports are left out."""
    tree = ast.parse(path.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docs = {node.body[0].lineno for node in ast.walk(tree) if isinstance(node, documented) and ast.get_docstring(node)}
    fields = {node.lineno for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)}
    imports = {node.lineno for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)}
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        line = token.start[0]
        if token.type in TEXT and line not in docs | fields:
            yield from ((line, f"string {word}") for word in re.findall(r"[a-z]+", token.string.lower()))
        elif token.type == tokenize.NAME and not (token.string == "pcil" and line in imports):
            yield line, token.string.lower()


GENERAL = [PACKAGE / name for name in ("loop.py", "learner.py", "evaluate.py", "agents/base.py", "agents/drqv2.py")]


@pytest.mark.parametrize("path", GENERAL, ids=lambda path: path.stem)
def test_the_loop_and_the_agents_name_no_method(path: Path) -> None:
    """No method's name in a string; none, and no reward's class, as an identifier.

    `expert` alone may be an identifier: there it is the batch of expert steps, which every method is given.
    """
    methods = set(presets.METHODS)
    classes = {kind.__name__.lower() for kind in REWARDS.values()}
    forbidden = {f"string {method}" for method in methods} | (methods | classes) - {"expert"}
    assert [(line, word) for line, word in code_words(path) if word in forbidden] == []


def test_the_search_for_names_finds_them(tmp_path: Path) -> None:
    """The search of the test above is no empty one."""
    lines = [
        '"""pcil."""',
        "from pcil import loop",
        "def f(expert):  # dac",
        '    """pcil"""',
        '    return PCIL, f"a {expert} dac"',
    ]
    text = "\n".join([*lines, ""])
    (tmp_path / "sample.py").write_text(text)
    words = list(code_words(tmp_path / "sample.py"))
    assert (5, "pcil") in words and (5, "string dac") in words and (3, "expert") in words
    assert not any(word in ("pcil", "dac", "string pcil", "string dac") for line, word in words if line != 5)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: "/".join(path.relative_to(PACKAGE).parts))
def test_no_pickle_is_ever_read(path: Path) -> None:
    assert not {name.partition(".")[0] for name in imported(path)} & LOADERS
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    allowing = [keyword.arg for call in calls for keyword in call.keywords if keyword.arg == "allow_pickle"]
    running = [call.func.id for call in calls if isinstance(call.func, ast.Name) and call.func.id in ("eval", "exec")]
    assert allowing == running == []
