"""The doctor says what is wrong and what to do, and fails only if training can't work."""

from __future__ import annotations

import pytest

from pcil import cli
from pcil.cli import doctor


def broken() -> str:
    raise RuntimeError("it is [/bold] gone\nin two lines")


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "500")


def test_this_machine_can_train(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.count("│") >= 4]
    assert len(rows) == len(doctor.CHECKS)
    for (name, _, remedy, needed), row in zip(doctor.CHECKS, rows, strict=True):
        mark, part, found, advice = (cell.strip() for cell in row.strip("│").split("│"))
        assert part == name and found
        assert mark == "ok" or not needed
        assert advice == ("" if mark == "ok" else remedy)


@pytest.mark.parametrize(("needed", "code", "mark"), [(True, 1, "wrong"), (False, 0, "absent")])
def test_only_what_training_needs_fails(
    needed: bool, code: int, mark: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The exception and the remedy are shown literally: brackets are not markup."""
    checks = (("well", lambda: "found it", "-", True), ("ill", broken, "pip install '.[report]' in a clone", needed))
    monkeypatch.setattr(doctor, "CHECKS", checks)
    assert doctor.doctor() == code
    out = capsys.readouterr().out
    assert "ok" in out and "found it" in out
    assert mark in out and "RuntimeError: it is [/bold] gone" in out and "two lines" not in out
    assert "pip install '.[report]' in a clone" in out


def test_mujoco_4_is_said_to_be_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.metadata, "version", lambda name: "4.0.0" if name == "mujoco" else "1.0.50")
    (look,) = (look for name, look, _, needed in doctor.CHECKS if name == "physics" and needed)
    with pytest.raises(RuntimeError, match=r"mujoco 4\.0\.0 does not work with dm-control 1\.0\.50"):
        look()


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    (look,) = (look for name, look, _, _ in doctor.CHECKS if name == "compilation cache")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", f"{tmp_path}/deep/cache")
    assert look() == f"{tmp_path}/deep/cache"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", f"{tmp_path}/home")
    assert look() == f"{tmp_path}/home/pcil/jax"


def test_without_deepmind_control_the_physics_are_well(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "dm-control":
            raise doctor.metadata.PackageNotFoundError(name)
        return "3.17.0"

    monkeypatch.setattr(doctor.metadata, "version", version)
    (look,) = (look for name, look, _, _ in doctor.CHECKS if name == "physics")
    assert look() == "mujoco 3.17.0, no dm-control"
