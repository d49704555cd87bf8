"""A saved policy acts exactly as before, and damaged files are refused in one sentence."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jaxtyping
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from pcil.errors import InputError
from pcil.nets.networks import Actor
from pcil.policy import Policy, load_policy
from pcil.types import Spec

OBS_DIM, ACTION_DIM = 5, 3
INFO = {"method": "pcil", "frames": 2000, "seed": 1, "action_repeat": 2, "return_mean": 1 / 3}


def make_policy(seed: int = 0) -> Policy:
    """A policy whose actor has random numbers everywhere, so that no two arrays are equal."""
    rng = np.random.default_rng(seed)
    actor = Actor.init(OBS_DIM, ACTION_DIM, 7, 8, key=jax.random.key(seed))
    actor = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32), actor)
    return Policy(actor, "walker_walk", INFO)


def observations(*shape: int) -> np.ndarray:
    return np.random.default_rng(3).normal(size=shape).astype(np.float32)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policies") / "policy"
    make_policy().save(folder)
    return folder


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(saved, tmp_path / "mine"))


def refusal(call: Callable) -> str:
    """The message of the `InputError` that `call` must raise, which must be one sentence."""
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert message.endswith(".") and "\n" not in message
    return message


# --- Saving and loading ---


def test_a_loaded_policy_is_the_saved_one_bit_for_bit(saved: Path) -> None:
    policy, loaded = make_policy(), load_policy(saved)
    for a, b in zip(jax.tree.leaves(policy.actor), jax.tree.leaves(loaded.actor), strict=True):
        assert isinstance(b, np.ndarray) and a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(policy(observations(9, OBS_DIM)), loaded(observations(9, OBS_DIM)))
    assert (loaded.task, loaded.info) == ("walker_walk", INFO)
    assert loaded.spec == policy.spec == Spec(OBS_DIM, ACTION_DIM, 2)


def test_an_actor_on_the_device_is_saved_like_one_on_the_host(saved: Path, tmp_path: Path) -> None:
    policy = make_policy()
    Policy(jax.tree.map(jax.numpy.asarray, policy.actor), policy.task, policy.info).save(tmp_path / "device")
    for name in ("policy.safetensors", "policy.json"):
        assert (tmp_path / "device" / name).read_bytes() == (saved / name).read_bytes()


def test_a_run_folder_is_as_good_as_its_policy_folder(saved: Path) -> None:
    for path in (saved, saved.parent, str(saved)):
        assert load_policy(path).task == "walker_walk"


def test_saving_again_replaces_and_leaves_three_files(folder: Path) -> None:
    make_policy(seed=1).save(folder)
    assert {path.name for path in folder.iterdir()} == {"policy.safetensors", "policy.json", "README.md"}
    np.testing.assert_array_equal(load_policy(folder).actor.trunk.weight, make_policy(seed=1).actor.trunk.weight)


def test_a_save_that_fails_leaves_the_policy_that_was_there(folder: Path) -> None:
    other = make_policy(seed=1)
    with pytest.raises(TypeError):
        Policy(other.actor, other.task, {"not json": object()}).save(folder)
    np.testing.assert_array_equal(load_policy(folder).actor.trunk.weight, make_policy().actor.trunk.weight)
    assert {path.name for path in folder.iterdir()} == {"policy.safetensors", "policy.json", "README.md"}


def test_the_files_hold_numbers_and_text_and_no_code(saved: Path) -> None:
    arrays, header = load_file(saved / "policy.safetensors"), json.loads((saved / "policy.json").read_text())
    assert header == {"format": "pcil-policy-1", "task": "walker_walk", "layers": 3, "info": INFO}
    assert sorted(arrays) == sorted(
        [f"trunk.{name}" for name in ("weight", "bias", "scale", "offset")]
        + [f"head.{kind}.{i}" for kind in ("weights", "biases") for i in range(3)]
    )
    size = int.from_bytes((saved / "policy.safetensors").read_bytes()[:8], "little")
    assert (saved / "policy.safetensors").stat().st_size == 8 + size + 4 * sum(array.size for array in arrays.values())


# --- Acting ---


@pytest.mark.parametrize("shape", [(), (1,), (6,), (2, 3)])
def test_a_batch_is_its_rows_one_by_one(shape: tuple[int, ...]) -> None:
    policy, obs = make_policy(), observations(*shape, OBS_DIM)
    action = policy(obs)
    assert action.shape == (*shape, ACTION_DIM) and action.dtype == np.float32
    assert np.abs(action).max() <= 1
    alone = [policy(row) for row in obs.reshape(-1, OBS_DIM)]
    np.testing.assert_allclose(action.reshape(-1, ACTION_DIM), alone, rtol=0, atol=1e-6)


def test_observations_of_another_kind_of_number_are_taken_as_float32() -> None:
    policy, obs = make_policy(), observations(4, OBS_DIM)
    np.testing.assert_array_equal(policy(obs.astype(np.float64)), policy(obs))
    assert policy(np.arange(OBS_DIM)).dtype == np.float32


@pytest.mark.parametrize("shape", [(), (4,), (6,), (OBS_DIM, 4), (0,)])
def test_observations_of_another_size_are_refused(shape: tuple[int, ...]) -> None:
    message = refusal(lambda: make_policy()(np.zeros(shape, np.float32)))
    assert message == f"The policy for walker_walk takes observations of 5 numbers; got an array of shape {shape}."


def test_the_observation_is_not_written_to() -> None:
    obs = observations(4, OBS_DIM)
    before = obs.copy()
    obs.flags.writeable = False
    make_policy()(obs)
    np.testing.assert_array_equal(obs, before)


# --- Damage ---


@pytest.fixture
def _as_users_run_it() -> Iterator[None]:
    """Turn off the shape checks of the test run, which would refuse some damage before the policy does."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def edit_json(folder: Path, **changes: Any) -> None:
    header = json.loads((folder / "policy.json").read_text()) | changes
    kept = {name: value for name, value in header.items() if value is not ...}
    (folder / "policy.json").write_text(json.dumps(kept))


def edit_arrays(folder: Path, change: Callable[[dict[str, np.ndarray]], Any]) -> None:
    arrays = load_file(folder / "policy.safetensors")
    change(arrays)
    save_file(arrays, folder / "policy.safetensors")


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def only_the_trunk(folder: Path) -> None:
    edit_arrays(folder, lambda a: [a.pop(name) for name in list(a) if name.startswith("head")])
    edit_json(folder, layers=0)


def flat(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "half the arrays": lambda f: cut(f / "policy.safetensors", 0.5),
    "one byte of the arrays missing": lambda f: (f / "policy.safetensors").write_bytes(
        (f / "policy.safetensors").read_bytes()[:-1]
    ),
    "no arrays": lambda f: cut(f / "policy.safetensors", 0),
    "arrays of another kind": lambda f: (f / "policy.safetensors").write_bytes(b"\x80\x04not safetensors at all, but longer"),
    "half the JSON": lambda f: cut(f / "policy.json", 0.5),
    "no JSON": lambda f: cut(f / "policy.json", 0),
    "JSON of bytes": lambda f: (f / "policy.json").write_bytes(b"\xff\xfe\x00\x80"),
    "JSON that is a list": lambda f: (f / "policy.json").write_text("[1, 2]"),
    "JSON that is a number": lambda f: (f / "policy.json").write_text("3"),
    "another format": lambda f: edit_json(f, format="pcil-policy-2"),
    "no format": lambda f: edit_json(f, format=...),
    "no task": lambda f: edit_json(f, task=...),
    "an empty task": lambda f: edit_json(f, task=""),
    "a task that is no name": lambda f: edit_json(f, task=5),
    "info that is no table": lambda f: edit_json(f, info=None),
    "layers that are no number": lambda f: edit_json(f, layers="many"),
    "fewer layers": lambda f: edit_json(f, layers=2),
    "more layers": lambda f: edit_json(f, layers=4),
    "no layers": only_the_trunk,
    "an array missing": lambda f: edit_arrays(f, lambda a: a.pop("trunk.scale")),
    "an array too many": lambda f: edit_arrays(f, lambda a: a.update(extra=flat(2))),
    "a trunk without a width": lambda f: edit_arrays(f, lambda a: a.update({"trunk.weight": flat(35)})),
    "a trunk of another width": lambda f: edit_arrays(f, lambda a: a.update({"trunk.bias": flat(8)})),
    "a layer of another width": lambda f: edit_arrays(f, lambda a: a.update({"head.weights.1": flat(9, 8)})),
    "a transposed layer": lambda f: edit_arrays(f, lambda a: a.update({"head.weights.2": flat(3, 8)})),
    "a bias of another width": lambda f: edit_arrays(f, lambda a: a.update({"head.biases.2": flat(4)})),
    "a bias that is one number": lambda f: edit_arrays(f, lambda a: a.update({"head.biases.2": flat()})),
    "a weight that is no number": lambda f: edit_arrays(f, lambda a: a["head.weights.1"].__setitem__((0, 0), np.nan)),
    "a bias that is infinite": lambda f: edit_arrays(f, lambda a: a["trunk.bias"].__setitem__(0, np.inf)),
}


@pytest.mark.usefixtures("_as_users_run_it")
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_policy_is_refused(folder: Path, damage: str) -> None:
    DAMAGES[damage](folder)
    message = refusal(lambda: load_policy(folder))
    assert message.startswith(f"The policy in {folder} is damaged (")
    assert message.endswith("; train or copy it again.")


@pytest.mark.parametrize("missing", ["policy.safetensors", "policy.json", None])
def test_where_there_is_no_policy_the_sentence_says_what_to_give(folder: Path, missing: str | None) -> None:
    path = folder / "nowhere" if missing is None else folder
    (folder / (missing or "policy.json")).unlink()
    message = refusal(lambda: load_policy(path))
    known = r"a task whose expert ships \(acrobot_swingup, .*, walker_walk, Hopper-v5, .*\)\."
    assert re.fullmatch(
        rf"{re.escape(str(path))} holds no policy \(.*\); give a run folder that pcil train made, or {known}", message
    )


def test_where_no_expert_ships_the_sentence_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pcil.policy.SHIPPED", tmp_path / "none")
    assert "a task whose expert ships (none does)" in refusal(lambda: load_policy("walker_walk"))


@pytest.mark.usefixtures("_as_users_run_it")
@pytest.mark.parametrize("name", ["policy.safetensors", "policy.json"])
def test_a_flipped_bit_is_refused_or_changes_no_action(folder: Path, name: str) -> None:
    """A flipped bit in the values, their checksum or a name is noticed; in the task or the info it leaves the same policy."""
    file, obs = folder / name, observations(OBS_DIM)
    action, whole, refused = load_policy(folder)(obs), file.read_bytes(), 0
    for at in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << (at % 8)
        file.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(load_policy(folder)(obs), action)
        except InputError:
            refused += 1
    assert refused > 20


def test_a_file_without_a_checksum_is_read(folder: Path) -> None:
    """It may have been written by another program."""
    policy = load_policy(folder)
    edit_arrays(folder, lambda a: None)
    np.testing.assert_array_equal(load_policy(folder)(observations(OBS_DIM)), policy(observations(OBS_DIM)))
