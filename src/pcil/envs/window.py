"""Windows that show an environment: MuJoCo's viewer for DeepMind Control, else the environment's own."""

from __future__ import annotations

import contextlib
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from pcil import envs
from pcil.envs.dmc import DMCEnv, has_display
from pcil.errors import InputError, RunError

Refresh = Callable[[], bool]
"""Shows the current state; to be called after each reset and step. False once the user has closed the window."""


@contextlib.contextmanager
def opened(task: str, env_kwargs: dict[str, Any]) -> Iterator[tuple[envs.Checked, Refresh]]:
    """The environment of a task, and a function that shows its state in a window in real time.

    `InputError` where there is no display, or where the environment can't open a window.
    """
    if not has_display():
        raise InputError(_instead("there is no display here (neither DISPLAY nor WAYLAND_DISPLAY is set)"))
    if not envs.gymnasium_id(task).startswith("dmc/"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*HumanRendering wrapper")  # Gymnasium shows the pictures of other environments
            begun = False

            def refresh() -> bool:
                nonlocal begun
                begun = True
                return True  # it draws itself in `reset` and `step`

            try:
                with envs.opened(task, render_mode="human", env_kwargs=env_kwargs) as env:
                    yield env, refresh
            except RunError as error:
                if begun:
                    raise
                raise InputError(_instead(str(error))) from error
        return
    with envs.opened(task, env_kwargs=env_kwargs) as env:
        viewer = _Viewer(env.unwrapped)
        try:
            yield env, viewer.refresh
        finally:
            viewer.close()


class _Viewer:
    """MuJoCo's viewer on a task of DeepMind Control."""

    def __init__(self, env: Any) -> None:
        assert isinstance(env, DMCEnv)
        self._env, self._model, self._handle, self._due = env, None, None, 0.0
        self._threads: list[threading.Thread] = []

    def refresh(self) -> bool:
        """Show the state when its time has come. The first call opens the window, and so does an episode with a new model."""
        if self._model is not self._env.physics.model.ptr:
            self._open()
        self._due += self._env.dt
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - self._env.dt)
        handle: Any = self._handle
        handle.sync()
        return handle.is_running()

    def close(self) -> None:
        """Close the window, and wait for the viewer's threads: the process would crash if it ended before them."""
        if self._handle is not None:
            self._handle.close()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def _open(self) -> None:
        import glfw
        import mujoco.viewer

        self.close()
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            usable = glfw.init()  # the viewer would wait for ever where this fails
        if not usable:
            raise InputError(_instead(f"GLFW can't use the display ({'; '.join(str(w.message) for w in said)})"))
        model, data, before = self._env.physics.model.ptr, self._env.physics.data.ptr, threading.enumerate()
        try:
            self._handle = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except RuntimeError as error:  # on macOS: it must be run under mjpython
            raise InputError(_instead(f"MuJoCo's viewer can't be started ({error})")) from error
        self._threads = [thread for thread in threading.enumerate() if thread not in before]
        self._model, self._due = model, time.monotonic()


def _instead(why: str) -> str:
    return f"No window can be opened: {why.removesuffix('.')}; pcil film makes a film of the policy without one."
