"""An exported policy acts like the policy, within the bounds of its environment, and one that can't is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import gymnasium
import jax
import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pcil
from pcil import cli, envs, export
from pcil.errors import InputError
from pcil.nets.networks import MLP, Actor, Normalizer, Trunk
from pcil.policy import SHIPPED, Policy, load_policy
from pcil.types import Spec

law = settings(deadline=None, derandomize=True, max_examples=40)


def make_policy(
    obs_dim: int, action_dim: int, weights: int = 0, *, normalized: bool = False, gain: float = 1.0, **info: Any
) -> Policy:
    """A policy with random numbers everywhere."""
    rng = np.random.default_rng(weights)

    def random(*shape: int) -> np.ndarray:
        return (gain * rng.normal(size=shape) / 4).astype(np.float32)

    scaling = Normalizer(20 * random(obs_dim), np.exp(random(obs_dim) * 12 / gain)) if normalized else None
    trunk = Trunk(random(obs_dim, 7), random(7), random(7), random(7), scaling)
    head = MLP((random(7, 16), random(16, 16), random(16, action_dim)), (random(16), random(16), random(action_dim)))
    return Policy(Actor(trunk, head), "toy/point_mass-v0", info)


def run(path: Path, obs: np.ndarray) -> np.ndarray:
    (action,) = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"]).run(["action"], {"observation": obs})
    return action


def refusal(call: Any) -> str:
    """The message of the `InputError` that `call` must raise, which must be one sentence."""
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)
    return str(caught.value)


@law
@given(
    st.integers(1, 9),
    st.integers(1, 5),
    st.integers(0, 1000),
    st.booleans(),
    st.sampled_from([0.1, 1.0, 4.0]),
    st.integers(1, 9),
)
def test_a_random_policy_is_exported_as_it_acts(
    tmp_path_factory: Any, obs_dim: int, action_dim: int, seed: int, normalized: bool, gain: float, batch: int
) -> None:
    """Compared with NumPy in float64, on the environment's bounds, which are asymmetrical and of all sizes."""
    rng = np.random.default_rng(seed)
    low = rng.normal(size=action_dim) * 3
    high = low + np.exp(rng.normal(size=action_dim) * 2)
    bounds = {"action_low": low.tolist(), "action_high": high.tolist()}
    policy = make_policy(obs_dim, action_dim, seed, normalized=normalized, gain=gain, **bounds)
    path = tmp_path_factory.mktemp("exported") / "policy.onnx"
    pcil.export_onnx(policy, path)
    obs = (rng.normal(size=(batch, obs_dim)) * 10 ** rng.uniform(-3, 3, (batch, 1))).astype(np.float32)
    action = run(path, obs)
    assert action.shape == (batch, action_dim) and action.dtype == np.float32
    assert (action >= low).all() and (action <= high).all()
    precise = jax.tree.map(lambda leaf: leaf.astype(np.float64), policy.actor)(obs.astype(np.float64), np)
    error = np.abs(action - (low + (precise + 1) / 2 * (high - low)))
    assert (error <= 5e-5 * (high - low) + 2e-7 * np.maximum(abs(low), abs(high))).all()


@pytest.mark.parametrize("task", sorted(path.name for path in SHIPPED.iterdir()))
def test_every_expert_that_ships_is_exported(task: str, tmp_path: Path) -> None:
    policy = load_policy(task)
    one = np.ones(policy.spec.action_dim)
    known = Policy(policy.actor, policy.task, policy.info | {"action_low": (-one).tolist(), "action_high": one.tolist()})
    assert 0 < pcil.export_onnx(known, tmp_path / "policy.onnx") <= 1e-5
    obs = np.random.default_rng(1).normal(size=(50, policy.spec.obs_dim)).astype(np.float32)
    np.testing.assert_allclose(run(tmp_path / "policy.onnx", obs), policy(obs), atol=1e-5)


class Constant(eqx.Module):
    """Gives the action `value`, whatever it is given, and keeps to what can be traced."""

    value: np.ndarray

    def __call__(self, obs: Any, xp: ModuleType = np) -> Any:
        return obs.sum(axis=-1, keepdims=True) * 0 + self.value.reshape(1, -1)


@pytest.mark.parametrize(
    ("inside", "outside"),
    [(-1, [-2, 10]), (1, [4, 12]), (0, [1, 11]), (0.5, [2.5, 11.5]), (-0.25, [0.25, 10.75]), (7, [4, 12]), (-9, [-2, 10])],
)
def test_actions_are_in_the_bounds_of_the_environment(inside: float, outside: list[float], tmp_path: Path) -> None:
    """By hand, for bounds from -2 to 4 and from 10 to 12; an action beyond -1 or 1 is clipped."""
    value = np.full(2, inside, np.float32)
    bounds = {"action_low": [-2.0, 10.0], "action_high": [4.0, 12.0]}
    assert pcil.export_onnx(Policy(Constant(value), "any", bounds, Spec(3, 2, 1)), tmp_path / "a.onnx") < 1e-6
    for batch in (1, 5):
        assert run(tmp_path / "a.onnx", np.ones((batch, 3), np.float32)).tolist() == [outside] * batch


def test_the_environment_is_given_the_action_that_it_would_get_from_us(tmp_path: Path) -> None:
    """An older policy does not know the bounds, so they are those of its environment: here those of Pendulum, [-2, 2]."""
    policy = Policy(make_policy(3, 1).actor, "Pendulum-v1")
    pcil.export_onnx(policy, tmp_path / "policy.onnx")
    obs = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_allclose(run(tmp_path / "policy.onnx", obs), 2 * policy(obs), atol=2e-5)
    ours, theirs = envs.make("Pendulum-v1"), gymnasium.make("Pendulum-v1")
    ours.reset(seed=0), theirs.reset(seed=0)
    for row, action in zip(obs, run(tmp_path / "policy.onnx", obs), strict=True):
        np.testing.assert_allclose(ours.step(policy(row))[0], theirs.step(action)[0], atol=1e-5)


@pytest.mark.parametrize("normalized", [False, True])
def test_extreme_observations_give_the_policys_actions(normalized: bool, tmp_path: Path) -> None:
    policy = make_policy(4, 2, normalized=normalized, action_low=[-1, -1], action_high=[1, 1])
    pcil.export_onnx(policy, tmp_path / "policy.onnx")
    sizes = [0, 1e-38, 1e-10, 1, 1e4, 1e10, *([3e38] if normalized else [])]  # without a normalizer, such an action is NaN
    obs = np.array([[s, -s, s, s] for s in sizes], np.float32)
    np.testing.assert_allclose(run(tmp_path / "policy.onnx", obs), policy(obs), atol=1e-5)


def test_the_file_says_what_it_is(tmp_path: Path) -> None:
    info = {"method": "bc", "frames": 20_000, "return_mean": 1.5, "action_repeat": 2, "seed": 3, "preset": None}
    pcil.export_onnx(make_policy(5, 2, action_low=[-1, 0], action_high=[1, 3], **info), tmp_path / "policy.onnx")
    model = onnx.load(tmp_path / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert said.pop("task") == "toy/point_mass-v0" and said.pop("method") == "bc"
    assert {name: json.loads(value) for name, value in said.items()} == {
        "frames": 20_000,
        "seed": 3,
        "return_mean": 1.5,
        "obs_dim": 5,
        "action_dim": 2,
        "action_repeat": 2,
        "action_low": [-1, 0],
        "action_high": [1, 3],
    }
    assert model.opset_import[0].version == 17 and model.ir_version == 8


# --- Refusals ---


class Cube(eqx.Module):
    """Uses a function of NumPy that is not in the table."""

    def __call__(self, obs: Any, xp: ModuleType = np) -> Any:
        return xp.cbrt(obs)


class Roll(eqx.Module):
    """Uses a function of NumPy that is none of its operators."""

    def __call__(self, obs: Any, xp: ModuleType = np) -> Any:
        return xp.roll(obs, 1)


class OnlyJax(eqx.Module):
    """Does not use the library that it is given."""

    def __call__(self, obs: Any, xp: ModuleType = np) -> Any:
        return jax.numpy.tanh(obs)


class Fixed(eqx.Module):
    """Does not use the observation."""

    def __call__(self, obs: Any, xp: ModuleType = np) -> Any:
        return xp.zeros(obs.shape)


class Indexing(eqx.Module):
    """Does what can't be traced, and raises whatever it likes."""

    def __call__(self, obs: Any, xp: ModuleType = np) -> Any:
        return obs[..., :2]


@pytest.mark.parametrize(
    ("actor", "why"),
    [
        (Cube(), "numpy.cbrt"),
        (Roll(), "numpy.roll"),
        (OnlyJax(), "numpy.shape"),
        (Fixed(), "depend"),
        (Indexing(), "TypeError"),
    ],
)
def test_an_actor_that_can_not_be_traced_is_refused(actor: Any, why: str, tmp_path: Path) -> None:
    bounds = {"action_low": [-1.0, -1.0], "action_high": [1.0, 1.0]}
    said = refusal(lambda: pcil.export_onnx(Policy(actor, "any", bounds, Spec(2, 2, 1)), tmp_path / "policy.onnx"))
    assert why in said and f"test_export:{type(actor).__name__} can't be exported" in said and "tanh" in said
    assert list(tmp_path.iterdir()) == []


def test_a_graph_that_acts_otherwise_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The operator of tanh is exchanged for another one that differs by up to a quarter."""
    policy = make_policy(3, 1, action_low=[-1], action_high=[1])
    monkeypatch.setitem(export.OPERATIONS, np.tanh, "Softsign")
    said = refusal(lambda: pcil.export_onnx(policy, tmp_path / "policy.onnx"))
    assert "would differ" in said and "1e-05 is allowed" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("shift", "refused"), [(0.0, False), (5e-6, False), (2e-5, True)])
def test_the_limit_is_one_hundred_thousandth(
    shift: float, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graph whose bounds are shifted by as much as that differs by as much."""
    exact, policy = export.in_bounds, make_policy(2, 1, gain=0.1, action_low=[-1], action_high=[1])
    monkeypatch.setattr(export, "in_bounds", lambda action, low, high: exact(action, low + shift, high + shift))
    if refused:
        assert "would differ" in refusal(lambda: pcil.export_onnx(policy, tmp_path / "policy.onnx"))
    else:
        assert abs(pcil.export_onnx(policy, tmp_path / "policy.onnx") - shift) < 1e-6


@pytest.mark.parametrize("name", ["policy", "policy.pt", "folder.onnx"])
def test_the_name_of_the_file_says_what_it_is(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder.onnx").mkdir()
    assert "name ends in .onnx" in refusal(lambda: pcil.export_onnx(make_policy(2, 2), tmp_path / name))


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_missing_package_is_named(package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    said = refusal(lambda: pcil.export_onnx(make_policy(2, 2), tmp_path / "policy.onnx"))
    assert f"needs the package {package} " in said and "'.[onnx]'" in said


def test_bounds_of_another_number_are_refused(tmp_path: Path) -> None:
    policy = make_policy(2, 2, action_low=[-1], action_high=[1])
    assert "2 numbers and says that they have 1" in refusal(lambda: pcil.export_onnx(policy, tmp_path / "policy.onnx"))


def test_what_a_file_names_is_not_imported_for_its_bounds(tmp_path: Path) -> None:
    policy = Policy(make_policy(2, 2).actor, "evil_module:Task-v0")
    assert "--trust evil_module" in refusal(lambda: pcil.export_onnx(policy, tmp_path / "policy.onnx"))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_policy(2, 2).save(tmp_path / "policy")
    assert cli.main(["export", "policy", "--out", "new/policy.onnx"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"toy/point_mass-v0: {Path('new') / 'policy.onnx'}, largest error ") and out.count("\n") == 1
    assert run(Path("new/policy.onnx"), np.zeros((1, 2), np.float32)).shape == (1, 2)
    assert cli.main(["export", "policy", "--out", "policy"]) == 2 and "ends in .onnx" in capsys.readouterr().err
    assert cli.main(["export", "nowhere", "--out", "policy.onnx"]) == 2 and "walker_walk" in capsys.readouterr().err
