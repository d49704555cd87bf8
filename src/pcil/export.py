"""Policies as ONNX files, which run wherever ONNX Runtime does, without this package, JAX or the environment.

The graph is traced: the actor is called with `np` on a stand-in for the observations that notes each operation as it is
computed. So the file does what the policy's own code does, for every actor that keeps to the operations of `OPERATIONS`.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

import pcil
from pcil import envs, modules
from pcil.errors import InputError
from pcil.policy import Policy

OPSET, IR_VERSION = 17, 8
"""Versions of ONNX that also older runtimes read, from ONNX Runtime 1.12 on."""
TOLERANCE = 1e-5
"""The largest error of an exported policy beyond the policy's own rounding, for actions scaled to [-1, 1]."""
MOST_ROUNDING = 1e-3
"""A policy whose float32 actions differ by more from its float64 actions overflows there; this does not count as rounding."""
OPERATIONS = {
    np.add: "Add",
    np.subtract: "Sub",
    np.multiply: "Mul",
    np.divide: "Div",
    np.matmul: "MatMul",
    np.negative: "Neg",
    np.absolute: "Abs",
    np.exp: "Exp",
    np.log: "Log",
    np.sqrt: "Sqrt",
    np.tanh: "Tanh",
    np.sin: "Sin",
    np.cos: "Cos",
    np.maximum: "Max",
    np.minimum: "Min",
}
"""The functions of NumPy that an actor may use, and ONNX's operators for them; it may also call the method `sum`."""
SCALES = (0.0, 1e-30, 1e-8, 1e-4, 1e-2, 0.1, 1.0, 3.0, 10.0, 1e2, 1e4, 1e8, 1e30)
"""The exported policy is compared with the policy on observations of these sizes."""


class _Unsupported(Exception):
    """The actor uses an operation that is not among `OPERATIONS`."""


class _Graph:
    """The nodes and the constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """The name of a new constant."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(self, operator: str, value: np.ndarray, *inputs: Any, output: str | None = None, **attributes: Any) -> _Traced:
        """The result of a new node; `value` is what NumPy computes for it, and `inputs` are names, traced arrays or numbers."""
        from onnx import helper

        names = [x.name if isinstance(x, _Traced) else x if isinstance(x, str) else self.constant(x) for x in inputs]
        name = output or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [name], **attributes))
        return _Traced(self, name, value)


class _Traced(NDArrayOperatorsMixin):
    """An array of a graph, with the value that it has for an example; NumPy passes operations on it to `__array_ufunc__`."""

    def __init__(self, graph: _Graph, name: str, value: np.ndarray) -> None:
        self.graph, self.name, self.value = graph, name, value
        self.shape, self.ndim, self.dtype = value.shape, value.ndim, value.dtype

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **options: Any) -> _Traced:
        if function not in OPERATIONS or method != "__call__" or options:
            raise _Unsupported(f"it uses numpy.{function.__name__}")
        value = function(*(x.value if isinstance(x, _Traced) else x for x in inputs))
        return self.graph.node(OPERATIONS[function], value, *inputs)

    def __array_function__(self, function: Any, *_: Any) -> Any:
        raise _Unsupported(f"it uses numpy.{function.__name__}")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise _Unsupported("it makes an array of another library of the observations")

    def sum(self, axis: int, keepdims: bool = False) -> _Traced:
        """The sum along an axis."""
        value = self.value.sum(axis=axis, keepdims=keepdims)
        axes = self.graph.constant([axis], np.int64)
        return self.graph.node("ReduceSum", value, self, axes, keepdims=int(keepdims))


def in_bounds(action: Any, low: np.ndarray, high: np.ndarray) -> Any:
    """Actions in [-1, 1], rescaled to the box from `low` to `high` and clipped to it."""
    centre, half = (low / 2 + high / 2).astype(np.float32), (high / 2 - low / 2).astype(np.float32)
    lowest, highest = low.astype(np.float32), high.astype(np.float32)
    lowest = np.where(lowest < low, np.nextafter(lowest, highest), lowest)  # rounded to the inside
    highest = np.where(highest > high, np.nextafter(highest, lowest), highest)
    return np.minimum(np.maximum(action * half + centre, lowest), highest)


def export_onnx(policy: Policy, path: str | Path, trust: Sequence[str] = ()) -> float:
    """Write a policy as an ONNX file and return its largest error.

    The file maps `observation` [batch, obs], float32 in the environment's units, to `action` [batch, action], float32 within
    the bounds of the environment's own action space. Observations are normalized inside where the policy does that. The
    bounds are the policy's `action_bounds`; for an older policy without them, they are those of its environment, which is
    then made. `trust` are the modules that the policy may name for that.

    The error is the largest difference from the policy, for actions scaled to [-1, 1], over random and extreme observations.
    `InputError` if one is above `TOLERANCE` and is no rounding, if the actor uses an operation that is not among `OPERATIONS`,
    or if the packages onnx and onnxruntime are not installed; then no file is written. Rounding is that of the bounds to
    float32, and that of the policy, which is the difference from its actions in float64.
    """
    path = Path(path)
    if path.suffix != ".onnx" or path.is_dir():
        raise InputError(f"The policy can't be exported to {path}; give a file whose name ends in .onnx.")
    for package in ("onnx", "onnxruntime"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise InputError(
                f"Exporting a policy needs the package {package} ({error}): pip install onnx onnxruntime, or pip install "
                "'.[onnx]' in a clone."
            ) from error
    low, high = _bounds(policy, trust)
    content = _model(policy, low, high).SerializeToString()
    error, beyond_rounding = _errors(policy, content, low, high)
    if not beyond_rounding <= TOLERANCE:
        raise InputError(
            f"The exported policy for {policy.task} would differ from the policy by up to {error:.1e} for actions scaled to "
            f"[-1, 1], where {TOLERANCE:.0e} is allowed; nothing was written."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".onnx.tmp")
    partial.write_bytes(content)
    partial.replace(path)
    return error


def _bounds(policy: Policy, trust: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of the environment's own actions, in float64."""
    if (known := policy.action_bounds) is not None:
        if len(known[0]) != policy.spec.action_dim:
            raise InputError(
                f"The policy for {policy.task} gives actions of {policy.spec.action_dim} numbers and says that they have "
                f"{len(known[0])} bounds; train or copy it again."
            )
        return known
    modules.admit(f"The policy for {policy.task}", modules.of_task(policy.task, policy.env_kwargs), trust)
    with envs.opened(policy.task, env_kwargs=policy.env_kwargs) as env:
        policy.check_fits(env)
        box = envs.origin(env)
    return np.array(box.action_low, np.float64), np.array(box.action_high, np.float64)


def _model(policy: Policy, low: np.ndarray, high: np.ndarray) -> Any:
    """The checked model; `InputError` if the actor can't be traced."""
    import onnx
    from onnx import TensorProto, helper

    graph, spec, kind = _Graph(), policy.spec, type(policy.actor)
    try:
        action = policy.actor(_Traced(graph, "observation", np.zeros((1, spec.obs_dim), np.float32)), np)
        if not isinstance(action, _Traced) or action.shape != (1, spec.action_dim):
            raise _Unsupported("its action does not depend on the observation, or has another size")
        bounded = in_bounds(action, low, high)
    except Exception as error:  # the actor may be a user's own and may raise anything
        why = error if isinstance(error, _Unsupported) else f"{type(error).__name__}: {error}"
        usable = ", ".join(function.__name__ for function in OPERATIONS)
        raise InputError(
            f"The actor {kind.__module__}:{kind.__qualname__} can't be exported ({why}); with xp=numpy its __call__ may use "
            f"{usable}, and the method sum."
        ) from error
    graph.node("Identity", bounded.value, bounded, output="action")
    sizes = {"observation": spec.obs_dim, "action": spec.action_dim}
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in sizes.items()]
    made = helper.make_graph(graph.nodes, "policy", ends[:1], ends[1:], graph.constants)
    versions = {"opset_imports": [helper.make_opsetid("", OPSET)], "ir_version": IR_VERSION}
    model = helper.make_model(made, producer_name="pcil", producer_version=pcil.__version__, **versions)
    helper.set_model_props(model, _metadata(policy, low, high))
    onnx.checker.check_model(model, full_check=True)
    return model


def _metadata(policy: Policy, low: np.ndarray, high: np.ndarray) -> dict[str, str]:
    """What the file says about the policy; every value is text, and JSON where it is not a name."""
    names = ("method", "preset", "seed", "frames", "return_mean", "env_kwargs")
    known = {"task": policy.task} | {name: policy.info[name] for name in names if policy.info.get(name) is not None}
    known |= policy.spec._asdict() | {"action_low": low.tolist(), "action_high": high.tolist()}
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in known.items()}


def _errors(policy: Policy, content: bytes, low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """The largest difference between model and policy over `probes`, for actions scaled to [-1, 1], and what the largest one
    is beyond the policy's own rounding. The environment refuses actions that are not finite, so these are left out."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    errors, many, half = [np.zeros(2)], probes(policy), (high - low) / 2
    spacing = np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(np.float32)) / half  # of float32 within the bounds
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        for obs in (many, many[:1], many[-1:]):
            action = np.asarray(policy(obs), np.float64)
            got = np.asarray(session.run(["action"], {"observation": obs})[0])
            expected = (low + high) / 2 + np.clip(action, -1, 1) * half
            error = np.abs(got - expected) / half
            pairs = np.stack([error, error - _rounding(policy, obs, action) - spacing])
            errors.append(pairs[:, np.isfinite(action).all(axis=-1)].max(axis=(1, 2), initial=0.0))
    except Exception as error:  # such as a batch of another size than the example that was traced
        raise InputError(f"The exported policy for {policy.task} can't be run by ONNX Runtime ({error}).") from error
    largest, beyond_rounding = np.max(errors, axis=0)
    return float(largest), float(beyond_rounding)


def _rounding(policy: Policy, obs: np.ndarray, action: np.ndarray) -> Any:
    """The difference of the policy's actions from those that it has in float64; 0 where that is no rounding."""
    precise = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64) if eqx.is_inexact_array_like(leaf) else leaf, policy.actor)
    with np.errstate(all="ignore"):
        difference = np.abs(precise(obs.astype(np.float64), np) - action)
    return np.where(difference < MOST_ROUNDING, difference, 0.0)


def probes(policy: Policy) -> np.ndarray:
    """Observations `[rows, obs]` of every size in `SCALES`: random, constant, with one entry that is not 0; and, for a policy
    that normalizes them, random ones with the mean and the deviation of those that it was trained on."""
    rng, size = np.random.default_rng(0), policy.spec.obs_dim
    single = np.eye(size)[rng.integers(size, size=8)]
    shapes = np.concatenate([rng.normal(size=(32, size)), np.ones((1, size)), -np.ones((1, size)), single])
    rows = np.concatenate([scale * shapes for scale in SCALES])
    normalizer = getattr(getattr(policy.actor, "trunk", None), "normalizer", None)
    if normalizer is not None:
        seen = rng.normal(size=(256, size)) * np.asarray(normalizer.deviation) + np.asarray(normalizer.mean)
        rows = np.concatenate([rows, seen])
    return rows.astype(np.float32)
