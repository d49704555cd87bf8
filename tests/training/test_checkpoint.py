"""Checkpoints: the restored state is the saved one, or that of the previous checkpoint, and nothing else."""

from __future__ import annotations

import errno
import json
import shutil
import signal
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil.errors import InputError
from pcil.nets.networks import MLP
from pcil.training import checkpoint


class Learned(eqx.Module):
    """A stand-in for a learner: networks, optimiser state, key data, a counter on the device, and settings (not arrays)."""

    network: MLP
    opt_state: dict[str, Any]
    root: jax.Array
    count: jax.Array
    rate: float
    name: str


def make_learned(seed: int) -> Learned:
    network = MLP.init((3, 4, 2), key=jax.random.key(seed))
    opt_state = {"mean": (jnp.arange(3.0) + seed, None), "a/b c": jnp.array([True, False])}
    root = jax.random.key_data(jax.random.key(seed))
    return Learned(network, opt_state, root, jnp.int32(17 + seed), 0.5 * seed, f"name {seed}")


def make_arrays(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    replay = {"replay.obs": rng.normal(size=(40, 3)).astype(np.float32), "replay.next": np.array(seed), "wide": rng.random(5)}
    return checkpoint.flatten("learner", make_learned(seed)) | replay


def same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    """Equal names, types, shapes and bits."""
    return set(first) == set(second) and all(
        first[name].dtype == second[name].dtype and np.array_equal(first[name], second[name]) for name in first
    )


COUNTERS = {"counters": {"frames": 20, "seconds": 1.25}, "positions": {"eval.csv": 7}}


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two checkpoints, at 10 and at 20 frames."""
    folder = tmp_path_factory.mktemp("checkpoints")
    checkpoint.save(folder, 10, make_arrays(10), {"frames": 10})
    checkpoint.save(folder, 20, make_arrays(20), COUNTERS)
    return folder


@pytest.fixture
def folder(two: Path, tmp_path: Path) -> Path:
    """A copy of the two checkpoints that a test may damage."""
    return Path(shutil.copytree(two, tmp_path / "checkpoint"))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def is_one_sentence_about(complaint: str, path: Path) -> bool:
    return complaint.startswith(f"The checkpoint {path} is damaged") and complaint.endswith(".") and "\n" not in complaint


# --- Saving and restoring ---


def test_what_is_restored_is_what_was_saved(folder: Path) -> None:
    arrays, counters, complaints = checkpoint.restore(folder)
    assert same(arrays, make_arrays(20))
    assert counters == COUNTERS
    assert complaints == []
    assert all(isinstance(array, np.ndarray) for array in arrays.values())


def test_a_tree_comes_back_leaf_by_leaf_and_keeps_what_is_no_array(folder: Path) -> None:
    arrays, _, _ = checkpoint.restore(folder)
    like, saved = make_learned(3), make_learned(20)
    restored = checkpoint.unflatten("learner", like, arrays)
    assert jax.tree.structure(restored) == jax.tree.structure(like)
    leaves, expected = jax.tree.leaves(eqx.filter(restored, eqx.is_array)), jax.tree.leaves(eqx.filter(saved, eqx.is_array))
    assert len(leaves) == 4 + 2 + 2
    for a, b in zip(leaves, expected, strict=True):
        assert isinstance(a, jax.Array) and a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert (restored.rate, restored.name) == (1.5, "name 3")  # settings come from the run, not from the checkpoint
    draw = jax.random.normal(jax.random.wrap_key_data(restored.root))
    assert float(draw) == float(jax.random.normal(jax.random.key(20)))


def test_two_trees_under_two_names_do_not_mix() -> None:
    arrays = checkpoint.flatten("first", make_learned(1)) | checkpoint.flatten("second", make_learned(2))
    for name, seed in (("first", 1), ("second", 2)):
        restored = checkpoint.unflatten(name, make_learned(0), arrays)
        assert int(restored.count) == 17 + seed


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a | {"learner.count": np.zeros(2, np.int32)},
        lambda a: a | {"learner.count": np.array(3, np.int64)},
        lambda a: a | {"learner.network.weights[0]": np.zeros((4, 3), np.float32)},
        lambda a: {name: array for name, array in a.items() if name != "learner.root"},
    ],
    ids=["shape", "dtype", "transposed", "missing"],
)
def test_arrays_of_another_network_are_refused(change: Callable) -> None:
    with pytest.raises(ValueError, match="learner"):
        checkpoint.unflatten("learner", make_learned(0), change(checkpoint.flatten("learner", make_learned(0))))


def test_the_two_newest_are_kept(folder: Path) -> None:
    for frames in (100, 30):
        checkpoint.save(folder, frames, {"x": np.array([frames])}, {})
        assert len(names(folder)) == 2
    checkpoint.save(folder, 30, {"x": np.array([31])}, {"again": True})
    arrays, counters, _ = checkpoint.restore(folder)
    assert (int(arrays["x"][0]), counters) == (31, {"again": True})


def test_newest_is_by_number_and_not_by_letter(folder: Path) -> None:
    checkpoint.save(folder, 100, {"x": np.array([100])}, {"frames": 100})
    assert names(folder) == {"20", "100"}
    assert checkpoint.restore(folder)[1] == {"frames": 100}


def test_the_first_save_makes_the_folder(tmp_path: Path) -> None:
    checkpoint.save(tmp_path / "a" / "b", 1, make_arrays(1), {})
    assert same(checkpoint.restore(tmp_path / "a" / "b")[0], make_arrays(1))


def test_where_there_is_none_nothing_is_restored(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "other" / "notes").mkdir(parents=True)
    for name in ("missing", "empty", "other"):
        assert checkpoint.restore(tmp_path / name) == (None, {}, [])


# --- Damage ---


def written_by_orbax(folder: Path, arrays: dict[str, np.ndarray], counters: dict[str, Any]) -> None:
    """A checkpoint in the format before version 0.2."""
    ocp = pytest.importorskip("orbax.checkpoint")
    ocp.PyTreeCheckpointer().save((folder / "arrays").absolute(), arrays)
    files = {str(p.relative_to(folder / "arrays")): zlib.crc32(p.read_bytes()) for p in folder.rglob("*") if p.is_file()}
    text = json.dumps({"counters": counters, "files": files})
    (folder / "meta.json").write_text(f"{zlib.crc32(text.encode())}\n{text}\n")


def test_checkpoints_of_orbax_are_read_and_their_damage_found(folder: Path) -> None:
    written_by_orbax(folder / "30", make_arrays(30), COUNTERS)
    arrays, counters, complaints = checkpoint.restore(folder)
    assert same(arrays, make_arrays(30)) and counters == COUNTERS and complaints == []
    for file in sorted(path for path in (folder / "30" / "arrays").rglob("*") if path.is_file()):
        whole = file.read_bytes()
        file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        arrays, counters, complaints = checkpoint.restore(folder)
        assert len(complaints) == 1 and is_one_sentence_about(complaints[0], folder / "30")
        assert same(arrays, make_arrays(20)) and counters == COUNTERS
        file.write_bytes(whole)
    checkpoint.save(folder, 40, make_arrays(40), {"frames": 40})
    assert same(checkpoint.restore(folder)[0], make_arrays(40))


def test_without_orbax_its_checkpoints_are_refused_with_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written_by_orbax(folder / "30", make_arrays(30), COUNTERS)
    monkeypatch.setitem(sys.modules, "orbax.checkpoint", None)
    with pytest.raises(InputError, match="needs Orbax; pip install orbax-checkpoint"):
        checkpoint.restore(folder)


@pytest.mark.parametrize("name", ["meta.json", "arrays.safetensors"])
def test_every_flipped_bit_is_noticed(folder: Path, name: str) -> None:
    """At 60 places of the file, except the last byte of meta.json, an irrelevant line break."""
    file = folder / "20" / name
    whole = file.read_bytes()
    for at in np.linspace(0, len(whole) - 2, 60).astype(int):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << (at % 8)
        file.write_bytes(damaged)
        arrays, counters, complaints = checkpoint.restore(folder)
        assert len(complaints) == 1 and is_one_sentence_about(complaints[0], folder / "20")
        assert same(arrays, make_arrays(10)) and counters == {"frames": 10}


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="this system has no limit on the size of a file")
def test_a_limit_on_the_size_of_files_is_an_error_of_the_system(folder: Path) -> None:
    """As with a full disk, although the library that writes raises its own error."""
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OSError) as error:
            checkpoint.save(folder, 30, make_arrays(30), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert error.value.errno == errno.EFBIG and str(error.value.filename).endswith("arrays.safetensors")
    assert same(checkpoint.restore(folder)[0], make_arrays(20))


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def emptied(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "no meta.json": lambda path: (path / "meta.json").unlink(),
    "half of meta.json": lambda path: cut(path / "meta.json", 0.5),
    "nothing in meta.json": lambda path: cut(path / "meta.json", 0),
    "the meta.json of another": lambda path: shutil.copy(path.parent / "10" / "meta.json", path / "meta.json"),
    "another digit in meta.json": lambda path: (path / "meta.json").write_text(
        (path / "meta.json").read_text().replace('"frames": 20', '"frames": 21')
    ),
    "no arrays": lambda path: (path / "arrays.safetensors").unlink(),
    "nothing in arrays": lambda path: cut(path / "arrays.safetensors", 0),
    "the arrays of another": lambda path: shutil.copy(path.parent / "10" / "arrays.safetensors", path / "arrays.safetensors"),
    "half of the arrays": lambda path: cut(path / "arrays.safetensors", 0.5),
    "a folder named arrays": lambda path: (path / "arrays").mkdir(),
    "nothing at all": emptied,
    "a file in its place": lambda path: (shutil.rmtree(path), path.write_text("x")),
}


REASONS = {
    "no arrays": "arrays.safetensors is missing)",
    "half of the arrays": "arrays.safetensors is not what was written)",
    "no meta.json": "FileNotFoundError: ",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_gives_way_to_the_one_before_and_one_sentence(folder: Path, damage: str) -> None:
    DAMAGES[damage](folder / "20")
    arrays, counters, complaints = checkpoint.restore(folder)
    assert same(arrays, make_arrays(10))
    assert counters == {"frames": 10}
    assert len(complaints) == 1 and is_one_sentence_about(complaints[0], folder / "20")
    assert REASONS.get(damage, "") in complaints[0]


def test_where_all_are_damaged_there_is_a_sentence_for_each_and_no_state(folder: Path) -> None:
    for name in ("10", "20"):
        (folder / name / "meta.json").unlink()
    arrays, counters, complaints = checkpoint.restore(folder)
    assert (arrays, counters) == (None, {})
    assert [is_one_sentence_about(c, folder / n) for c, n in zip(complaints, ("20", "10"), strict=True)] == [True, True]


@pytest.mark.parametrize("frames", [5, 15, 25])
def test_after_damage_the_next_save_is_the_one_restored(folder: Path, frames: int) -> None:
    """A run that resumed earlier, or started again, has fewer frames than the damaged ones, which must not displace its own."""
    for name in ("10", "20"):
        (folder / name / "meta.json").unlink()
    checkpoint.save(folder, frames, make_arrays(frames), {"frames": frames})
    arrays, counters, _ = checkpoint.restore(folder)
    assert arrays is not None
    assert same(arrays, make_arrays(frames)) and counters == {"frames": frames}


# --- Killed processes ---


def test_what_a_killed_save_left_is_ignored_and_the_next_save_removes_it(folder: Path) -> None:
    for frames in (30, 40):
        shutil.copytree(folder / "20", folder / f"partial-{frames}")
        (folder / f"partial-{frames}" / "meta.json").unlink()
    arrays, counters, complaints = checkpoint.restore(folder)
    assert same(arrays, make_arrays(20)) and counters == COUNTERS and complaints == []
    checkpoint.save(folder, 30, make_arrays(30), {"frames": 30})
    assert checkpoint.restore(folder)[1:] == ({"frames": 30}, [])
    assert names(folder) == {"20", "30"}


@pytest.mark.parametrize("frames", [20, 30])
def test_a_save_that_fails_leaves_the_others_as_they_were(folder: Path, frames: int) -> None:
    with pytest.raises(TypeError):
        checkpoint.save(folder, frames, make_arrays(30), {"not json": object()})
    arrays, counters, complaints = checkpoint.restore(folder)
    assert same(arrays, make_arrays(20)) and counters == COUNTERS and complaints == []
