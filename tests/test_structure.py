"""Rules for the whole source: imports between packages, the length of files, and words that must not appear in them."""

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
from pcil.rewards import REWARDS
from pcil.training import presets

PACKAGE = Path(pcil.__file__).parent
ROOT = Path(__file__).parent.parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
LONGEST = 350
LAYERS = [
    "errors types seeds files modules compilation card",
    "nets",
    "envs demos policy rewards agents export",
    "training",
    "report theory bench",
    "sweep cli",
]
"""A package, or a file beside the packages, imports only from its own layer and from earlier layers in this list."""
LAYER = {room: depth for depth, rooms in enumerate(LAYERS) for room in rooms.split()}
ROLLING_OUT = {"representation", "film"}
"""The modules of `report` that load JAX and play episodes."""
LOADERS = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
"""Modules that may run code from a file that they read."""


def room(path: Path) -> str:
    """The package that a file is in, or the file's own name if it is beside the packages."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def name(path: Path) -> str:
    """The full name of a file as a module."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def imported(path: Path) -> Iterator[str]:
    """Full names of everything that a file imports, at the top and inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rooms_imported(path: Path) -> set[str]:
    """The packages that a file imports from."""
    return {word.split(".")[1] for word in imported(path) if word.startswith("pcil.")}


INSIDE = [path for path in SOURCES if room(path) not in ("__init__", "__main__")]


def test_every_room_has_its_layer() -> None:
    assert set(LAYER) == {room(path) for path in INSIDE}


@pytest.mark.parametrize("path", INSIDE, ids=name)
def test_imports_go_one_way(path: Path) -> None:
    assert rooms_imported(path) <= {other for other, depth in LAYER.items() if depth <= LAYER[room(path)]}


def test_no_files_import_each_other_in_a_circle() -> None:
    modules = {name(path): path for path in INSIDE}
    graph = {
        own: {found for word in imported(path) if (found := word if word in modules else word.rpartition(".")[0]) in modules}
        for own, path in modules.items()
    }
    order = list(graphlib.TopologicalSorter({own: others - {own} for own, others in graph.items()}).static_order())
    assert order.index("pcil.errors") < order.index("pcil.types") < order.index("pcil.training.loop")


def test_agents_and_rewards_know_nothing_of_each_other() -> None:
    found = {own: set().union(*(rooms_imported(path) for path in INSIDE if room(path) == own)) for own in LAYER}
    assert "rewards" not in found["agents"] and "agents" not in found["rewards"]


def test_the_report_imports_no_jax() -> None:
    """In a new process, so that indirect imports count too. From the package it imports only the error, the
    readers of files and the theory."""
    static = [path for path in SOURCES if room(path) == "report" and path.stem not in ROLLING_OUT]
    code = f"import sys, {', '.join(map(name, static))}; print(*sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "pcil.report.page" in loaded and not {"jax", "equinox", "gymnasium", "mujoco", "sklearn"} & set(loaded)
    assert set().union(*map(rooms_imported, static)) <= {"report", "errors", "files", "theory"}
    lazily = {word for path in static for word in imported(path)}
    assert not any(re.match(r"(jax|equinox|optax)\b", word) for word in lazily)


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
        assert getattr(pcil, name).__doc__, f"pcil.{name} has a docstring"
    assert set(pcil.__all__) <= set(dir(pcil))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = pcil.nothing


TEXT = {tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
"""Kinds of tokens that hold the text of strings; since Python 3.12 an f-string is several tokens."""


def code_words(path: Path) -> Iterator[tuple[int, str]]:
    """Line and word of identifiers and strings, without comments, docstrings and the package's own name in imports."""
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


GENERAL = [PACKAGE / f"training/{file}.py" for file in ("loop", "state", "learner", "evaluate")]
GENERAL += [PACKAGE / f"agents/{file}.py" for file in ("base", "drqv2")]


@pytest.mark.parametrize("path", GENERAL, ids=lambda path: path.stem)
def test_the_loop_and_the_agents_name_no_method(path: Path) -> None:
    """No string contains the name of a method, and no identifier is the name of a method or of a reward's class.

    The only exception is the identifier `expert`, which is the batch of expert steps that every method is given.
    """
    methods = set(presets.METHODS)
    classes = {kind.__name__.lower() for kind in REWARDS.values()}
    forbidden = {f"string {method}" for method in methods} | (methods | classes) - {"expert"}
    assert [(line, word) for line, word in code_words(path) if word in forbidden] == []


def test_the_search_for_names_finds_them(tmp_path: Path) -> None:
    """The search used by the test above finds such names."""
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
