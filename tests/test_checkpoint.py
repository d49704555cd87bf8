"""Laws of checkpoints: what is restored is what was saved, or the checkpoint before it, and never anything else."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil import checkpoint
from pcil.networks import MLP


class Learned(eqx.Module):
    """A stand-in for a learner: networks, moments, key data, a counter on the device, and settings that are no arrays."""

    network: MLP
    moments: dict[str, Any]
    root: jax.Array
    count: jax.Array
    rate: float
    name: str


def make_learned(seed: int) -> Learned:
    network = MLP.init((3, 4, 2), key=jax.random.key(seed))
    moments = {"mean": (jnp.arange(3.0) + seed, None), "a/b c": jnp.array([True, False])}
    root = jax.random.key_data(jax.random.key(seed))
    return Learned(network, moments, root, jnp.int32(17 + seed), 0.5 * seed, f"name {seed}")


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
    """A copy of the two checkpoints that may be damaged."""
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
    assert (restored.rate, restored.name) == (1.5, "name 3")  # settings are the run's, not the checkpoint's
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


def test_where_there_is_none_nothing_is_restored(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "other" / "notes").mkdir(parents=True)
    for name in ("missing", "empty", "other"):
        assert checkpoint.restore(tmp_path / name) == (None, {}, [])


# --- Damage ---


def test_a_flipped_bit_is_noticed_or_does_not_matter(two: Path, folder: Path) -> None:
    """Some bits are Orbax's own notes: then the newest must come back exactly. A few places in each file there is."""
    refused = set()
    files = sorted(path for path in (folder / "20").rglob("*") if path.is_file())
    assert len(files) >= 5
    for file in files:
        whole = file.read_bytes()
        for at in {0, len(whole) // 3, len(whole) // 2, len(whole) - 1}:
            damaged = bytearray(whole)
            damaged[at] ^= 1 << (at % 8)
            file.write_bytes(damaged)
            arrays, counters, complaints = checkpoint.restore(folder)
            if complaints:
                assert len(complaints) == 1 and is_one_sentence_about(complaints[0], folder / "20")
                assert same(arrays, make_arrays(10)) and counters == {"frames": 10}
                refused.add(file.relative_to(folder / "20").parts[0])
            else:
                assert same(arrays, make_arrays(20)) and counters == COUNTERS
        file.write_bytes(whole)
    assert refused == {"meta.json", "arrays"}
    assert checkpoint.restore(folder)[2] == []


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def largest(folder: Path) -> Path:
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


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
    "no arrays": lambda path: shutil.rmtree(path / "arrays"),
    "nothing in arrays": lambda path: emptied(path / "arrays"),
    "the arrays of another": lambda path: (
        shutil.rmtree(path / "arrays"),
        shutil.copytree(path.parent / "10" / "arrays", path / "arrays"),
    ),
    "half of the data": lambda path: [cut(file, 0.5) for file in (path / "arrays" / "d").iterdir()],
    "no data": lambda path: shutil.rmtree(path / "arrays" / "d"),
    "no _METADATA": lambda path: (path / "arrays" / "_METADATA").unlink(),
    "nothing at all": emptied,
    "a file in its place": lambda path: (shutil.rmtree(path), path.write_text("x")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_gives_way_to_the_one_before_and_one_sentence(folder: Path, damage: str) -> None:
    DAMAGES[damage](folder / "20")
    arrays, counters, complaints = checkpoint.restore(folder)
    assert same(arrays, make_arrays(10))
    assert counters == {"frames": 10}
    assert len(complaints) == 1 and is_one_sentence_about(complaints[0], folder / "20")


def test_where_all_are_damaged_there_is_a_sentence_for_each_and_no_state(folder: Path) -> None:
    for name in ("10", "20"):
        (folder / name / "meta.json").unlink()
    arrays, counters, complaints = checkpoint.restore(folder)
    assert (arrays, counters) == (None, {})
    assert [is_one_sentence_about(c, folder / n) for c, n in zip(complaints, ("20", "10"), strict=True)] == [True, True]


@pytest.mark.parametrize("frames", [5, 15, 25])
def test_after_damage_the_next_save_is_the_one_restored(folder: Path, frames: int) -> None:
    """A run that fell back, or began again, is behind the damaged ones; they must not push its own checkpoints out."""
    for name in ("10", "20"):
        (folder / name / "meta.json").unlink()
    checkpoint.save(folder, frames, make_arrays(frames), {"frames": frames})
    arrays, counters, _ = checkpoint.restore(folder)
    assert arrays is not None
    assert same(arrays, make_arrays(frames)) and counters == {"frames": frames}


# --- Being killed ---


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
