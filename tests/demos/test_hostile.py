"""Reading hostile files is safe: none runs code, crashes, hangs, fills the memory or leads to other files."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import jax
import jaxtyping
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import pcil
from pcil import cli, envs, modules
from pcil.demos import Demonstrations, hdf5
from pcil.errors import InputError
from pcil.files import flat
from pcil.nets.networks import Actor
from pcil.policy import Policy, load_policy
from pcil.report import representation
from pcil.report.film import film
from pcil.report.load import EvalRow, Source
from small import POINT_MASS, save_point_mass_demos, small_run

CODE = "import pathlib\npathlib.Path(__file__).with_name('RAN').touch()\nimport pcil.envs\n"


ROW = EvalRow(POINT_MASS, "pcil", "default", 1, 0, 0.0, 0.0, 0.0, None, "")


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a command prints before it exits with 2."""
    assert cli.main(words) == 2
    out, error = capsys.readouterr()
    assert out == "" and error.startswith("pcil: ") and error.endswith(".\n") and error.count("\n") == 1, error
    return error


def policy(folder: Path, task: str, **info: Any) -> Path:
    """A policy with the sizes of the point mass that claims to be for `task`."""
    spec = envs.spec(envs.make(POINT_MASS))
    Policy(Actor.init(spec.obs_dim, spec.action_dim, 4, 4, key=jax.random.key(0)), task, info).save(folder)
    return folder


# --- Code ---


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, in which importing `evil_code` or `evil_pack.inner` creates a file RAN."""
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", os.getcwd())])
    (tmp_path / "evil_pack").mkdir()
    for name in ("evil_code.py", "evil_pack/inner.py"):
        (tmp_path / name).write_text(CODE)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("evil"):
            del sys.modules[name]


def ran(folder: Path) -> bool:
    return any(folder.rglob("RAN"))


NAMING: dict[str, tuple[str, dict[str, Any]]] = {
    "a task": (f"evil_code:{POINT_MASS}", {}),
    "a task in a package": (f"evil_pack.inner:{POINT_MASS}", {}),
    "a task that begins like ours": (f"dmc/evil_code:{POINT_MASS}", {}),
    "an argument": (POINT_MASS, {"env_kwargs": {"wrapper": "evil_code:Thing"}}),
    "an argument deep inside": (POINT_MASS, {"env_kwargs": {"parts": [1, {"x": ["evil_pack.inner:make-v0"]}]}}),
    "the name of an argument": (POINT_MASS, {"env_kwargs": {"parts": {"evil_code:Thing": 1}}}),
}


@pytest.mark.parametrize("naming", NAMING)
def test_a_policy_that_names_code_is_refused_with_the_option_that_runs_it(
    naming: str, evil: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task, info = NAMING[naming]
    policy(evil / "policy", task, **info)
    for command in (["evaluate", "policy"], ["record", "policy", "--out", "new"], ["evaluate", "policy", "--trust", "evil"]):
        assert "--trust " in refused(command, capsys)
    with pytest.raises(InputError, match="--trust"):
        film(evil / "policy")
    assert not ran(evil) and not (evil / "new").exists() and str(evil) not in sys.path


@pytest.mark.parametrize(("module", "trusted"), [("evil_code", "evil_code"), ("evil_pack.inner", "evil_pack")])
def test_a_trusted_module_is_imported_from_the_present_folder(
    module: str, trusted: str, evil: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy(evil / "policy", f"{module}:{POINT_MASS}")
    for words in (["evaluate", "policy", "--episodes", "1", "--json"], ["record", "policy", "--episodes", "1", "--out", "new"]):
        assert cli.main([*words, "--trust", "other", trusted]) == 0
    assert ran(evil) and sys.path[-1] == str(evil)
    assert "--trust other" in Demonstrations.load(evil / "new").info["command"]
    capsys.readouterr()


def test_what_a_person_types_needs_no_option(evil: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy(evil / "policy", POINT_MASS)
    assert "unexpected keyword" in refused(["evaluate", "policy", "--env-kwargs", '{"wrapper": "evil_code:Thing"}'], capsys)
    words = ["train", f"evil_code:{POINT_MASS}", "--demos", "nowhere", "--out", "run"]
    assert "no Minari dataset" in refused(words, capsys)
    assert ran(evil)


ONE = 'tasks = ["TASK"]\nmethods = ["expert"]\nseeds = [1]\n'
SWEEPS = {
    "task": ONE.replace("TASK", "evil_code:TASK"),
    "reward": ONE + '[variants.mine]\nreward = "evil_code:Mine"\n',
    "reward without a class": ONE + '[variants.mine]\nreward = "evil_code"\n',
    "arguments": ONE + '[settings]\nenv_kwargs = {x = ["evil_code:X"]}\n',
    "arguments as text": ONE + '[settings]\nenv-kwargs = \'{"x": "evil_code:X"}\'\n',
}


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_that_names_code_is_refused(name: str, evil: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (evil / "sweep.toml").write_text(SWEEPS[name].replace("TASK", POINT_MASS))
    assert "--trust evil_code" in refused(["sweep", "sweep.toml", "--out", "runs"], capsys)
    assert not ran(evil)
    assert "--trust evil_code" not in refused(["sweep", "sweep.toml", "--out", "runs", "--jobs", "0"], capsys)


def test_a_key_that_names_code_is_no_setting(evil: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (evil / "sweep.toml").write_text(f'{ONE}[settings]\n"reward=evil_code:Mine" = 1\n'.replace("TASK", POINT_MASS))
    assert "no setting 'reward=evil_code:Mine'" in refused(["sweep", "sweep.toml", "--out", "runs"], capsys)
    assert not ran(evil)


def test_the_representation_of_a_run_that_names_code_is_left_out(evil: Path) -> None:
    run = small_run(task=f"evil_code:{POINT_MASS}", demos=save_point_mass_demos(evil))
    settings = flat({**run.to_json()})
    with pytest.raises(InputError, match=r"The run in .* names code of the module 'evil_code'.*--trust evil_code"):
        representation.transitions(Source(evil, settings, True), ROW)
    assert not ran(evil)


@pytest.mark.parametrize(
    ("task", "arguments", "found"),
    [
        ("walker_walk", {"xml_file": "C:/my/robot.xml", "url": "http://host/", "at": "12:30", "n": 5, "none": None}, []),
        ("a.b:C-v0", {"text": "a sentence: with a colon"}, ["a.b"]),
        ("odd name:C", None, ["odd name"]),
        ("x", [["m:f"], {"k:v": {"n.o:p": [1]}}], ["m", "k", "n.o"]),
    ],
)
def test_names_of_modules_are_told_from_other_text(task: str, arguments: Any, found: list[str]) -> None:
    assert modules.of_task(task, arguments) == found


SHADOWS = ["tyro", "json", "typing", "numpy", "jax", "gymnasium", "h5py", "minari", "rich", "safetensors", "equinox", "csv"]
"""Modules to shadow; not contextlib and others that Python itself needs before `python -m pcil` begins."""
SCRIPT = "import sys; sys.path.pop(0); from pcil.cli import main; sys.exit(main())"


@pytest.mark.parametrize("start", [["-m", "pcil"], ["-c", SCRIPT]], ids=["python -m pcil", "pcil"])
def test_files_called_like_libraries_shadow_nothing(start: list[str], tmp_path: Path) -> None:
    for name in SHADOWS:
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('the present folder has its own {name}')\n")
    (tmp_path / "mine.py").write_text(CODE)
    policy(tmp_path / "policy", f"mine:{POINT_MASS}")
    words = ["evaluate", "policy", "--episodes", "1", "--trust", "mine"]
    result = subprocess.run([sys.executable, *start, *words], cwd=tmp_path, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "") and "over 1 episodes" in result.stdout and ran(tmp_path)


# --- Datasets ---


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(save_point_mass_demos(tmp_path_factory.mktemp("sound")))


@pytest.fixture
def dataset(sound: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(sound, tmp_path / "demos"))


def replaced(name: str, make: Callable[[h5py.Group, np.ndarray], Any]) -> Callable[[Path], None]:
    """A kind of damage: an array of the first episode is replaced by a function of it."""

    def change(folder: Path) -> None:
        with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
            group = file["episode_0"]
            old = group[name][()]
            del group[name]
            make(group, old)

    return change


def virtual(source: str, path: str) -> Callable[[h5py.Group, np.ndarray], None]:
    def make(group: h5py.Group, old: np.ndarray) -> None:
        layout = h5py.VirtualLayout(shape=old.shape, dtype=old.dtype)
        layout[...] = h5py.VirtualSource(source, path, shape=old.shape)
        group.create_virtual_dataset("actions", layout)

    return make


def external(path: str, dtype: str = "f8") -> Callable[[h5py.Group, np.ndarray], None]:
    def make(group: h5py.Group, old: np.ndarray) -> None:
        place = Path(group.file.filename).with_name("outside")
        os.mkfifo(place) if path == "fifo" else place.write_bytes(bytes(range(256)) * 99)
        group.create_dataset("rewards", old.shape, dtype, external=[(str(place), 0, h5py.h5f.UNLIMITED)])

    return make


def moved(link: Any) -> Callable[[h5py.Group, np.ndarray], None]:
    def make(group: h5py.Group, old: np.ndarray) -> None:
        with h5py.File(Path(group.file.filename).with_name("other.hdf5"), "w") as other:
            other["x"] = old
        group.file["elsewhere"] = old
        group.file["episode_1"].move("/elsewhere", "/episode_1/elsewhere")
        group["rewards"] = link

    return make


def shaped(name: str, shape: tuple[int, ...] | None = None, dtype: Any = None, **options: Any) -> Callable[..., None]:
    def make(group: h5py.Group, old: np.ndarray) -> None:
        group.create_dataset(name, old.shape if shape is None else shape, old.dtype if dtype is None else dtype, **options)

    return replaced(name, make)


def consistent_bomb(folder: Path) -> None:
    """All arrays agree with each other and with the metadata, but contain no data."""
    path, rows = folder / "data" / "metadata.json", 2**26
    metadata = json.loads(path.read_text())
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        steps = metadata["total_steps"] - len(file["episode_0/rewards"]) + rows
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            old = file[f"episode_0/{name}"]
            shape, dtype = (rows + (name == "observations"), *old.shape[1:]), old.dtype
            del file[f"episode_0/{name}"]
            file["episode_0"].create_dataset(name, shape, dtype, chunks=(1024, *shape[1:]), compression="gzip")
    path.write_text(json.dumps(metadata | {"total_steps": steps}))


def with_types(name: str, dtype: Any) -> Callable[[Path], None]:
    return shaped(name, dtype=dtype)


def deflated_chunk(folder: Path) -> None:
    """A chunk that decompresses to gigabytes, regardless of the array's shape."""
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        old = file["episode_0/actions"]
        shape = old.shape
        del file["episode_0/actions"]
        new = file["episode_0"].create_dataset("actions", shape, "f4", chunks=shape, compression="gzip")
        new.id.write_direct_chunk((0, 0), bytes(2**21 + 1))


def index_of_itself(folder: Path) -> None:
    """The index of the root group points to itself."""
    path = folder / "data" / "main_data.hdf5"
    data = bytearray(path.read_bytes())
    at = data.index(b"TREE")
    data[at + 5] = 1
    data[at + 32 : at + 40] = struct.pack("<Q", at)
    path.write_bytes(data)


def file_is(make: Callable[[Path], Any]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / "data" / "main_data.hdf5").unlink()
        make(folder / "data" / "main_data.hdf5")

    return change


def committed(group: h5py.Group, _old: np.ndarray) -> None:
    group["actions"] = np.dtype("f4")


def described_at_length(group: h5py.Group, old: np.ndarray) -> None:
    group["actions"] = old
    for i in range(8):
        group["actions"].attrs[f"x{i}"] = np.zeros(10_000, "u1")


REFERENCES = h5py.ref_dtype
DATASETS: dict[str, tuple[Callable[[Path], None], str]] = {
    "virtual, of itself": (replaced("actions", virtual(".", "/episode_0/actions")), "Episode 0 .*actions is stored elsewhere"),
    "virtual, of another episode": (replaced("actions", virtual(".", "/episode_1/actions")), "actions is stored elsewhere"),
    "virtual, of another file": (replaced("actions", virtual("/etc/passwd", "x")), "actions is stored elsewhere"),
    "external, of a file": (replaced("rewards", external("file")), "rewards is stored elsewhere"),
    "external, of a file, as bytes": (replaced("rewards", external("file", "i1")), "rewards is stored elsewhere"),
    "external, of a pipe": (replaced("rewards", external("fifo")), "rewards is stored elsewhere"),
    "a soft link": (replaced("rewards", moved(h5py.SoftLink("/episode_1/elsewhere"))), "rewards is a link to another place"),
    "a soft link to itself": (replaced("rewards", moved(h5py.SoftLink("/episode_0/rewards"))), "rewards is a link"),
    "an external link": (replaced("rewards", moved(h5py.ExternalLink("other.hdf5", "x"))), "rewards is a link"),
    "a committed type": (replaced("actions", committed), "actions is no array"),
    "a group": (replaced("actions", lambda group, old: group.create_group("actions")), "actions is no array"),
    "text": (with_types("actions", h5py.string_dtype()), "actions holds text, objects"),
    "numbers of many lengths": (with_types("actions", h5py.vlen_dtype("f4")), "actions holds text, objects"),
    "references": (with_types("rewards", REFERENCES), "rewards holds text, objects"),
    "compounds": (with_types("rewards", [("a", "f4"), ("b", "i2")]), "rewards holds text, objects"),
    "complex numbers": (with_types("rewards", "c8"), "rewards holds text, objects|complex64"),
    "an enumeration": (with_types("rewards", h5py.enum_dtype({"A": 0, "B": 1})), "rewards where there must be numbers"),
    "nothing": (replaced("rewards", lambda group, old: group.create_dataset("rewards", data=h5py.Empty("f4"))), "nothing"),
    "one number": (shaped("rewards", ()), "rewards holds text, objects or nothing"),
    "far more rows": (shaped("actions", (2**40, 2), chunks=(2**10, 2), compression="gzip"), "1099511627776 actions with"),
    "far more rows in all parts": (consistent_bomb, "unfolds to .*more than packing can do"),
    "huge chunks": (shaped("actions", chunks=(2**24, 2), maxshape=(None, 2), compression="gzip"), "stored in chunks of"),
    "a chunk that unfolds without end": (deflated_chunk, "has a packed chunk of 2,097,153 bytes"),
    "packed twice": (shaped("actions", chunks=(2, 2), compression="gzip", scaleoffset=3), "is packed by the filters"),
    "described at length": (replaced("actions", described_at_length), "is described in more than 65,536 bytes"),
    "an index that leads to itself": (index_of_itself, "the HDF5 library can't read it"),
    "a pipe": (file_is(os.mkfifo), "it is no regular file"),
    "a device": (file_is(lambda path: path.symlink_to("/dev/zero")), "it is no regular file"),
    "a folder": (file_is(os.mkdir), "can not be read"),
    "a link to another file": (file_is(lambda path: path.symlink_to("/etc/passwd")), "is not an HDF5 file"),
}


@pytest.mark.parametrize("name", DATASETS)
def test_a_hostile_dataset_is_one_sentence(name: str, dataset: Path) -> None:
    change, said = DATASETS[name]
    change(dataset)
    with pytest.raises(InputError, match=said) as caught:
        Demonstrations.load(dataset)
    assert str(dataset) in str(caught.value) and "\n" not in str(caught.value)


def test_commands_say_it_too(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    DATASETS["virtual, of itself"][0](dataset)
    assert "actions is stored elsewhere" in refused(["train", POINT_MASS, "--demos", str(dataset), "--out", "run"], capsys)


def test_a_dataset_that_never_ends_is_given_up(dataset: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(hdf5, "PATIENCE_SECONDS", 0.01)
    with pytest.raises(InputError, match="reading it did not end within 0 s"):
        Demonstrations.load(dataset)


def test_what_is_not_needed_is_never_read(dataset: Path) -> None:
    before = Demonstrations.load(dataset)
    with h5py.File(dataset / "data" / "main_data.hdf5", "r+") as file:
        virtual(".", "/episode_0/infos/actions")(file["episode_0"].create_group("infos"), np.zeros(3))
        file["episode_1"].create_dataset("infos", (2**40,), "f8", chunks=(1024,), compression="gzip")
        file["episode_2/more"] = h5py.ExternalLink("/etc/passwd", "x")
    assert Demonstrations.load(dataset).hash == before.hash


@pytest.mark.parametrize(
    "options", [{"compression": "gzip", "shuffle": True}, {"compression": "lzf"}, {"fletcher32": True}, {}]
)
@pytest.mark.parametrize("latest", [True, False])
def test_packed_arrays_and_newer_files_are_read(options: dict[str, Any], latest: bool, dataset: Path) -> None:
    before, path = Demonstrations.load(dataset), dataset / "data" / "main_data.hdf5"
    with h5py.File(path) as old, h5py.File(path.with_name("new"), "w", libver="latest" if latest else None) as new:
        for name in old:
            group = new.create_group(name)
            group.attrs.update(old[name].attrs)
            for part in ("observations", "actions", "rewards", "terminations", "truncations"):
                group.create_dataset(part, data=old[name][part][()], **options)
    path.with_name("new").replace(path)
    after = Demonstrations.load(dataset)
    assert after.hash == before.hash and [e.seed for e in after.episodes] == [e.seed for e in before.episodes]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"observation_space": "[" * 100_000}, "nested too deeply"),
        ({"observation_space": '{"type": "Dict", "subspaces": {"../x": {"type": "Box", "shape": [2]}}}'}, "there is no"),
        ({"observation_space": '{"type": "Box", "shape": [1e400]}'}, r"must be numbers \[inf\]"),
        ({"total_steps": [1]}, "steps in all, metadata.json says"),
        ({"total_episodes": 10**300}, "can not be read"),
        ({"env_spec": '{"id": 5}'}, "can not be read"),
        ({"pcil": {"task": ["x"]}}, "its task is no name"),
        ({"pcil": {"info": 3}}, "its info no table"),
        ({"pcil": [1]}, "can not be read"),
        ({"data_format": "arrow"}, "only hdf5 is read"),
        ({"data_format": {"a": "b" * 999}}, "only hdf5 is read"),
    ],
)
def test_hostile_metadata_is_one_sentence(changes: dict[str, Any], said: str, dataset: Path) -> None:
    path = dataset / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InputError, match=said):
        Demonstrations.load(dataset)


@pytest.mark.parametrize("part", ["observations", "actions", "rewards", "terminations"])
def test_a_change_of_any_array_is_noticed_by_its_checksum(part: str, dataset: Path) -> None:
    with h5py.File(dataset / "data" / "main_data.hdf5", "r+") as file:
        array = file[f"episode_1/{part}"]
        array[-1] = ~array[-1] if array.dtype == bool else array[-1] * 0.5 + 0.25
    with pytest.raises(InputError, match=r"does not hold what was saved there: its checksum is [0-9a-f]{64}, and"):
        Demonstrations.load(dataset)


def test_a_dataset_without_a_checksum_is_read_and_one_of_nonsense_refused(dataset: Path) -> None:
    path = dataset / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    assert metadata["pcil"].pop("hash") == Demonstrations.load(dataset).hash
    path.write_text(json.dumps(metadata))
    assert len(Demonstrations.load(dataset).episodes) == 4
    path.write_text(json.dumps(metadata | {"pcil": metadata["pcil"] | {"hash": ["\x1b"] * 999}}))
    with pytest.raises(InputError, match=r"metadata\.json says .* copy it again") as caught:
        Demonstrations.load(dataset)
    assert len(str(caught.value)) < 500


def test_another_process_reads_the_same(sound: Path) -> None:
    boxes = {"observations": [["observations", [4]]], "actions": [["actions", [2]]]}
    boxes |= {name: [[name, []]] for name in ("rewards", "terminations", "truncations")}
    path = sound / "data" / "main_data.hdf5"
    with h5py.File(path) as file:
        steps = sum(len(file[name]["rewards"]) for name in file)
        boxes["observations"][0][1] = [file["episode_0/observations"].shape[1]]
        boxes["actions"][0][1] = [file["episode_0/actions"].shape[1]]
    wanted = {"episodes": 4, "steps": steps, "boxes": boxes}
    here, there = list(hdf5.episodes(path, wanted)), hdf5.read(path, wanted)
    assert len(here) == len(there) == 4
    for (seed, parts), (other_seed, other_parts) in zip(here, there, strict=True):
        assert seed == other_seed and parts.keys() == other_parts.keys()
        for name, arrays in parts.items():
            np.testing.assert_array_equal(arrays, other_parts[name])


# --- Policies ---


def rewritten(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """The policy with some of its arrays replaced."""
    save_file(load_file(folder / "policy.safetensors") | arrays, folder / "policy.safetensors")


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


ARRAYS: dict[str, dict[str, np.ndarray]] = {
    "no features": {
        **{f"trunk.{name}": zeros(0) for name in ("bias", "scale", "offset")},
        "trunk.weight": zeros(4, 0),
        "head.weights.0": zeros(0, 4),
    },
    "no actions": {"head.weights.2": zeros(4, 0), "head.biases.2": zeros(0)},
    "no observations": {"trunk.weight": zeros(0, 4)},
    "a cube": {"trunk.weight": zeros(4, 4, 2)},
    "a layer of rank 3": {"head.weights.2": zeros(4, 2, 2), "head.biases.2": zeros(2, 2)},
    "whole numbers": {"trunk.bias": np.zeros(4, np.int64)},
    "too large for float32": {"trunk.bias": np.full(4, 1e300)},
}


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
def test_arrays_of_a_policy_that_do_not_fit_each_other_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as for users
    rewritten(policy(tmp_path / "policy", POINT_MASS), ARRAYS[name])
    with pytest.raises(InputError, match=r"The policy in .* is damaged \(ValueError"):
        load_policy(tmp_path / "policy")


def test_a_policy_for_another_environment_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for obs_dim, action_dim in ((7, 2), (4, 3)):
        Policy(Actor.init(obs_dim, action_dim, 4, 4, key=jax.random.key(0)), POINT_MASS).save(tmp_path / "policy")
        for words in (["evaluate", "policy"], ["record", "policy", "--out", "new"]):
            assert f"takes observations of {obs_dim} numbers and gives actions of {action_dim}" in refused(words, capsys)
    load_policy(policy(tmp_path / "policy", POINT_MASS)).check_fits(pcil.make_env(POINT_MASS))


def test_a_policy_whose_actions_are_no_numbers_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its numbers are finite, but the resulting actions are not."""
    folder = policy(tmp_path / "policy", POINT_MASS)
    loud = {
        name: np.full_like(array, 3e38) for name, array in load_file(folder / "policy.safetensors").items() if "head" in name
    }
    loud["head.weights.2"] = loud["head.weights.2"] * np.array([[1], [-1], [1], [-1]], np.float32)
    rewritten(folder, loud)
    assert cli.main(["evaluate", "policy"]) == 1
    error = capsys.readouterr().err
    assert "was to be given an action whose entry 0 is nan" in error and error.count("\n") == 1


def test_a_report_restores_no_networks_of_any_size(tmp_path: Path) -> None:
    demos = save_point_mass_demos(tmp_path)
    settings = flat(small_run(demos=demos).to_json()) | {"agent.hidden": 10**6, "agent.absorbing": False}
    with pytest.raises(InputError, match=r"networks of [\d,]+ numbers; at most"):
        representation.transitions(Source(tmp_path, settings, True), ROW)
