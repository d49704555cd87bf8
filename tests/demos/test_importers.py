"""Other people's files become the demonstrations that they hold: each format, written after its documentation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import hypothesis
import numpy as np
import pyarrow
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

from pcil import cli
from pcil.demos import Demonstrations, importers
from pcil.demos.importers.tables import Keys
from pcil.errors import InputError
from pcil.types import Episode

OBS, ACTION = 3, 2


def episode(seed: int, steps: int, *, terminated: bool = False) -> Episode:
    rng = np.random.default_rng(seed)
    obs, action = rng.normal(size=(steps + 1, OBS)), rng.uniform(-1, 1, (steps, ACTION))
    return Episode(obs.astype(np.float32), action.astype(np.float32), rng.normal(size=steps), terminated)


def flat(episodes: list[Episode]) -> dict[str, np.ndarray]:
    """The flat arrays of D4RL: a row for each step, and where episodes end."""
    ends = np.concatenate([np.arange(len(e)) == len(e) - 1 for e in episodes])
    over = np.concatenate([np.full(len(e), e.terminated) for e in episodes])
    rows = {"observations": [e.obs[:-1] for e in episodes], "next_observations": [e.obs[1:] for e in episodes]}
    rows |= {"actions": [e.action for e in episodes], "rewards": [e.reward for e in episodes]}
    return {name: np.concatenate(parts) for name, parts in rows.items()} | {
        "terminals": ends & over,
        "timeouts": ends & ~over,
    }


def write_npz(place: Path, episodes: list[Episode]) -> Path:
    np.savez(place / "all.npz", **flat(episodes))
    return place / "all.npz"


def write_npz_folder(place: Path, episodes: list[Episode]) -> Path:
    for i, e in enumerate(episodes):
        flags = {"terminals": np.arange(len(e)) == (len(e) - 1 if e.terminated else -1)}
        np.savez(place / f"episode_{i}.npz", obs=e.obs, acts=e.action, rews=e.reward, **flags)
    return place


def write_d4rl(place: Path, episodes: list[Episode]) -> Path:
    with h5py.File(place / "d4rl.hdf5", "w") as file:
        for name, array in flat(episodes).items():
            file.create_dataset(name, data=array, compression="gzip")
        file["metadata/policy/weight"] = np.zeros((2, 3, 4))
        file["infos/note"] = "text"
    return place / "d4rl.hdf5"


def write_robomimic(place: Path, episodes: list[Episode]) -> Path:
    with h5py.File(place / "low_dim.hdf5", "w") as file:
        for i, e in enumerate(episodes):
            for name, states in (("obs", e.obs[:-1]), ("next_obs", e.obs[1:])):
                file[f"data/demo_{i}/{name}/a_position"], file[f"data/demo_{i}/{name}/b_speed"] = states[:, :2], states[:, 2]
                file[f"data/demo_{i}/{name}/camera_image"] = np.zeros((len(e), 4, 4, 3), np.uint8)
            file[f"data/demo_{i}/actions"], file[f"data/demo_{i}/rewards"] = e.action, e.reward
            file[f"data/demo_{i}/dones"] = (np.arange(len(e)) == (len(e) - 1 if e.terminated else -1)).astype(int)
        file["data"].attrs["env_args"] = "{}"
    return place / "low_dim.hdf5"


def write_csv(place: Path, episodes: list[Episode]) -> Path:
    """A row for each state, so the last one of an episode has an action that leads nowhere."""
    lines = ["time,episode,obs_0,obs_1,obs_2,action_0,action_1,reward,note"]
    for i, e in enumerate(episodes):
        for t in range(len(e) + 1):
            numbers = [0.05 * t, i, *e.obs[t].tolist(), *e.action[min(t, len(e) - 1)].tolist(), e.reward[min(t, len(e) - 1)]]
            lines.append(",".join(map(repr, map(float, numbers))) + ",text")
    (place / "arm.csv").write_text("\n".join(lines) + "\n")
    return place / "arm.csv"


def write_lerobot(place: Path, episodes: list[Episode], version: str) -> Path:
    features = {name: {"dtype": "float32", "shape": [size]} for name, size in (("observation.state", OBS), ("action", ACTION))}
    features |= {name: {"dtype": "float32", "shape": [1]} for name in ("next.reward", "timestamp")}
    features |= {name: {"dtype": "int64", "shape": [1]} for name in ("episode_index", "frame_index")}
    features |= {"observation.images.top": {"dtype": "video", "shape": [3, 48, 64]}, "task": {"dtype": "string", "shape": [1]}}
    info = {"codebase_version": version, "fps": 20, "robot_type": "so100", "features": features}
    tables = []
    for i, e in enumerate(episodes):
        rows = len(e) + 1
        columns: dict[str, Any] = {"observation.state": e.obs.tolist(), "action": [*e.action.tolist(), [0.0] * ACTION]}
        columns |= {"next.reward": [*e.reward.tolist(), 0.0], "timestamp": [0.05 * t for t in range(rows)]}
        columns |= {"episode_index": [i] * rows, "frame_index": list(range(rows)), "task": ["reach"] * rows}
        tables.append(pyarrow.table(columns))
    (place / "meta").mkdir()
    (place / "meta" / "info.json").write_text(json.dumps(info))
    (place / "data" / "chunk-000").mkdir(parents=True)
    if version == "v2.1":
        for i, table in enumerate(tables):
            parquet.write_table(table, place / "data" / "chunk-000" / f"episode_{i:06}.parquet")
    else:
        parquet.write_table(pyarrow.concat_tables(tables[::-1]), place / "data" / "chunk-000" / "file-000.parquet")
    return place


def write_minari(place: Path, episodes: list[Episode]) -> Path:
    return Demonstrations("arm", tuple(episodes), {}).save(place / "dataset")


WRITERS: dict[str, tuple[Callable[[Path, list[Episode]], Path], bool]] = {
    "npz": (write_npz, True),
    "folder of npz": (write_npz_folder, True),
    "d4rl": (write_d4rl, True),
    "robomimic": (write_robomimic, True),
    "csv": (write_csv, False),
    "lerobot 2.1": (lambda place, episodes: write_lerobot(place, episodes, "v2.1"), False),
    "lerobot 3": (lambda place, episodes: write_lerobot(place, episodes, "v3.0"), False),
    "minari": (write_minari, True),
}
"""Each writer, and whether its format says how an episode ended."""


@pytest.mark.parametrize("name", WRITERS)
@hypothesis.settings(max_examples=4, deadline=None, suppress_health_check=list(hypothesis.HealthCheck))
@given(st.lists(st.tuples(st.integers(2, 12), st.booleans()), min_size=1, max_size=12))
def test_what_was_written_is_read(name: str, tmp_path_factory: pytest.TempPathFactory, parts: list[tuple[int, bool]]) -> None:
    write, ends = WRITERS[name]
    episodes = [episode(i, steps, terminated=over and ends) for i, (steps, over) in enumerate(parts)]
    found = importers.load([write(tmp_path_factory.mktemp("source"), episodes)])
    assert len(found.demos.episodes) == len(episodes) and found.demos.has_actions and found.demos.has_rewards
    for got, expected in zip(found.demos.episodes, episodes, strict=True):
        assert np.allclose(got.obs, expected.obs, atol=1e-6) and np.allclose(got.action, expected.action, atol=1e-6)
        assert np.allclose(got.reward, expected.reward, atol=1e-5) and got.terminated == expected.terminated


def test_what_was_found_and_left_out_is_said(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
    episodes = [episode(0, 4), episode(1, 5)]
    told = "\n".join(importers.load([write_lerobot(tmp_path / "a", episodes, "v3.0")]).told)
    assert "Read 2 episodes, 9 steps, from LeRobot 3.0." in told and "observation.images.top, which is video" in told
    assert "Time step: 0.05 s." in told and "the last action of 2 episodes" in told
    told = "\n".join(importers.load([write_robomimic(tmp_path / "b", episodes)]).told)
    assert "Observations: a_position, b_speed." in told and "obs/camera_image, which is no rows of numbers" in told
    told = "\n".join(importers.load([write_csv(tmp_path / "c", episodes)]).told)
    assert "Left out: note, which no key names." in told and "Time step: 0.05 s." in told


@pytest.mark.parametrize("format_", ["npz", "csv", "d4rl", "robomimic"])
def test_columns_that_nothing_uses_are_named_and_counters_are_not(tmp_path: Path, format_: str) -> None:
    columns = {"obs": np.zeros(4), "torque": np.zeros(4), "actions": np.zeros(4), "index": np.arange(4), "t": np.arange(4)}
    source = tmp_path / f"one.{format_}"
    if format_ == "npz":
        np.savez(source, **columns)
    elif format_ == "csv":
        source.write_text("\n".join([",".join(columns), *("0,0,0,0,0" for _ in range(4))]) + "\n")
    else:
        columns = {"obs/obs" if format_ == "robomimic" and name == "obs" else name: rows for name, rows in columns.items()}
        with h5py.File(source, "w") as file:
            for name, rows in columns.items():
                file[f"data/demo_0/{name}" if format_ == "robomimic" else name] = rows
    left = [line for line in importers.load([source]).told if "no key" in line]
    assert left == ["Left out: torque, which no key names."]


SPELLINGS: dict[str, Callable[[str], str | bytes]] = {
    "byte order mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "Windows": lambda text: text.replace("\n", "\r\n"),
    "semicolons, decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "tabs": lambda text: text.replace(",", "\t"),
    "spaces": lambda text: text.replace(",", "  "),
    "quotes": lambda text: "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.splitlines()),
    "empty lines": lambda text: "\n" + text.replace("\n", "\n\n") + "\n\n",
    "a comma at the end": lambda text: text.replace("\n", ",\n"),
    "an index without a name": lambda text: "".join(
        f"{i - 1 if i else ''},{line}\n" for i, line in enumerate(text.splitlines())
    ),
    "capitals": lambda text: text.replace("obs", "Obs").replace("action", "ACTION").replace("done", "Done"),
    "words": lambda text: text.replace(",0\n", ",False\n").replace(",1\n", ",True\n"),
    "a comment above": lambda text: "# of the arm\n#\n" + text,
    "NumPy": lambda text: "# " + text,
    "NumPy, no commas": lambda text: "# of the arm\n# " + text.replace(",", " "),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_csv_file_is_the_same_however_it_is_spelled(spelling: str, tmp_path: Path) -> None:
    """Two episodes of three and two rows; the last action of each is left out, since no state follows it."""
    obs = [[0.5, -1.25], [1e-3, 2.0], [3.5, 4.0], [7.0, 8.5], [9.0, -0.5]]
    lines = [f"{a},{b},{a / 10},{int(i == 2)}" for i, (a, b) in enumerate(obs)]
    text = SPELLINGS[spelling]("\n".join(["obs_0,obs_1,action,done", *lines]) + "\n")
    (tmp_path / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    found = importers.load([tmp_path / "a.csv"])
    assert [e.obs.tolist() for e in found.demos.episodes] == [np.float32(obs[:3]).tolist(), np.float32(obs[3:]).tolist()]
    assert np.array_equal(found.demos.action[:, 0], np.float32([0.05, 1e-4, 0.7])) and "no key" not in "".join(found.told)


@pytest.mark.parametrize("format_", ["csv", "npz", "d4rl"])
@pytest.mark.parametrize("other", [{}, {"done": [0, 1, 0, 0, 0, 0, 0, 0]}, {"episode": [0, 0, 0, 0, 0, 1, 1, 1]}], ids=str)
def test_an_episode_begins_where_time_begins_again(tmp_path: Path, format_: str, other: dict[str, list[int]]) -> None:
    """Three recordings one after the other in one file; a termination ends an episode, too, and numbers of episodes decide."""
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.0, 0.1, 0.0, 0.1])
    columns = {"Time": time, "obs": np.arange(8.0), "action": np.zeros(8)} | {k: np.array(v) for k, v in other.items()}
    source = tmp_path / f"a.{format_}"
    if format_ == "npz":
        np.savez(source, **columns)
    elif format_ == "csv":
        rows = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
        source.write_text("\n".join([",".join(columns), *rows]))
    else:
        with h5py.File(source, "w") as file:
            for name, column in columns.items():
                file[name] = column
    found = importers.load([source])
    starts = {"": [0, 4, 6], "done": [0, 2, 4, 6], "episode": [0, 5]}[next(iter(other), "")]
    assert [float(e.obs[0, 0]) for e in found.demos.episodes] == starts
    assert ("Episodes: where Time begins again." in found.told) == ("episode" not in other)
    assert not any("no key" in line for line in found.told)


def test_dates_are_no_times(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,obs\n" + "".join(f"2026-11-2{i} 10:00,{i}\n" for i in range(4)))
    found = importers.load([tmp_path / "a.csv"])
    assert found.demos.num_steps == 3 and "Left out: time, which no key names." in found.told


def test_times_with_holes_are_no_times_and_nothing_else_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,obs\n0,1\n1,2\n0,3\n,4\n")
    found = importers.load([tmp_path / "a.csv"])
    assert len(found.demos.episodes) == 1 and not any("begins again" in line for line in found.told)


def test_thousands_are_no_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('obs_0,obs_1\n1,2\n"1,234",2\n')
    with pytest.raises(InputError, match=r"Line 3 of .* has no number in the columns obs"):
        importers.load([tmp_path / "a.csv"])


@pytest.mark.parametrize("version", ["2.1", "3.0"])
def test_files_of_lerobots_own_writer_are_read(version: str) -> None:
    """Both files were written by experiments/peers/lerobot_files.py, whose numbers follow from episode and time."""
    found = importers.load([Path(__file__).parent / "lerobot" / version])
    for number, (got, steps) in enumerate(zip(found.demos.episodes, (5, 4), strict=True)):
        times = np.arange(steps)
        assert np.array_equal(got.obs, np.stack([np.full(steps, number), times, times / 2], axis=1))
        assert np.allclose(got.action, np.stack([times, -times], axis=1)[:-1] / 10, atol=1e-7)
        assert np.array_equal(got.reward, times[:-1]) and not got.terminated
    told = "\n".join(found.told)
    assert f"Read 2 episodes, 7 steps, from LeRobot {version}." in told and "Time step: 0.05 s." in told
    assert "Left out: observation.environment_state, which no key names." in told and "timestamp" not in told


def test_actions_get_their_bounds(tmp_path: Path) -> None:
    """At bounds of -2 and 6, the action 4 is 0.5."""
    np.savez(tmp_path / "one.npz", obs=np.zeros((3, 1)), action=np.array([[4.0], [-2.0]]))
    with pytest.raises(InputError, match=r"The actions go from -2 to 4, beyond their bounds \[-1, 1\]; give those of the"):
        importers.load([tmp_path / "one.npz"])
    found = importers.load([tmp_path / "one.npz"], bounds=(-2, 6)).demos
    assert found.action.tolist() == [[0.5], [-1.0]] and found.origin.action_high == [6.0] and not found.has_rewards
    assert importers.load([tmp_path / "one.npz"], clip=True).demos.action.tolist() == [[1.0], [-1.0]]


def test_a_terminal_whose_action_is_left_out_is_none(tmp_path: Path) -> None:
    """Three states and three actions without the state after the last one: two steps, and the end was never reached."""
    np.savez(tmp_path / "one.npz", obs=np.zeros((3, 1)), action=np.zeros((3, 1)), dones=[0, 0, 1])
    (only,) = importers.load([tmp_path / "one.npz"]).demos.episodes
    assert len(only) == 2 and not only.terminated


def test_states_alone_several_shapes_and_named_keys(tmp_path: Path) -> None:
    many = np.random.default_rng(0).normal(size=(4, 6, 2))
    np.savez(tmp_path / "a.npz", position=many, unused=np.zeros(3), objects=np.array([{}, None], dtype=object))
    found = importers.load([tmp_path / "a.npz"], Keys(obs=["position"])).demos
    assert len(found.episodes) == 4 and not found.has_actions and np.allclose(found.episodes[2].obs, many[2])
    np.savez(tmp_path / "b.npz", observations=many.reshape(24, 2), episode_ends=[5, 24])
    assert [len(e) for e in importers.load([tmp_path / "b.npz"]).demos.episodes] == [4, 18]


def test_sources_are_merged_in_their_order(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    first, second = episode(1, 3), episode(2, 4)
    found = importers.load([write_npz(tmp_path / "a", [first]), write_d4rl(tmp_path / "b", [second])]).demos
    assert [len(e) for e in found.episodes] == [3, 4]
    np.savez(tmp_path / "c.npz", obs=np.zeros((3, 5)), action=np.zeros((2, 2)), reward=np.zeros(2))
    with pytest.raises(InputError, match="The sources don't agree: their observations have 3 and 5 numbers"):
        importers.load([tmp_path / "a" / "all.npz", tmp_path / "c.npz"])


def test_parts_of_the_episodes_are_taken() -> None:
    episodes = tuple(
        Episode(np.zeros((2, 1), np.float32), np.zeros((1, 1), np.float32), np.array([float(r)]), False) for r in range(6)
    )
    held = Demonstrations("arm", episodes[::-1], {})
    assert held.best(2).returns.tolist() == [5, 4] and held.at_least(4).returns.tolist() == [5, 4]
    chosen = held.choose(3, seed=1)
    assert len(chosen.episodes) == 3 and chosen.returns.tolist() == sorted(set(chosen.returns), reverse=True)
    assert {tuple(held.choose(3, seed=s).returns) for s in range(9)} != {tuple(chosen.returns)}
    with pytest.raises(InputError, match="has a return of at least 9"):
        held.at_least(9)


def test_the_command_imports_and_the_result_trains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_csv(tmp_path, [episode(i, 5 + i) for i in range(4)])
    out = tmp_path / "arm"
    assert cli.main(["import", str(source), "--out", str(out), "--task", "arm", "--best", "2"]) == 0
    text = capsys.readouterr().out
    assert "Read 4 episodes" in text and f"Dataset: {out} (2 of 4 episodes); pcil demos {out} says more." in text
    held = Demonstrations.load(out)
    assert held.task == "arm" and len(held.episodes) == 2 and held.origin.step_seconds == pytest.approx(0.05)


def bad(name: str, place: Path) -> list[str]:
    """The arguments of an import that can't be done."""
    file = place / "file"
    if name == "nothing":
        return [str(file)]
    if name == "text":
        file.write_text("hello")
    elif name == "header":
        file = place / "a.csv"
        file.write_text("1,2\n3,4\n")
    elif name == "ragged":
        file = place / "a.csv"
        file.write_text("obs_0,obs_1\n1,2\n3\n")
    elif name == "no rows":
        file = place / "a.csv"
        file.write_text("obs_0,action_0\n")
    elif name == "hole":
        file = place / "a.csv"
        file.write_text("obs_0,action_0\n1,0\n,0\n3,0\n")
    elif name == "no observations":
        file = place / "a.npz"
        np.savez(file, numbers=np.zeros((3, 2)))
    elif name == "lengths":
        file = place / "a.npz"
        np.savez(file, obs=np.zeros((9, 2)), action=np.zeros((3, 1)))
    elif name == "one row":
        file = place / "a.npz"
        np.savez(file, obs=np.zeros((1, 2)))
    elif name == "hdf5":
        file.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    elif name == "link":
        file = place / "a.hdf5"
        with h5py.File(file, "w") as held:
            held["observations"] = h5py.ExternalLink("/etc/passwd", "/")
    elif name == "lerobot":
        (place / "meta").mkdir()
        (place / "meta" / "info.json").write_text("{}")
        file = place
    return [str(file)]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nothing", "There is no file or folder"),
        ("text", "is nothing that can be imported"),
        ("header", "must have a different name for each column"),
        ("ragged", "rows of different lengths: line 3 has 1, and the header 2"),
        ("hole", "Line 3 of"),
        ("no rows", "has no rows below its header of 2 columns"),
        ("no observations", "has no observations: none of its columns (numbers)"),
        ("lengths", "has 9 observations"),
        ("one row", "There is no episode of at least one step"),
        ("hdf5", "can't be read as HDF5"),
        ("link", "has no observations"),
        ("lerobot", "is no LeRobot dataset that can be read"),
    ],
)
def test_bad_sources_are_one_sentence(name: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["import", *bad(name, tmp_path), "--out", str(tmp_path / "out")]) == 2
    out, err = capsys.readouterr()
    assert said in err and err.count("\n") == 1 and not out and not (tmp_path / "out").exists()
