"""Mutate everything that a command reads, and report inputs that it does not handle cleanly: `make fuzz N=2000`.

A dataset, a policy, a run folder, a sweep's TOML file and the arguments of every command are changed at random: bits and
bytes, values in JSON, TOML and CSV, and the objects of HDF5. A command then runs on each in a separate process. It must end
within 20 seconds, with exit code 0, 1 or 2, no traceback, one line on standard error if it refuses, and at most 1 GiB of
memory more than without the change. The results are in `docs/reliability.md`.
"""

from __future__ import annotations

import argparse
import collections
import copy
import importlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

SECONDS, MEMORY = 20.0, 2**30
NARROW = "--agent.hidden 16 --agent.batch-size 32 --agent.feature-dim 8"
TRAIN = f"train toy/point_mass-v0 --frames 60 --random-frames 50 --seed-frames 50 --evaluate-episodes 1 {NARROW}"
VALUES: list[Any] = [
    None, True, -1, 0, 2**63, 10**350, 1e308, -1e-320, float("nan"), float("inf"), "", "x" * 100_000, "\x1b[2J", "\ud800",
    "../../x", "no_such_module:Class", "$\\frac{", "=1+1", "<script>", [], {}, [[]], {"a": {"b": 1}},
]  # fmt: skip
DEEP = "[" * 100_000 + "]" * 100_000
WORDS = [
    "",
    "-1",
    "0",
    "nan",
    "inf",
    "1e400",
    "9" * 400,
    "x" * 5000,
    "\x1b[31m",
    "\udcff",
    "~nobody/x",
    "/dev/zero",
    "a:b",
    "=",
    "{",
    DEEP,
]


# --- Changes of a file ---


def bytes_changed(path: Path, rng: random.Random) -> str:
    """Flip bits, remove, repeat or overwrite a part, or append noise."""
    content = bytearray(path.read_bytes())
    at, size = rng.randrange(len(content) + 1), rng.choice((1, 4, 64, 1024))
    kind = rng.choice(("flip", "overwrite", "cut", "double", "end", "append"))
    if kind == "flip" and content:
        for _ in range(rng.choice((1, 1, 8))):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif kind == "overwrite":
        content[at : at + size] = rng.choice((b"\0", b"\xff", b"\x7f", b"9", b"[")) * size
    elif kind == "cut":
        del content[at : at + size]
    elif kind == "double":
        content[at:at] = content[at : at + size]
    elif kind == "end":
        del content[at:]
    else:
        content += rng.randbytes(size)
    path.write_bytes(content)
    return kind


def json_changed(path: Path, rng: random.Random) -> str:
    """Replace or remove one value anywhere in the file, or replace the whole content by one value."""
    lines = path.read_text().splitlines()
    number = rng.randrange(len(lines)) if path.suffix == ".jsonl" else 0
    top = {"": json.loads(lines[number] if path.suffix == ".jsonl" else path.read_text())}
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            walk(node[key])

    walk(top)
    node, key = rng.choice(places)
    if rng.random() < 0.15 and key != "":
        del node[key]
    else:
        node[key] = copy.deepcopy(rng.choice(VALUES))
    text = json.dumps(top[""])
    if rng.random() < 0.05:
        text = rng.choice((DEEP, '{"a": ' * 100_000, "1" * 10_000, "\ufeff" + text, text * 2))
    if path.suffix == ".jsonl":
        lines[number], text = text, ""
    path.write_text("\n".join(lines) + "\n" if path.suffix == ".jsonl" else text, errors="surrogatepass")
    return "value"


def table_changed(path: Path, rng: random.Random) -> str:
    """Replace one cell of a CSV file or one value of a TOML file."""
    lines = path.read_text().splitlines()
    number = rng.randrange(len(lines))
    value = str(rng.choice(VALUES))
    if path.suffix == ".toml":
        name = lines[number].partition("=")[0]
        text = rng.choice(
            (json.dumps(rng.choice(VALUES)), f"[{value}]", DEEP, f"{{ a = {rng.random()} }}", "1979-05-27", "0x" + "f" * 400)
        )
        lines[number] = f"{name} = {text}"
    else:
        cells = lines[number].split(",")
        cells[rng.randrange(len(cells))] = value
        lines[number] = ",".join(cells)
    path.write_bytes("\n".join(lines).encode(errors="surrogatepass"))
    return "cell"


def hdf5_changed(path: Path, rng: random.Random) -> str:
    """Change the type, shape or storage of one dataset of the file, turn it into a link, or change an attribute."""
    import h5py
    import numpy as np

    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name = rng.choice(names)
        values = np.asarray(file[name])
        kind = rng.choice(list(HDF5))
        parent = file[name].parent
        del file[name]
        HDF5[kind](parent, name.rpartition("/")[2], values, path)
    return kind


def _virtual(group: Any, name: str, values: Any, path: Path) -> None:
    import h5py

    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource(".", f"{group.name}/{name}", values.shape)
    group.create_virtual_dataset(name, layout)


def _bomb(group: Any, name: str, values: Any, path: Path) -> None:
    group.create_dataset(name, (10**10,), values.dtype, chunks=(10**6,), compression="gzip")


def _attribute(group: Any, name: str, values: Any, path: Path) -> None:
    group[name] = values
    for attribute in list(group.attrs):
        group.attrs[attribute] = "x" * 1000


def _linked(kind: str) -> Callable[..., None]:
    def link(group: Any, name: str, values: Any, path: Path) -> None:
        import h5py

        made = {"soft": h5py.SoftLink(f"{group.name}/{name}"), "external": h5py.ExternalLink(path.name, f"{group.name}/{name}")}
        group[name] = made[kind]

    return link


def _cast(dtype: str) -> Callable[..., None]:
    return lambda group, name, values, path: group.create_dataset(name, data=values.astype(dtype))


HDF5: dict[str, Callable[..., None]] = {
    "missing": lambda group, name, values, path: None,
    "a group": lambda group, name, values, path: group.create_group(name),
    "an attribute": _attribute,
    "a soft link": _linked("soft"),
    "an external link": _linked("external"),
    "virtual": _virtual,
    "external storage": lambda group, name, values, path: group.create_dataset(
        name, values.shape, values.dtype, external=[("/dev/zero", 0, max(values.nbytes, 1))]
    ),
    "a bomb": _bomb,
    "a scalar": lambda group, name, values, path: group.create_dataset(name, data=values.ravel()[0]),
    "one row less": lambda group, name, values, path: group.create_dataset(name, data=values[:-1]),
    "one rank more": lambda group, name, values, path: group.create_dataset(name, data=values[None]),
    "no width": lambda group, name, values, path: group.create_dataset(name, data=values[..., :0]),
    "NaN": lambda group, name, values, path: group.create_dataset(name, data=values * float("nan")),
    "complex": _cast("complex64"),
    "text": _cast("S8"),
    "int8": _cast("int8"),
    "bool": _cast("bool"),
    "float16": _cast("float16"),
}


# --- Inputs ---


class Input(NamedTuple):
    """A kind of input: the files that may be changed, the change, and the commands that read the input."""

    files: tuple[str, ...]
    changes: tuple[Callable[[Path, random.Random], str], ...]
    commands: tuple[str, ...]


READ_POLICY = ("evaluate run --episodes 1", "record run --episodes 1 --out new")
READ_RUN = ("report run --out new --no-rollouts", "report run --out new", f"{TRAIN} --method expert --out run", *READ_POLICY)
READ_DATA = (
    f"{TRAIN} --method bc --demos data --out new",
    f"{TRAIN} --method pcil --reward.hidden 16 --reward.batch-size 32 --demos data --out new",
)
INPUTS = {
    "dataset": Input(("data/data/main_data.hdf5",), (bytes_changed, hdf5_changed, hdf5_changed), READ_DATA),
    "dataset's metadata": Input(("data/data/metadata.json",), (bytes_changed, json_changed, json_changed), READ_DATA),
    "policy": Input(("run/policy/policy.safetensors", "run/policy/policy.json"), (bytes_changed,), READ_POLICY),
    "policy.json": Input(("run/policy/policy.json",), (json_changed,), READ_POLICY),
    "run.json": Input(("run/run.json", "run/DONE"), (bytes_changed, json_changed, json_changed), READ_RUN),
    "logs": Input(("run/eval.csv", "run/train.jsonl"), (bytes_changed, table_changed), READ_RUN),
    "results": Input(("results.csv",), (bytes_changed, table_changed, table_changed), ("report results.csv --out new",)),
    "sweep": Input(("sweep.toml",), (bytes_changed, table_changed, table_changed), ("sweep sweep.toml --out new",)),
}
COMMANDS = (TRAIN, *READ_POLICY, "report run --out new", "sweep sweep.toml --out new", "demos", "bench", "theory", "doctor")
ARGUMENTS = "arguments"


def arguments_changed(rng: random.Random) -> list[str]:
    """A command with one word replaced, or with an additional option, its own or another command's, that has an odd value."""
    words = rng.choice(COMMANDS).split()
    others = [word for command in COMMANDS for word in command.split() if word.startswith("--")]
    option = rng.choice(
        [*others, "--preset", "--seed", "--reward.temperature", "--agent.noise.final", "--env-kwargs", "--jobs", "--json=3"]
    )
    if rng.random() < 0.4 and len(words) > 1 and words[0] not in ("bench", "theory", "doctor"):
        words[rng.randrange(1, len(words))] = rng.choice(WORDS)
    else:
        words += [option, rng.choice(WORDS)]
    return [*words, "--no-such-option"] if rng.random() < 0.1 or words[0] in ("bench", "theory") else words


def prepare(place: Path) -> None:
    """Make the valid inputs that are changed later: a run, a dataset, a file of results and a sweep."""
    from pcil import cli
    from pcil.report.load import collect, write_rows
    from small import save_point_mass_demos

    assert cli.main(f"{TRAIN} --method expert --out {place / 'run'}".split()) == 0
    save_point_mass_demos(place)
    (place / "point_mass-v0").rename(place / "data")
    write_rows(place / "results.csv", collect([place / "run"], lambda settings: settings).rows)
    (place / "sweep.toml").write_text(
        'tasks = ["walker_walk"]\nmethods = ["bc", "pcil"]\nseeds = [1, 2]\nframes = 100\n\n[settings]\n"agent.gamma" = 0.9\n'
    )


class Outcome(NamedTuple):
    code: int
    seconds: float
    memory: int
    said: str


def refuse(*_: Any) -> None:
    """Replaces the start of a sweep."""
    from pcil.errors import InputError

    raise InputError("No run is started here; this sweep is good.")


def run(words: list[str], folder: Path, seconds: float = SECONDS) -> Outcome:
    """Run the command in a process forked from this one, with a time limit."""
    began, child = time.monotonic(), os.fork()
    if child == 0:
        code = 70
        try:
            os.setsid()
            os.chdir(folder)
            for stream, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(folder / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), stream)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            from pcil import cli
            from pcil.sweep import executors

            executors.Local.__init__ = refuse
            code = cli.main(words)
            sys.stdout.flush()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    while not (ended := os.wait4(child, os.WNOHANG))[0] and time.monotonic() - began < seconds:
        time.sleep(0.01)
    if not ended[0]:
        os.killpg(child, signal.SIGKILL)
        ended = os.wait4(child, 0)
    said = (folder / "stderr").read_text(errors="replace") if (folder / "stderr").exists() else ""
    return Outcome(os.waitstatus_to_exitcode(ended[1]), time.monotonic() - began, ended[2].ru_maxrss * 1024, said)


def complaint(outcome: Outcome, usual: int) -> str | None:
    """What is wrong with the way in which a command ended, or None."""
    if outcome.seconds >= SECONDS:
        return f"still running after {SECONDS:.0f} s"
    if outcome.code < 0:
        return f"ended by signal {-outcome.code}"
    if outcome.code not in (0, 1, 2) or "Traceback" in outcome.said:
        return "a traceback"
    if outcome.code and (outcome.said.count("\n") != 1 or not outcome.said.startswith("pcil: ") or len(outcome.said) > 2000):
        return "more or less than one sentence"
    if not outcome.said.replace("\n", "").isprintable():
        return "control characters"
    if outcome.memory > usual + MEMORY:
        return f"{outcome.memory / 2**30:.1f} GiB of memory"
    return None


def main() -> int:
    sys.path.insert(0, str(Path(__file__).parent))
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    kinds = [*INPUTS, ARGUMENTS]
    parser.add_argument("kinds", nargs="*", help=f"by default all: {', '.join(kinds)}")
    parser.add_argument("--number", "-n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a folder for the inputs that ended badly")
    options = parser.parse_args()
    if unknown := set(options.kinds) - set(kinds):
        parser.error(f"there is no kind {', '.join(sorted(unknown))}")
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    os.environ.setdefault("MUJOCO_GL", "disabled")
    for heavy in [
        "jax",
        "equinox",
        "optax",
        "gymnasium",
        "minari",
        "h5py",
        "matplotlib.pyplot",
        "sklearn",
        "jinja2",
        "pcil.training.runs",
        "pcil.report.page",
        "pcil.report.film",
    ]:
        importlib.import_module(heavy)  # so that the children need not; JAX's devices start in the child
    ended: collections.Counter[str] = collections.Counter()
    bad = 0
    with tempfile.TemporaryDirectory() as scratch:
        good, folder = Path(scratch) / "good", Path(scratch) / "changed"
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(Path(scratch) / "cache")
        os.environ["MINARI_DATASETS_PATH"] = str(Path(scratch) / "minari")
        good.mkdir()
        if not (child := os.fork()):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            prepare(good)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        usual: dict[str, int] = {}
        for number in range(options.number):
            rng = random.Random(f"{options.seed} {number}")
            kind = (options.kinds or kinds)[number % len(options.kinds or kinds)]
            shutil.rmtree(folder, ignore_errors=True)
            if kind == ARGUMENTS:
                words, change, before = arguments_changed(rng), "words", max(usual.values(), default=MEMORY)
                shutil.copytree(good, folder)
            else:
                source = INPUTS[kind]
                words = rng.choice(source.commands).split()
                if (name := " ".join(words)) not in usual:
                    shutil.copytree(good, folder)
                    whole = run(words, folder, 600.0)  # the first run compiles
                    usual[name] = whole.memory
                    if whole.code != (2 if words[0] == "sweep" else 0) or "Traceback" in whole.said:
                        print(f"pcil {name} fails on unchanged input:\n{whole.said}")
                        return 2
                    shutil.rmtree(folder)
                shutil.copytree(good, folder)
                file, before = rng.choice(source.files), usual[name]
                change = f"{file}, {rng.choice(source.changes)(folder / file, rng)}"
            outcome = run(words, folder)
            ended[f"exit {outcome.code}"] += 1
            if found := complaint(outcome, before):
                bad += 1
                print(f"{number}: {kind}, {change}: pcil {' '.join(words)[:200]!r}: {found}\n{outcome.said[-600:]}", flush=True)
                if options.keep:
                    shutil.copytree(folder, options.keep / str(number), dirs_exist_ok=True)
            if number % 100 == 99:
                print(f"{number + 1} of {options.number} inputs", file=sys.stderr, flush=True)
    print(", ".join(f"{count} with {word}" for word, count in sorted(ended.items())))
    print(f"{options.number - bad} of {options.number} inputs ended well.")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
