"""`pcil doctor`: what is installed, what is wrong, and how to fix it."""

from __future__ import annotations

import importlib.util
import os
import platform
from collections.abc import Callable
from importlib import metadata

from rich.console import Console
from rich.table import Table
from rich.text import Text

from pcil.cli import arguments
from pcil.errors import shown

Check = tuple[str, Callable[[], str], str, bool]
"""Name, function (returns a finding, raises if the check fails), remedy, and whether training needs it."""


def doctor() -> int:
    """Say what is installed, what is wrong, and what to do; exit code 1 where training can't work."""
    table = Table("", "part", "found", "what to do")
    broken = False
    for name, look, remedy, needed in CHECKS:
        try:
            found, advice, mark = look(), "", "[green]ok[/]"
        except Exception as error:  # a broken installation may raise anything
            found, advice = f"{type(error).__name__}: {error}".splitlines()[0][:90], remedy
            mark = "[red]wrong[/]" if needed else "[yellow]absent[/]"
            broken |= needed
        table.add_row(mark, name, Text(shown(found)), Text(advice))  # brackets, as in .[report], are not markup
    Console().print(table)
    return int(broken)


def _python() -> str:
    version = platform.python_version_tuple()
    if (int(version[0]), int(version[1])) < (3, 11):
        raise RuntimeError(f"Python {platform.python_version()}")
    return f"{platform.python_version()} on {platform.system()}, {os.cpu_count()} cores"


def _versions(*names: str) -> Callable[[], str]:
    return lambda: ", ".join(f"{name} {metadata.version(name)}" for name in names)


def _mujoco() -> str:
    version = metadata.version("mujoco")
    try:
        suite = f"dm-control {metadata.version('dm-control')}"
    except metadata.PackageNotFoundError:
        return f"mujoco {version}, no dm-control"
    if int(version.split(".")[0]) >= 4:
        raise RuntimeError(f"mujoco {version} does not work with {suite}")
    return f"mujoco {version}, {suite}"


def _devices() -> str:
    import jax

    from pcil import compilation

    compilation.start()
    return f"jax {jax.__version__}: " + ", ".join(str(device) for device in jax.devices())


def _environment() -> str:
    from pcil import envs

    with envs.opened("pendulum_swingup") as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
    return "pendulum_swingup steps"


def _demonstrations() -> str:
    from pcil.demos.inspect import shipped

    rows = shipped()
    if not rows:
        raise RuntimeError("none in the package")
    return f"{len(rows)} tasks: " + ", ".join(row["task"] for row in rows)


def _cache() -> str:
    from pcil import compilation

    folder = compilation.cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    (probe := folder / ".probe").touch()
    probe.unlink()
    return str(folder)


def _rendering() -> str:
    from pcil import envs

    with envs.opened("pendulum_swingup", render_mode="rgb_array") as env:
        env.reset(seed=0)
        frame = env.render()
    return f"frames of {getattr(frame, 'shape', None)} with MUJOCO_GL={os.environ.get('MUJOCO_GL', 'default')}"


def _importable(module: str, package: str) -> Callable[[], str]:
    def look() -> str:
        importlib.import_module(module)
        return f"{package} {metadata.version(package)}"

    return look


_DMC_REMEDY = (
    "pip install --force-reinstall dm-control 'mujoco<4'; from Python 3.13 on, where its package labmaze has no wheel: "
    "pip install dm-env lxml and pip install --no-deps dm-control"
)
CHECKS: tuple[Check, ...] = (
    ("Python", _python, "install Python 3.11 or newer", True),
    ("networks", _versions("equinox", "optax", "numpy"), "pip install --force-reinstall pcil", True),
    ("physics", _mujoco, "pip install 'mujoco<4'", True),
    ("device", _devices, "pip install --force-reinstall jax; for a GPU: pip install '.[cuda]' in a clone", True),
    ("DeepMind Control", _environment, _DMC_REMEDY, importlib.util.find_spec("dm_control") is not None),
    ("demonstrations", _demonstrations, "pip install --force-reinstall pcil, or give --demos", False),
    ("compilation cache", _cache, "set JAX_COMPILATION_CACHE_DIR to a folder that can be written", False),
    ("figures", _importable("matplotlib", "matplotlib"), "pip install '.[report]' in a clone", False),
    ("optimal transport", _importable("ot", "pot"), "pip install --force-reinstall pot", False),
    ("Ray clusters", _importable("ray", "ray"), "pip install '.[sweep]' in a clone", False),
    ("ONNX", _importable("onnxruntime", "onnxruntime"), "pip install '.[onnx]' in a clone", False),
    ("MP4 films", _importable("imageio_ffmpeg", "imageio-ffmpeg"), "pip install '.[film]' in a clone", False),
    ("Weights & Biases", _importable("wandb", "wandb"), "pip install '.[wandb]' in a clone", False),
    ("MLflow", _importable("mlflow", "mlflow-skinny"), "pip install '.[mlflow]' in a clone", False),
    ("rendering", _rendering, "apt install libegl1 (or libosmesa6) and set MUJOCO_GL=egl (or osmesa)", False),
)


def main(argv: list[str]) -> int:
    return arguments.call("doctor", doctor, argv)
