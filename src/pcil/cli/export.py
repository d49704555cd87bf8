"""`pcil export`."""

import contextlib
import sys
from pathlib import Path

from pcil.cli import arguments
from pcil.errors import shown
from pcil.modules import Trust


def export(folder: Path, /, out: Path, trust: Trust = ()) -> int:
    """Write a trained policy as an ONNX file, which runs without this package.

    The file maps observations in the environment's units to actions within the environment's bounds. It is compared with the
    policy, and refused if it differs.

    Args:
        folder: The folder of a run, one with policy.json and policy.safetensors, or a task whose expert ships.
        out: The file to write; its name ends in .onnx.
        trust: Modules that the policy's files may name and whose code is then run, such as my.module.
    """
    from pcil.export import export_onnx
    from pcil.policy import load_policy

    policy = load_policy(folder, trust)
    with contextlib.redirect_stdout(sys.stderr):  # environments may print
        error = export_onnx(policy, out, trust)
    print(f"{shown(policy.task)}: {shown(str(out))}, largest error {error:.1e} for actions scaled to [-1, 1]")
    return 0


def main(argv: list[str]) -> int:
    return arguments.call("export", export, argv)
