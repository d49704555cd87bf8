"""Kill small runs of every method, damage the files that they left, resume them, and compare: `make kills N=100`.

A trial starts a run, may end it at a random moment by SIGKILL or by a limit on the size of its files, may damage its
folder, does so once or twice more, and lets the run finish. Logs, policy, learned arrays and TensorBoard's points
must then equal those of an uninterrupted run, bit for bit. The results are in `docs/reliability.md`.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

LOGS = ("eval.csv", "train.jsonl")
ROOM = (2_000, 20_000, 60_000)
"""Limits on the size of a file in bytes, from a few rows of a log to less than a checkpoint."""
Fault = Callable[[Path, random.Random], None]


def shortened(path: Path, rng: random.Random) -> None:
    path.write_bytes(path.read_bytes()[: rng.randrange(path.stat().st_size + 1)])


def emptied(path: Path, rng: random.Random) -> None:
    path.write_bytes(b"")


def deleted(path: Path, rng: random.Random) -> None:
    path.unlink()


def flipped(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    if content:
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def longer(path: Path, rng: random.Random) -> None:
    path.write_bytes(path.read_bytes() + rng.randbytes(rng.randrange(1, 200)))


DAMAGE = (shortened, emptied, deleted, flipped, longer)


def files_of(folder: Path) -> dict[str, list[Path]]:
    """The files that a fault may affect, by kind. `run.json` is excluded, because without it a run can't be resumed."""
    checkpoints = sorted((p for p in (folder / "checkpoint").glob("*") if p.name.isdigit()), key=lambda path: int(path.name))
    kinds = {
        "log": [folder / name for name in LOGS],
        "policy": list((folder / "policy").glob("*")),
        "newest checkpoint": list(checkpoints[-1].glob("*")) if len(checkpoints) > 1 else [],
        # TensorBoard's files of a finished run are never read again
        "TensorBoard": [] if (folder / "DONE").exists() else list((folder / "tensorboard").glob("*")),
        "unfinished checkpoint": [path for path in (folder / "checkpoint").glob("partial-*/*") if path.is_file()],
    }
    return {kind: present for kind, paths in kinds.items() if (present := [path for path in paths if path.exists()])}


def damage(folder: Path, rng: random.Random) -> str:
    """Damage one file of the folder, or write DONE too early; returns a description."""
    kinds = files_of(folder)
    if not kinds or rng.random() < 0.3:
        return "no damage"
    if rng.random() < 0.1 and not (folder / "DONE").exists() and "newest checkpoint" in kinds:
        (folder / "DONE").write_text('{"final_return": 1.0}\n')
        return "an early DONE"
    kind = rng.choice(sorted(kinds))
    path, harm = rng.choice(sorted(kinds[kind])), rng.choice(DAMAGE)
    harm(path, rng)
    return f"{kind} {harm.__name__}"


def session(method: str, demos: str, folder: Path, every: float, room: int | None = None) -> int:
    """Start or resume the run in a separate process; returns the process id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        with open(folder.with_suffix(".said"), "a") as said:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
        from pcil.errors import InputError
        from pcil.training import runs
        from small import small_run

        if room:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
        try:
            runs.execute(small_run(method, demos=demos, checkpoint_seconds=every), folder)
            code = 0
        except InputError as error:
            print(f"pcil: {error}", flush=True)
            code = error.exit_code
    finally:
        os._exit(code)


def waited(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def trial(method: str, demos: str, folder: Path, seconds: float, rng: random.Random) -> list[str]:
    """One run with faults, whose descriptions are returned; if it does not finish, the last one says why."""
    told = []
    for _ in range(rng.randint(1, 3)):
        every = rng.choice((0.0, 0.0, 0.2, 60.0))
        if rng.random() < 0.2:
            room = rng.choice(ROOM)
            told.append(f"files of at most {room:,} bytes (exit {waited(session(method, demos, folder, every, room))})")
        else:
            child = session(method, demos, folder, every)
            time.sleep(rng.uniform(0.2, 1.1) * seconds)
            os.kill(child, signal.SIGKILL)
            told.append("killed" if waited(child) == -signal.SIGKILL else "finished")
        told.append(damage(folder, rng))
    if code := waited(session(method, demos, folder, 60.0)):
        told.append(f"did not finish: exit {code}")
    return told


def differences(whole: Path, folder: Path) -> Iterator[str]:
    """The differences between an uninterrupted run and another one, ignoring wall-clock times."""
    import numpy as np
    from test_loop import rows
    from test_metrics import points

    from pcil.training import checkpoint

    if rows(whole) != rows(folder):
        yield "logs"
    for name in ("policy/policy.safetensors", "policy/policy.json", "DONE"):
        if not (folder / name).exists() or (whole / name).read_bytes() != (folder / name).read_bytes():
            yield name
    one, two = (checkpoint.restore(place / "checkpoint")[0] or {} for place in (whole, folder))
    if one.keys() != two.keys() or any(not np.array_equal(one[name], two[name]) for name in one):
        yield "what was learned"
    clocked = ("episode/seconds", "episode/frames_per_second")
    drawn = [sorted(point[:3] for point in points(place) if point[0] not in clocked) for place in (whole, folder)]
    if drawn[0] != drawn[1]:
        yield "TensorBoard's points"


def main() -> int:
    sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent / "training")]
    from pcil.training import presets

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("methods", nargs="*", help=f"by default all: {', '.join(presets.METHODS)}")
    parser.add_argument("--number", "-n", type=int, default=20, help="of trials, over all methods")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if unknown := set(options.methods) - set(presets.METHODS):
        parser.error(f"there is no method {', '.join(sorted(unknown))}")
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    for heavy in ("jax", "equinox", "optax", "gymnasium", "minari", "safetensors.numpy", "pytest", "pcil.training.runs"):
        importlib.import_module(heavy)  # so that the children need not; JAX's devices start in the child
    rng, methods = random.Random(options.seed), options.methods or list(presets.METHODS)
    kinds: collections.Counter[str] = collections.Counter()
    wrong = 0
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(place / "cache")
        demos = str(place / "point_mass-v0")
        if not (child := os.fork()):
            from small import save_point_mass_demos

            save_point_mass_demos(place)
            os._exit(0)
        waited(child)
        took: dict[str, float] = {}
        for method in methods:
            for _ in range(2):  # the first one compiles
                shutil.rmtree(place / method, ignore_errors=True)
                began = time.monotonic()
                if waited(session(method, demos, place / method, 60.0)):
                    print(place.joinpath(f"{method}.said").read_text())
                    return 2
                took[method] = time.monotonic() - began
        for number in range(options.number):
            method = methods[number % len(methods)]
            folder = place / f"{method}-{number}"
            told = trial(method, demos, folder, took[method], rng)
            found = [] if told[-1].startswith("did not") else list(differences(place / method, folder))
            if found or told[-1].startswith("did not") or "Traceback" in folder.with_suffix(".said").read_text():
                wrong += 1
                print(f"{method}, trial {number}: {'; '.join(told)}: {', '.join(found)}")
                print(folder.with_suffix(".said").read_text(), flush=True)
            kinds.update(word.partition(" (")[0] for word in told)
            shutil.rmtree(folder)
            if number % 10 == 9:
                print(f"{number + 1} of {options.number} trials", file=sys.stderr, flush=True)
    for word, count in sorted(kinds.items()):
        print(f"{count:6} {word}")
    print(f"{options.number - wrong} of {options.number} runs ended like uninterrupted ones.")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
