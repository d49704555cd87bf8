"""A trained policy: a NumPy function of the observation, saved as safetensors and JSON (the files contain no code)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from pcil import files, modules
from pcil.card import card
from pcil.errors import InputError
from pcil.nets.networks import MLP, Actor, Normalizer, Trunk
from pcil.types import Spec

FORMAT = "pcil-policy-1"
SHIPPED = Path(__file__).parent / "data" / "policies"
"""The experts that the package has, each in a folder named after its task."""
LARGEST = 2**30
"""The largest `policy.safetensors` in bytes."""


@dataclass(frozen=True, eq=False)
class Policy:
    """The mean action of a trained actor: `policy(obs [*, obs]) -> action [*, action]`, float32 in [-1, 1]."""

    actor: Any
    task: str
    info: dict[str, Any] = field(default_factory=dict)
    """How it was trained: method, preset, seed, frames, mean return."""
    sizes: Spec | None = None
    """The sizes of observation and action, for actors other than `pcil.nets.networks:Actor`."""

    @property
    def spec(self) -> Spec:
        """The sizes of observation and action."""
        if not isinstance(self.actor, Actor):
            assert self.sizes is not None
            return self.sizes
        obs_dim, action_dim = self.actor.trunk.weight.shape[0], self.actor.head.biases[-1].shape[0]
        return Spec(obs_dim, action_dim, self.info.get("action_repeat", 1))

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """The keyword arguments of the environment in which it was trained."""
        return self.info.get("env_kwargs", {})

    @property
    def action_bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The bounds `[action]` of its environment's own actions, to which -1 and 1 correspond; None in older policies."""
        if self.info.get("action_low") is None:
            return None
        return np.array(self.info["action_low"], np.float64), np.array(self.info["action_high"], np.float64)

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        obs = np.asarray(obs, np.float32)
        if obs.shape[-1:] != (self.spec.obs_dim,):
            raise InputError(
                f"The policy for {self.task} takes observations of {self.spec.obs_dim} numbers; "
                f"got an array of shape {obs.shape}."
            )
        with np.errstate(all="ignore"):  # actions that are not finite are refused by the environment
            return self.actor(obs, np)

    def check_fits(self, env: Any) -> None:
        """Raise `InputError` if the environment has other sizes of observations or actions than the policy."""
        obs, action = env.observation_space.shape, env.action_space.shape
        if (obs, action) != ((self.spec.obs_dim,), (self.spec.action_dim,)):
            raise InputError(
                f"The policy for {self.task} takes observations of {self.spec.obs_dim} numbers and gives actions of "
                f"{self.spec.action_dim}, but in the environment created here they have shapes {obs} and {action}; give "
                "--env-kwargs and the version of the environment that it was trained in."
            )

    def save(self, folder: Path) -> None:
        """Write `policy.json`, `policy.safetensors` and the model card `README.md` to `folder`, each atomically.

        `policy.safetensors` has checksums of its own arrays and of `policy.json`. The card repeats what `policy.json` says.
        """
        folder.mkdir(parents=True, exist_ok=True)
        arrays = _named(self.actor)
        if isinstance(self.actor, Actor):
            kind: dict[str, Any] = {"layers": len(self.actor.head.weights)}
        else:
            named = f"{type(self.actor).__module__}:{type(self.actor).__qualname__}"
            if not callable(getattr(self.actor, "from_arrays", None)):
                raise InputError(
                    f"The actor {named} can't be saved: it needs a class method from_arrays(arrays) to be loaded by."
                )
            kind = {"class": named, "sizes": [self.spec.obs_dim, self.spec.action_dim]}
        text = json.dumps({"format": FORMAT, "task": self.task, **kind, "info": self.info}) + "\n"
        readme = card(self.task, self.info)
        # A single entry, since safetensors writes several ones in random order.
        checksums = f"{_digest(arrays)} {hashlib.sha256(text.encode()).hexdigest()}"
        files.save_arrays(folder / "policy.safetensors.tmp", arrays, {"sha256": checksums})
        (folder / "policy.json.tmp").write_text(text)
        (folder / "README.md.tmp").write_text(readme, encoding="utf-8")
        for name in ("policy.safetensors", "policy.json", "README.md"):
            (folder / f"{name}.tmp").replace(folder / name)


def as_saved(folder: Path) -> bool:
    """Whether `policy.json` is unchanged since it was saved with its arrays; True for older policies without this checksum.

    A policy with an edited `policy.json` can still be loaded.
    """
    from safetensors import safe_open

    with safe_open(folder / "policy.safetensors", "np") as file:
        _, _, expected = (file.metadata() or {}).get("sha256", "").partition(" ")
    return expected in ("", hashlib.sha256((folder / "policy.json").read_bytes()).hexdigest())


def load_policy(path: str | Path, trust: Sequence[str] = ()) -> Policy:
    """The policy of a run folder, of a folder that holds `policy.safetensors` and `policy.json`, or the expert that ships for a
    task ("walker_walk") where there is no such folder.

    `trust` are the modules that it may name for an actor that is not part of this package. `InputError` if there is no policy
    or if its files are damaged.
    """
    from safetensors import SafetensorError

    names = (file.parent.name for file in SHIPPED.glob("*/policy.json"))
    folder, shipped = Path(path), sorted(names, key=str.swapcase)  # those of DeepMind Control, in small letters, come first
    folder = SHIPPED / str(path) if str(path) in shipped and not folder.exists() else folder
    folder = folder / "policy" if (folder / "policy").is_dir() else folder
    if not (folder / "policy.json").is_file() or not (folder / "policy.safetensors").is_file():
        raise InputError(
            f"{path} holds no policy (policy.json and policy.safetensors); give a run folder that pcil train made, or "
            f"a task whose expert ships ({', '.join(shipped) or 'none does'})."
        )
    try:
        header = files.read_json(folder / "policy.json")
        arrays = _read(folder / "policy.safetensors")
        _check_header(header)
        if "class" in header:
            modules.admit(f"The policy in {folder}", modules.of_class(header["class"]), trust)
            kind = modules.load("The policy's class", header["class"], object, "my.module:MyActor")
            obs_dim, action_dim = map(int, header["sizes"])
            sizes = Spec(obs_dim, action_dim, header.get("info", {}).get("action_repeat", 1))
            return Policy(kind.from_arrays(arrays), header["task"], header.get("info", {}), sizes)
        actor = _build(header, arrays)
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, SafetensorError, OSError) as error:
        raise InputError(
            f"The policy in {folder} is damaged ({type(error).__name__}: {error}); train or copy it again."
        ) from error
    return Policy(actor, header["task"], header.get("info", {}))


def _named(actor: Any) -> dict[str, np.ndarray]:
    """The actor's arrays by their path in the pytree, such as `head.weights.0`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(actor, eqx.is_array))
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in leaves}


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """The SHA-256 of names, shapes and values."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.shape} ".encode() + array.astype("<f4").tobytes())
    return digest.hexdigest()


def _read(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file; `ValueError` if they do not match the checksum in the file, if there is one."""
    from safetensors import safe_open

    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path.name} is larger than {LARGEST:,} bytes")
    with safe_open(path, "np") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        expected = (file.metadata() or {}).get("sha256", "").partition(" ")[0]
    if expected not in ("", _digest(arrays)):
        raise ValueError("its values do not have their checksum")
    return arrays


def _check_header(header: dict[str, Any]) -> None:
    """Raise `ValueError` or `LookupError` if the content of `policy.json` is invalid."""
    if header["format"] != FORMAT:
        raise ValueError(f"format {header['format']!r} is not {FORMAT!r}")
    if not (isinstance(header["task"], str) and header["task"] and isinstance(header.get("info", {}), dict)):
        raise ValueError("its task is no name or its info no table")
    if not isinstance(header.get("info", {}).get("env_kwargs", {}), dict):
        raise ValueError("its env_kwargs are no table")
    bounds = [header.get("info", {}).get(f"action_{end}") for end in ("low", "high")]
    if bounds != [None, None]:
        low, high = np.array(bounds, np.float64)
        if low.ndim != 1 or not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
            raise ValueError("its action_low and action_high are no lists of numbers, each below its counterpart")


def _build(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Actor:
    """The actor with these arrays; `ValueError` if they are not finite or if their shapes are inconsistent."""
    for name, array in arrays.items():
        arrays[name] = array.astype(np.float32, copy=False)
        if array.dtype.kind != "f" or 0 in array.shape or not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} of shape {array.shape} and dtype {array.dtype} must hold finite numbers")
    scaling = [name for name in ("trunk.normalizer.mean", "trunk.normalizer.deviation") if name in arrays]
    layers = range(int(header["layers"]))
    obs_dim, width = arrays["trunk.weight"].shape[:2]
    expected = {"trunk.weight": (obs_dim, width), **dict.fromkeys(scaling, (obs_dim,))}
    expected |= dict.fromkeys(("trunk.bias", "trunk.scale", "trunk.offset"), (width,))
    for i in layers:
        outputs = len(arrays[f"head.biases.{i}"])
        expected |= {f"head.weights.{i}": (width, outputs), f"head.biases.{i}": (outputs,)}
        width = outputs
    wrong = sorted({name: array.shape for name, array in arrays.items()}.items() ^ expected.items())
    if wrong or not layers:
        raise ValueError(f"names and shapes of its arrays do not fit each other: {wrong[:4]}")
    if scaling and not (arrays[scaling[-1]] > 0).all():
        raise ValueError("its scaling has deviations that are not above 0")
    normalizer = Normalizer(*(arrays[name] for name in scaling)) if scaling else None  # older ones scale in their first layer
    weight, bias, scale, offset = (arrays[f"trunk.{name}"] for name in ("weight", "bias", "scale", "offset"))
    weights, biases = (tuple(arrays[f"head.{kind}.{i}"] for i in layers) for kind in ("weights", "biases"))
    return Actor(Trunk(weight, bias, scale, offset, normalizer), MLP(weights, biases))
