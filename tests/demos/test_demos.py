"""Demonstrations are read as they were written, by us and by Minari, and damaged ones are refused."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import gymnasium
import h5py
import hypothesis.extra.numpy as arrays
import minari
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from odd import Odd
from pcil import demos, envs, seeds
from pcil.demos import Demonstrations, inspect
from pcil.errors import InputError
from pcil.types import Episode, Spec


def make_episode(steps: int = 5, obs_dim: int = 3, action_dim: int = 2, seed: int = 0, **changes) -> Episode:
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(steps + 1, obs_dim)).astype(np.float32)
    action = rng.uniform(-1, 1, size=(steps, action_dim)).astype(np.float32)
    return Episode(**{"obs": obs, "action": action, "reward": rng.normal(size=steps), "seed": seed, **changes})


def make_demos(*lengths: int, task: str = "walker_walk", info: dict | None = None) -> Demonstrations:
    episodes = tuple(make_episode(steps, seed=k, terminated=k == 1) for k, steps in enumerate(lengths or (5, 3, 4)))
    return Demonstrations(task, episodes, info or {"expert": "test expert", "frames": 10})


def refusal(call: Callable) -> str:
    """The message of the `InputError` that `call` must raise, which must be one sentence."""
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert message.endswith(".") and "\n" not in message
    assert not re.search(r"[.!?]\s", message), f"more than one sentence: {message}"
    assert message[0].isupper() or message[0] in "/'0123456789-"
    return message


# --- Writing and reading ---


@st.composite
def any_episode(draw: st.DrawFn, obs_dim: int, action_dim: int) -> Episode:
    steps = draw(st.integers(1, 4))
    numbers = st.floats(allow_nan=False, allow_infinity=False, width=32)
    reward_type = draw(st.sampled_from([np.float32, np.float64]))
    rewards = st.floats(allow_nan=False, allow_infinity=False, width=np.dtype(reward_type).itemsize * 8)
    return Episode(
        draw(arrays.arrays(np.float32, (steps + 1, obs_dim), elements=numbers)),
        draw(arrays.arrays(np.float32, (steps, action_dim), elements=st.floats(-1, 1, width=32))),
        draw(arrays.arrays(reward_type, steps, elements=rewards)),
        draw(st.booleans()),
        draw(st.none() | st.integers(0, 2**31 - 1)),
    )


any_episodes = st.tuples(st.integers(1, 4), st.integers(1, 3)).flatmap(
    lambda dims: st.lists(any_episode(*dims), min_size=1, max_size=3)
)
any_info = st.dictionaries(st.text(max_size=5), st.none() | st.integers() | st.text(max_size=5), max_size=2)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.sampled_from(["walker_walk", "Pendulum-v1", "unknown/Place-v3"]), any_episodes, any_info)
def test_saving_and_loading_changes_nothing(task: str, episodes: list[Episode], info: dict) -> None:
    original = Demonstrations(task, tuple(episodes), info)
    with tempfile.TemporaryDirectory() as scratch:
        loaded = Demonstrations.load(original.save(Path(scratch) / "a folder" / "mine"))
    assert (loaded.task, loaded.info, loaded.hash) == (original.task, original.info, original.hash)
    assert len(loaded.episodes) == len(original.episodes)
    for read, written in zip(loaded.episodes, original.episodes, strict=True):
        for name in ("obs", "action", "reward"):
            assert getattr(read, name).dtype == getattr(written, name).dtype
            assert getattr(read, name).tobytes() == getattr(written, name).tobytes()
        assert (read.terminated, read.seed) == (written.terminated, written.seed)


def test_the_hash_depends_on_every_array_on_the_ends_and_on_the_order() -> None:
    original = make_demos()
    first, *rest = original.episodes
    variants = [original, dataclasses.replace(original, episodes=original.episodes[::-1]), original.take(2)]
    for name in ("obs", "action", "reward"):
        changed = getattr(first, name).copy()
        changed.flat[-1] = np.nextafter(changed.flat[-1], 0)
        episodes = (dataclasses.replace(first, **{name: changed}), *rest)
        variants.append(dataclasses.replace(original, episodes=episodes))
    ended = (dataclasses.replace(first, terminated=True), *rest)
    variants.append(dataclasses.replace(original, episodes=ended))
    assert len({variant.hash for variant in variants}) == len(variants)
    assert dataclasses.replace(original, task="other", info={}).hash == original.hash


def test_plain_minari_reads_what_we_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    original = make_demos()
    folder = original.save(tmp_path / "dmc" / "walker_walk" / "expert-v0")
    assert list(minari.list_local_datasets()) == ["dmc/walker_walk/expert-v0"]
    for dataset in (minari.load_dataset("dmc/walker_walk/expert-v0"), minari.MinariDataset(folder / "data")):
        assert (dataset.total_episodes, dataset.total_steps) == (3, 12)
        assert dataset.action_space == spaces.Box(-1.0, 1.0, (2,), np.float32)
        assert dataset.observation_space == spaces.Box(-np.inf, np.inf, (3,), np.float32)
        assert dataset.storage.metadata["pcil"]["info"] == original.info
        attributes = dataset.storage.get_episode_metadata(range(3))
        assert [known["seed"] for known in attributes] == [0, 1, 2]
        for read, written in zip(dataset.iterate_episodes(), original.episodes, strict=True):
            np.testing.assert_array_equal(read.observations, written.obs)
            np.testing.assert_array_equal(read.actions, written.action)
            np.testing.assert_array_equal(read.rewards, written.reward)
            last = np.arange(len(written)) == len(written) - 1
            np.testing.assert_array_equal(read.terminations, last & written.terminated)
            np.testing.assert_array_equal(read.truncations, last & (not written.terminated))


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
def test_minari_recovers_an_environment_whose_actions_mean_what_is_stored(tmp_path: Path) -> None:
    episode = make_episode(obs_dim=3, action_dim=1)
    folder = Demonstrations("Pendulum-v1", (episode,), {}).save(tmp_path / "pendulum")
    with minari.MinariDataset(folder / "data").recover_environment() as env:
        np.testing.assert_array_equal(env.action_space.high, [1.0])
        assert env.observation_space.shape == (3,)


def test_a_save_leaves_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = make_demos()
    folder = original.save(tmp_path / "mine")
    before = (folder / "data" / "main_data.hdf5").read_bytes()
    assert "exists already" in refusal(lambda: make_demos(2).save(folder))
    assert (folder / "data" / "main_data.hdf5").read_bytes() == before

    def interrupted(*_arguments, **_keywords) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(MinariStorage, "update_metadata", interrupted)
    with pytest.raises(KeyboardInterrupt):
        original.save(tmp_path / "second")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_save_makes_sure_first_that_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand: twice the arrays, 64 KiB per episode and 1 MiB, for 15 observations of 3 numbers and 12 actions of 2."""
    asked: list[int] = []
    monkeypatch.setattr(demos.files, "reserve", lambda folder, size: asked.append(size))
    make_demos(5, 3, 4).save(tmp_path / "mine")
    assert asked == [2 * (15 * 3 * 4 + 12 * 2 * 4 + 12 * 8) + 3 * 65536 + 1048576]


def test_a_save_that_can_not_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("here")
    assert "can not be written" in refusal(lambda: make_demos().save(tmp_path / "file" / "mine"))
    assert "exists already" in refusal(lambda: make_demos().save(tmp_path / "file"))
    assert "JSON" in refusal(lambda: make_demos(info={"when": np.float32(1)}).save(tmp_path / "mine"))
    assert "no Minari dataset id" in refusal(lambda: make_demos().save(tmp_path / "mine", dataset_id="mine"))
    broken = Demonstrations("walker_walk", (make_episode(reward=np.full(5, np.nan)),), {})
    assert "NaN" in refusal(lambda: broken.save(tmp_path / "mine"))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    (tmp_path / "empty").mkdir()
    assert Demonstrations.load(make_demos().save(tmp_path / "empty")).num_steps == 12


# --- Damaged demonstrations are refused ---


def edit_metadata(data: Path, **changes) -> None:
    metadata = json.loads((data / "metadata.json").read_text()) | changes
    kept = {key: value for key, value in metadata.items() if value is not None}
    (data / "metadata.json").write_text(json.dumps(kept))


def forget_checksum(data: Path) -> None:
    known = json.loads((data / "metadata.json").read_text())["pcil"]
    edit_metadata(data, pcil={key: value for key, value in known.items() if key != "hash"})


def edit_array(data: Path, key: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    with h5py.File(data / "main_data.hdf5", "a") as file:
        stored = file[f"episode_1/{key}"][()]
        del file[f"episode_1/{key}"]
        file[f"episode_1/{key}"] = change(stored)


def edit_groups(data: Path, change: Callable[[h5py.File], None]) -> None:
    with h5py.File(data / "main_data.hdf5", "a") as file:
        change(file)


def with_one(array: np.ndarray, value: float) -> np.ndarray:
    array.flat[1] = value
    return array


def truncate(data: Path) -> None:
    whole = (data / "main_data.hdf5").read_bytes()
    (data / "main_data.hdf5").write_bytes(whole[: len(whole) // 2])


def pickled(data: Path) -> None:
    with (data / "main_data.hdf5").open("wb") as file:
        np.save(file, np.array([{"obs": 1}], dtype=object), allow_pickle=True)


TEXT = h5py.string_dtype()
DAMAGE = {
    "truncated": (truncate, "truncated file"),
    "text": (lambda data: (data / "main_data.hdf5").write_text("hello"), "main_data.hdf5 is not an HDF5 file"),
    "pickle": (pickled, "main_data.hdf5 is not an HDF5 file"),
    "no_data": (lambda data: (data / "main_data.hdf5").unlink(), "main_data.hdf5 is missing"),
    "no_metadata": (lambda data: (data / "metadata.json").unlink(), "no Minari dataset"),
    "metadata_text": (lambda data: (data / "metadata.json").write_text("hello\nyou"), "can not be read"),
    "metadata_list": (lambda data: (data / "metadata.json").write_text("[1]"), "can not be read"),
    "no_spaces": (lambda data: edit_metadata(data, observation_space=None), "there is no 'observation_space'"),
    "no_counts": (lambda data: edit_metadata(data, total_steps=None), "there is no 'total_steps'"),
    "format": (lambda data: edit_metadata(data, data_format="zarr"), "'zarr'"),
    "no_episodes": (lambda data: edit_metadata(data, total_episodes=0), "no episodes"),
    "fewer_episodes": (lambda data: edit_metadata(data, total_episodes=4), "has 3 episodes, metadata.json says 4"),
    "more_episodes": (lambda data: edit_metadata(data, total_episodes=2), "has 3 episodes, metadata.json says 2"),
    "steps": (lambda data: edit_metadata(data, total_steps=11), "12 steps in all, metadata.json says 11"),
    "no_rewards": (lambda data: edit_groups(data, lambda file: file.pop("episode_1/rewards")), "Episode 1 of.*rewards"),
    "renamed": (lambda data: edit_groups(data, lambda file: file.move("episode_1", "other")), "Episode 1.*episode_1"),
    "short_obs": (lambda data: edit_array(data, "observations", lambda a: a[1:]), "Episode 1.*not 3 .*with 3 obs"),
    "short_rewards": (lambda data: edit_array(data, "rewards", lambda a: a[1:]), "Episode 1.*not 3 .*, 2 rewards"),
    "short_actions": (lambda data: edit_array(data, "actions", lambda a: a[1:]), "Episode 1.*not 2 actions with 4 obs"),
    "no_actions": (lambda data: edit_array(data, "actions", lambda a: a[:0]), "Episode 1.*not 0 actions with 4 obs"),
    "long_flags": (lambda data: edit_array(data, "truncations", lambda a: np.append(a, a)), "Episode 1.*and 6 "),
    "obs_dim": (lambda data: edit_array(data, "observations", lambda a: a[:, 1:]), r"Episode 1 of.*\(2,\).*\[3\]"),
    "action_dim": (lambda data: edit_array(data, "actions", lambda a: a[:, 1:]), r"Episode 1 of.*\(1,\).*\[2\]"),
    "reward_dim": (lambda data: edit_array(data, "rewards", lambda a: a[:, None]), r"Episode 1 of.*\(1,\).*\[\]"),
    "objects": (lambda data: edit_array(data, "observations", lambda a: a.astype(str).astype(TEXT)), "1.*object"),
    "nan_obs": (lambda data: edit_array(data, "observations", lambda a: with_one(a, np.nan)), "Episode 1.*NaN.*obs"),
    "inf_action": (lambda data: edit_array(data, "actions", lambda a: with_one(a, -np.inf)), "Episode 1.*NaN.*action"),
    "nan_reward": (lambda data: edit_array(data, "rewards", lambda a: with_one(a, np.nan)), "Episode 1.*NaN.*reward"),
    "huge": (
        lambda data: edit_array(data, "observations", lambda a: with_one(a.astype(np.float64), 1e300)),
        "Episode 1.*infinite.*obs",
    ),
    "loud_action": (lambda data: edit_array(data, "actions", lambda a: with_one(a, 1.25)), r"to 1.25.*\[-1, 1\]"),
    "low_action": (lambda data: edit_array(data, "actions", lambda a: with_one(a, -3)), r"from -3 .*\[-1, 1\]"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_dataset_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    damage, expected = DAMAGE[name]
    folder = make_demos().save(tmp_path / "mine")
    damage(folder / "data")
    message = refusal(lambda: Demonstrations.load(folder))
    assert re.search(expected, message), message
    assert str(folder) in message


def test_rounding_in_actions_is_tolerated(tmp_path: Path) -> None:
    folder = make_demos().save(tmp_path / "mine")
    edit_array(folder / "data", "actions", lambda a: with_one(a, 1 + 5e-7))
    forget_checksum(folder / "data")
    assert Demonstrations.load(folder).action.max() > 1


def test_a_dataset_can_not_name_code_to_be_run(tmp_path: Path) -> None:
    """Without spaces, Minari makes the environment of the file's `env_spec`, which may name any function and arguments."""
    folder = make_demos().save(tmp_path / "mine")
    harm = gymnasium.envs.registration.EnvSpec("Harm-v0", entry_point="os:mkdir", kwargs={"path": f"{tmp_path}/harm"})
    edit_metadata(folder / "data", env_spec=harm.to_json(), action_space=None)
    assert "there is no 'action_space'" in refusal(lambda: Demonstrations.load(folder))
    assert not (tmp_path / "harm").exists()


def test_validate_compares_with_the_environment() -> None:
    original = make_demos()
    assert original.validate(Spec(3, 2, 2)) is original
    assert original.validate(None) is original
    assert "(6, 24)" in refusal(lambda: original.validate(Spec(24, 2, 2)))
    assert "(5, 6)" in refusal(lambda: original.validate(Spec(3, 6, 2)))
    assert "no episodes" in refusal(lambda: dataclasses.replace(original, episodes=()).validate(None))
    ragged = (*original.episodes, make_episode(obs_dim=4))
    assert "Episode 3" in refusal(lambda: dataclasses.replace(original, episodes=ragged).validate(None))


def test_arrays_that_are_no_rows_of_numbers_are_refused() -> None:
    """The types of an `Episode` are checked at run time only in these tests."""
    for name, shape in (("obs", (6,)), ("obs", (6, 0)), ("action", (5,)), ("action", (5, 0))):
        episode = make_episode()
        object.__setattr__(episode, name, np.zeros(shape, np.float32))
        given = Demonstrations("walker_walk", (episode,), {})
        message = refusal(lambda given=given: given.validate(None))
        assert "each must be rows of at least one number" in message and str(shape) in message
    object.__setattr__(episode := make_episode(), "action", np.zeros((5, 0), np.float32))
    assert Demonstrations("walker_walk", (episode,), {}, has_actions=False).validate(None).num_steps == 5


def test_a_shape_that_does_not_fit_is_said_to_be_of_the_environment_or_of_the_first_episode() -> None:
    both = Demonstrations("walker_walk", (make_episode(), make_episode(obs_dim=4)), {})
    expected = (
        "Episode 1 of the demonstrations of walker_walk has obs of shape (6, 4), but after the first episode it must be (6, 3)."
    )
    assert refusal(lambda: both.validate(None)) == expected
    expected = (
        "Episode 0 of the demonstrations of walker_walk has obs of shape (6, 3), but in this environment it must be (6, 4)."
    )
    assert refusal(lambda: both.validate(Spec(4, 2, 1))) == expected


def test_demonstrations_do_not_change_and_are_equal_to_themselves_alone() -> None:
    one, two = make_demos(), make_demos()
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.task = "another"  # type: ignore[misc]
    assert one == one and one != two and len({one, two}) == 2


def test_clipping_leaves_what_is_within_the_bounds_and_brings_the_rest_to_them() -> None:
    action = np.array([[-3.0], [-1.0], [-0.5], [0.25], [1.0], [1.5]], np.float32)
    given = Demonstrations("walker_walk", (make_episode(6, action=action), make_episode(6, action=action / 2)), {})
    np.testing.assert_array_equal(given.clip().action[:, 0], [-1, -1, -0.5, 0.25, 1, 1, -1, -0.5, -0.25, 0.125, 0.5, 0.75])


# --- Datasets from other programs ---


def write_foreign(folder: Path, observation_space, action_space, observations, actions: np.ndarray, **options) -> Path:
    """Write one episode through Minari's own interface."""
    folder.mkdir()
    storage = MinariStorage.new(folder / "data", observation_space, action_space, **options)
    steps = len(actions)
    flags = [[False] * steps, [False] * (steps - 1) + [True]]
    buffer = EpisodeBuffer(None, 7, None, observations, list(actions), [1.0] * steps, *flags)
    storage.update_metadata({"dataset_id": "other/place-v0", "minari_version": minari.__version__})
    storage.update_episodes([buffer])
    return folder


BOX = spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTIONS = np.array([[-2.0], [0.5], [2.0]], np.float32)
TWO = spaces.Box(-2.0, 2.0, (1,), np.float32)


@pytest.mark.parametrize("kind", [dict, OrderedDict], ids=["sorted", "ordered"])
def test_dict_observations_are_flattened_as_gymnasium_does_it(tmp_path: Path, kind: type) -> None:
    image = spaces.Box(0, 9, (2, 2), np.float32)
    space = spaces.Dict(kind(zebra=BOX, ant=image, inner=spaces.Dict(kind(b=BOX, a=spaces.Box(0, 1, ())))))
    space.seed(0)
    samples = [space.sample() for _ in range(4)]
    stacked = {
        "zebra": np.stack([sample["zebra"] for sample in samples]),
        "ant": np.stack([sample["ant"] for sample in samples]),
        "inner": {key: np.stack([sample["inner"][key] for sample in samples]) for key in "ab"},
    }
    folder = write_foreign(tmp_path / "place", space, TWO, stacked, ACTIONS)
    loaded = Demonstrations.load(folder)
    expected = np.stack([spaces.utils.flatten(space, sample) for sample in samples]).astype(np.float32)
    np.testing.assert_array_equal(loaded.episodes[0].obs, expected)
    assert (loaded.task, loaded.episodes[0].seed) == ("other/place-v0", 7)
    assert loaded.info["minari_version"] == minari.__version__
    assert Demonstrations.load(loaded.save(tmp_path / "again")).info == loaded.info


def test_nested_dicts_and_tuples_are_flattened_as_the_environment_is(tmp_path: Path) -> None:
    image = spaces.Box(0, 9, (2, 2), np.float32)
    space = spaces.Tuple([image, spaces.Dict(z=BOX, a=spaces.Tuple([BOX, spaces.Dict(y=image, b=BOX)]))])
    env = envs.checked(Odd(space))
    env.reset(seed=3)
    raw = [env.unwrapped._observation() for env.unwrapped.x in (0.25, 0.5, 0.75, 1.0)]
    parts = [(o[0], o[1]["z"], o[1]["a"][0], o[1]["a"][1]["y"], o[1]["a"][1]["b"]) for o in raw]
    first, z, a, y, b = (np.stack(part) for part in zip(*parts, strict=True))
    stored = (first, {"z": z, "a": (a, {"y": y, "b": b})})
    loaded = Demonstrations.load(write_foreign(tmp_path / "place", space, TWO, stored, ACTIONS)).episodes[0].obs
    env.unwrapped._observation = lambda: raw.pop(0)
    np.testing.assert_array_equal(loaded, [env.reset()[0], *(env.step(np.zeros(1))[0] for _ in range(3))])
    assert np.array_equal(np.unique(loaded[:, 0]), [0.25, 0.5, 0.75, 1.0])
    env.close()


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
def test_actions_are_brought_to_the_unit_box_as_rescale_action_does_it(tmp_path: Path) -> None:
    box = spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)
    stored = np.array([[-2.0, 0.0], [1.0, 2.5], [2.0, 10.0]])
    folder = write_foreign(tmp_path / "place", BOX, box, np.zeros((4, 2)), stored)
    action = Demonstrations.load(folder).action
    np.testing.assert_array_equal(action, np.array([[-1, -1], [0.5, -0.5], [1, 1]], np.float32))
    env = TinyEnv()
    env.action_space = box
    rescaled = gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)
    np.testing.assert_allclose([rescaled.action(row) for row in action], stored)


@pytest.mark.parametrize(
    ("observation_space", "action_space", "expected"),
    [
        (BOX, spaces.Box(-np.inf, np.inf, (1,), np.float32), "finite bounds"),
        (BOX, spaces.Box(1.0, 1.0, (1,), np.float32), "finite bounds"),
        (BOX, spaces.Discrete(5), "finite bounds"),
        (spaces.Discrete(3), TWO, "only Box and Dict of Box"),
        (spaces.Dict(a=BOX, b=spaces.Discrete(3)), TWO, "only Box and Dict of Box"),
    ],
)
def test_other_spaces_are_refused(tmp_path: Path, observation_space, action_space, expected: str) -> None:
    observations = {"a": np.zeros((4, 2)), "b": np.zeros(4)} if isinstance(observation_space, spaces.Dict) else np.zeros((4, 2))
    folder = write_foreign(tmp_path / "place", observation_space, action_space, observations, ACTIONS)
    assert expected in refusal(lambda: Demonstrations.load(folder))


def test_only_hdf5_is_read(tmp_path: Path) -> None:
    folder = make_demos().save(tmp_path / "mine")
    edit_metadata(folder / "data", data_format="arrow")
    assert "data_format is 'arrow', and only hdf5 is read" in refusal(lambda: Demonstrations.load(folder))


# --- Finding, taking, showing ---


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package that includes `walker_walk`, and a user's Minari root with `mine/run-v1`; downloads raise an error."""

    def download(*_arguments, **_keywords) -> None:
        raise AssertionError("a download was attempted")

    monkeypatch.setattr(minari.storage.hosting, "download_dataset", download)
    monkeypatch.setattr(demos, "SHIPPED", tmp_path / "package")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "root"))
    make_demos(5, 3).save(tmp_path / "package" / "dmc" / "walker_walk" / "expert-v0")
    make_demos(4, task="Pendulum-v1").save(tmp_path / "root" / "mine" / "run-v1")
    return tmp_path


def test_each_way_to_name_demonstrations_finds_them(library: Path) -> None:
    for spec in ("walker_walk", "dmc/walker_walk/expert-v0", "dmc/walker_walk-v0"):
        assert Demonstrations.load(spec).num_steps == 8
    place = library / "root" / "mine" / "run-v1"
    for spec in ("mine/run-v1", place, str(place), place / "data"):
        assert Demonstrations.load(spec).num_steps == 4
    assert Demonstrations.load("mine/run-v1").task == "Pendulum-v1"


def test_what_is_unknown_is_refused_with_what_there_is(library: Path) -> None:
    for spec in ("walker_wakl", library / "walker_walk", library / "root", "D4RL/door/human-v2"):
        message = refusal(lambda spec=spec: Demonstrations.load(spec))
        assert str(spec) in message and "walker_walk" in message and "the path of" in message
    file = library / "root" / "mine" / "run-v1" / "data" / "main_data.hdf5"
    assert "folder" in refusal(lambda: Demonstrations.load(file))


def test_a_home_directory_that_cannot_be_determined_is_no_error_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", unknown)
    assert "'~nobody/data'" in refusal(lambda: Demonstrations.load("~nobody/data"))
    assert Demonstrations.load("walker_walk").num_steps > 0


def test_the_table_of_what_ships_is_read_from_the_data(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (row,) = inspect.shipped()
    original = make_demos(5, 3)
    assert row == {
        "task": "walker_walk",
        "observation_dim": 3,
        "action_dim": 2,
        "episodes": 2,
        "steps": 8,
        "return_mean": np.mean(original.returns),
        "return_std": np.std(original.returns),
        "return_min": min(original.returns),
        "return_max": max(original.returns),
        "expert": "test expert",
        "frames": 10,
        "seeds_tried": None,
        "hash": original.hash,
    }
    assert json.loads(json.dumps(row)) == row
    monkeypatch.setattr(demos, "SHIPPED", library / "nothing")
    assert inspect.shipped() == []
    assert "none ship" in refusal(lambda: Demonstrations.load("walker_walk"))


def test_a_line_of_the_table_says_what_its_row_says() -> None:
    row = {"task": "walker_walk", "observation_dim": 24, "action_dim": 6, "episodes": 10, "steps": 5000}
    row |= {"return_mean": 961.04, "return_std": 12.35, "return_min": 940.0, "return_max": 975.96}
    row |= {"seeds_tried": 3, "hash": "0123456789abcdef", "expert": "DrQ-v2"}
    heading, line, untold = inspect.table([row, row | {"seeds_tried": None}])
    told = ["walker_walk", "24", "6", "10", "5000", "961.0", "+-", "12.3", "940.0", "976.0", "3", "01234567", "DrQ-v2"]
    assert line.split() == told and untold.split() == [word for word in told if word != "3"]
    assert heading.split() == ["task", "obs", "act", "episodes", "steps", "return", "min", "max", "tries", "hash", "expert"]
    assert len(untold) == len(line) and heading.index("hash") == line.index("01234567") == untold.index("01234567")


def test_take_gives_the_first_episodes_or_refuses() -> None:
    original = make_demos()
    assert original.take(2).episodes == original.episodes[:2]
    assert original.take(3).episodes == original.take(None).episodes == original.episodes
    for n in (0, -1, 4):
        assert "1 to 3" in refusal(lambda n=n: original.take(n))


def test_arrays_become_episodes_and_what_is_absent_is_known(tmp_path: Path) -> None:
    obs, action, reward = np.arange(8.0).reshape(4, 2), np.full((3, 1), 0.5), [1.0, 2.0, 3.0]
    whole = Demonstrations.from_arrays([obs, obs], [action, action], [reward, reward], [True, False])
    assert whole.has_actions and whole.has_rewards and [e.terminated for e in whole.episodes] == [True, False]
    np.testing.assert_array_equal(whole.obs, np.concatenate([obs[:-1], obs[:-1]]))
    assert whole.returns.tolist() == [6, 6] and whole.task == "arrays" and whole.info == {}
    bare = Demonstrations.from_arrays([obs], task="mine", info={"from": "me"})
    assert not bare.has_actions and not bare.has_rewards and bare.return_mean is None and bare.return_std is None
    assert bare.task == "mine" and bare.info == {"from": "me"}
    again = Demonstrations.load(bare.save(tmp_path / "bare"))
    assert not again.has_actions and not again.has_rewards and again.hash == bare.hash
    wider = np.zeros((4, 3))
    assert "Episode 1 of the arrays has obs" in refusal(lambda: Demonstrations.from_arrays([obs, wider]))
    assert "have no actions" in refusal(lambda: bare.action) and "have no rewards" in refusal(lambda: bare.returns)
    assert Demonstrations.from_arrays([obs], [4 * action]).action.max() == 2, "actions out of bounds are left to `clip`"
    assert Demonstrations.from_arrays([obs], rewards=[reward]).has_rewards


def test_rows_pair_each_action_with_the_state_it_was_taken_in() -> None:
    original = make_demos(5, 3)
    first, second = original.episodes
    assert original.obs.shape == (8, 3) and original.action.shape == (8, 2)
    for row, (episode, step) in {0: (first, 0), 4: (first, 4), 5: (second, 0), 7: (second, 2)}.items():
        np.testing.assert_array_equal(original.obs[row], episode.obs[step])
        np.testing.assert_array_equal(original.action[row], episode.action[step])
    assert original.returns.dtype == np.float64
    assert original.take(1).return_std == 0.0


def test_importing_demos_does_not_import_minari() -> None:
    code = "import sys, pcil.demos; sys.exit(bool({'minari', 'h5py'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- Recording ---


class TinyEnv(gymnasium.Env):
    """A random initial state that is moved by the action for four steps; every observation is the same array."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed, options=options)
        self.steps, self.buffer = 0, self.np_random.normal(size=2).astype(np.float32)
        return self.buffer, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        self.buffer += action
        return self.buffer, float(self.buffer[0]), bool(self.buffer[0] > 3), self.steps == 4, {}


def push(obs: np.ndarray) -> np.ndarray:
    return np.tanh(obs[:1])


def record_tiny(**changes) -> Demonstrations:
    options = {"episodes": 3, "task": "tiny", "seed": 1, "info": {"expert": "push"}, **changes}
    return demos.record(push, TinyEnv(), **options)


def test_a_recording_is_a_function_of_its_seed() -> None:
    assert record_tiny().hash == record_tiny().hash
    assert record_tiny().hash != record_tiny(seed=2).hash
    assert record_tiny(episodes=2).hash == record_tiny().take(2).hash
    seeds_used = [episode.seed for episode in record_tiny().episodes]
    assert seeds_used == [seeds.episode_seed(1, seeds.Stream.RECORD, attempt) for attempt in range(3)]


def test_a_recording_can_be_replayed_from_its_seeds_and_actions() -> None:
    env = TinyEnv()
    for episode in record_tiny(episodes=8).episodes:
        obs = [env.reset(seed=episode.seed)[0].copy()]
        steps = [env.step(action) for action in episode.action[:1]]
        obs.append(steps[0][0].copy())
        np.testing.assert_array_equal(episode.obs[:2], obs)
        assert episode.reward[0] == steps[0][1]
        assert episode.terminated == (episode.obs[-1, 0] > 3)
        np.testing.assert_array_equal(episode.action, np.tanh(episode.obs[:-1, :1]))


def test_only_good_episodes_are_kept() -> None:
    free = record_tiny(episodes=30)
    filtered = record_tiny(minimum_return=1.0)
    good = [episode for episode in free.episodes if episode.total_reward >= 1.0][:3]
    assert [episode.seed for episode in filtered.episodes] == [episode.seed for episode in good]
    assert filtered.info["record_attempts"] > 3 and filtered.info["expert"] == "push"
    assert "Only 0 of 30 episodes" in refusal(lambda: record_tiny(minimum_return=1e9))


def test_an_episode_that_returns_just_the_minimum_is_kept() -> None:
    returns = [episode.total_reward for episode in record_tiny(episodes=20).episodes]
    best = record_tiny(episodes=1, minimum_return=max(returns))
    assert best.return_mean == max(returns) and best.info["record_attempts"] == returns.index(max(returns)) + 1
    assert best.info["record_minimum_return"] == max(returns)


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-2.0, 1.0), (0.0, 1.0), (-1.0, 2.0), (-1.0, 0.0)])
def test_recorded_actions_are_brought_from_their_bounds_to_the_unit_box(low: float, high: float) -> None:
    env = TinyEnv()
    env.action_space = spaces.Box(low, high, (1,), np.float32)
    share = [0.0, 0.25, 0.5, 1.0]
    given = iter(low + (high - low) * np.array(share))
    kept = demos.record(lambda obs: np.array([next(given)]), env, 1, task="tiny", seed=1, info={})
    np.testing.assert_allclose(kept.action[:, 0], [-1, -0.5, 0, 1][: kept.num_steps], atol=1e-6)
    assert kept.action.dtype == np.float32


def test_a_bad_recording_is_refused() -> None:
    for unreachable in (np.inf, np.nan):
        assert "that an episode can reach" in refusal(lambda most=unreachable: record_tiny(minimum_return=most))
    assert "at least 1" in refusal(lambda: record_tiny(episodes=0))
    options = {"task": "tiny", "seed": 1, "info": {}}
    wild = refusal(lambda: demos.record(lambda obs: np.array([2.0]), TinyEnv(), 1, **options))
    assert "from 2 to 2" in wild
    free, choice = TinyEnv(), TinyEnv()
    free.action_space, choice.action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32), spaces.MultiBinary(1)
    for env in (free, choice):
        unbounded = refusal(lambda env=env: demos.record(lambda obs: np.zeros(1, np.int8), env, 1, **options))
        assert "need actions in a Box with finite bounds" in unbounded
    broken = refusal(lambda: demos.record(push, Odd(episode=2, reward=np.nan), 3, **options))
    assert "recorded episode 2" in broken


def test_the_repr_is_one_short_line() -> None:
    """Two episodes of two steps, with returns 3 and 5."""
    obs, actions = [np.zeros((3, 2))] * 2, [np.zeros((2, 1))] * 2
    full = Demonstrations.from_arrays(obs, actions, [np.array([1.0, 2.0]), np.array([2.0, 3.0])], task="mine")
    assert repr(full) == "Demonstrations('mine': 2 episodes, 4 steps, return 4.0 +- 1.0)"
    assert repr(Demonstrations.from_arrays(obs, actions)) == "Demonstrations('arrays': 2 episodes, 4 steps)"
    assert repr(dataclasses.replace(full, episodes=())) == "Demonstrations('mine': 0 episodes, 0 steps)"
