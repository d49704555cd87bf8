"""Any task of the DeepMind Control suite as a `gymnasium.Env`, equal to `dm_control` bit for bit and much faster to step.

Physics and task are dm_control's own objects. Only the loop around them is ours. It has dm_control's order of operations, but
no TimeStep objects, no lookups by name and no dictionaries, and it builds the observation once per agent step.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np

from pcil.envs.views import Views, views_for
from pcil.errors import InputError

_RENDERERS = {
    "egl": ("dm_control._render.pyopengl.egl_renderer", "EGLContext"),
    "osmesa": ("dm_control._render.pyopengl.osmesa_renderer", "OSMesaContext"),
    "glfw": ("dm_control._render.glfw_renderer", "GLFWContext"),
}


class DMCEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One task of the suite with flat float32 observations and actions in [-1, 1].

    The observation is the concatenation of dm_control's entries in their order. An action is repeated for
    `action_repeat` control steps (frames), or fewer at the end of an episode, and their rewards are summed in float64. A time
    limit truncates the episode; only an end with discount 0 terminates it. `info["frames"]` is the number of control steps in
    the episode so far.

    A `dm_control.rl.control.PhysicsError` is not caught: a diverged simulation ends the run.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012  as gymnasium.Env declares it

    def __init__(
        self,
        task: str,
        action_repeat: int = 2,
        render_mode: str | None = None,
        width: int = 320,
        height: int = 240,
        camera_id: int | str = 0,
    ) -> None:
        if not isinstance(action_repeat, int) or action_repeat < 1:
            raise InputError(f"action_repeat is a whole number of control steps of at least 1; got {action_repeat!r}.")
        if render_mode not in (None, "rgb_array"):
            raise InputError(f'render_mode is None or "rgb_array" for DeepMind Control; got {render_mode!r}.')
        suite = import_suite()
        if render_mode is not None or task == "quadruped_escape":  # it uploads its terrain to OpenGL at each reset
            enable_rendering()
        self.name = task
        self._domain, self._task = split_name(task, suite.ALL_TASKS)
        self.action_repeat = action_repeat
        self.render_mode = render_mode
        self._camera = {"height": height, "width": width, "camera_id": camera_id}
        random = np.random.RandomState(0)
        self._load(random)
        # The lqr tasks draw spring constants while they are loaded, so each episode needs a new model.
        self._random_model = random.bytes(16) != np.random.RandomState(0).bytes(16)
        self._define_spaces()
        self._frames, self._over = 0, True

    @property
    def dt(self) -> float:
        """The simulated duration of one step in seconds."""
        return self._env.control_timestep() * self.action_repeat

    @property
    def physics(self) -> Any:
        """The `dm_control.mujoco.Physics` of the simulation."""
        return self._env.physics

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start the episode with which a new `suite.load(..., task_kwargs={"random": seed})` would start.

        The default seed is drawn from `np_random`.
        """
        del options
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if self._random_model:
            self._load(np.random.RandomState(seed))
        else:
            self._env.task.random.seed(seed)
        with self.physics.reset_context():
            self._env.task.initialize_episode(self.physics)
        self._advance = advance_function(self.physics, self._env.task, self.num_substeps)
        self._frames, self._over = 0, False
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Repeat one action for `action_repeat` control steps or until the episode ends."""
        if self._over:
            raise gymnasium.error.ResetNeeded("The episode is over or never began: call reset() before step().")
        control = self.control_signal(action)
        reward, terminated = 0.0, False
        for _ in range(self.action_repeat):
            self._advance(control)
            reward += self._reward()
            self._frames += 1
            if self._frames >= self._frame_limit:
                self._over = True
            elif self._termination is not None and (discount := self._termination(self.physics)) is not None:
                self._over, terminated = True, discount == 0.0
            if self._over:
                break
        return self._observation(), reward, terminated, self._over and not terminated, {"frames": self._frames}

    def control_signal(self, action: np.ndarray) -> np.ndarray:
        """The task's control signal for an action in [-1, 1], in float64."""
        action = checked_action(action, self._action_low.shape)
        return self._action_low + self._action_scale * (action + 1.0) if self._rescale else action

    def render(self) -> np.ndarray | None:
        """The current image of the camera, `[height, width, 3]` uint8."""
        return None if self.render_mode is None else self.physics.render(**self._camera)

    def close(self) -> None:
        """Free the rendering contexts; the simulation itself need not be closed."""
        if self.render_mode is not None:
            self.physics.free()

    def _load(self, random: np.random.RandomState) -> None:
        """Load model and task, and prepare the functions that `step` calls."""
        from dm_control.rl import control

        with _model_warnings_suppressed():
            self._env = env = import_suite().load(self._domain, self._task, task_kwargs={"random": random})
        screen = self.physics.model.vis.global_  # what is drawn may not be larger
        screen.offwidth, screen.offheight = (
            max(screen.offwidth, self._camera["width"]),
            max(screen.offheight, self._camera["height"]),
        )
        self.num_substeps: int = env._n_sub_steps  # dm_control has no public attribute for this and the limit
        self._frame_limit: float = env._step_limit
        self._fill_observation, self._reward = (views_for(self.name) or generic_views)(env)
        inherited = type(env.task).get_termination is control.Task.get_termination  # it never terminates
        self._termination = None if inherited else env.task.get_termination
        self.ends_early = not inherited

    def _define_spaces(self) -> None:
        self._obs_dim = sum(int(np.prod(entry.shape)) for entry in self._env.observation_spec().values())
        bounds = self._env.action_spec()
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self._obs_dim,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, bounds.shape, np.float32)
        # The same as dm_control's action_scale.Wrapper(env, -1, 1); bounds of [-1, 1] need no scaling.
        self._action_low, self._action_scale = bounds.minimum, (bounds.maximum - bounds.minimum) / 2.0
        self._rescale = bool(np.any(bounds.minimum != -1.0) or np.any(bounds.maximum != 1.0))
        self.metadata = {**DMCEnv.metadata, "render_fps": round(1.0 / self.dt)}

    def _observation(self) -> np.ndarray:
        row = np.empty(self._obs_dim, np.float32)
        self._fill_observation(row)
        return row


def checked_action(action: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The action in float64; `ValueError` if it has another shape, or an entry that is NaN or outside [-1, 1]."""
    action = np.asarray(action, dtype=np.float64)
    if action.shape != shape:
        raise ValueError(f"An action of shape {shape} was expected; got shape {action.shape}.")
    for value in action.tolist():  # faster than NumPy for a few numbers; NaN fails the comparison
        if not -1.0 <= value <= 1.0:
            raise ValueError(f"Every entry of an action must lie in [-1, 1]; got {value!r}.")
    return action


@contextlib.contextmanager
def _model_warnings_suppressed() -> Iterator[None]:
    """Suppress MuJoCo's deprecation warnings about dm_control's own model files, which users can't change."""
    logger = logging.getLogger("absl")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def import_suite() -> ModuleType:
    """Import `dm_control.suite`, also on machines without OpenGL; `InputError` if it is not installed.

    Unless `MUJOCO_GL` is set, dm_control looks for a window system while it is imported. This is disabled during the import;
    `enable_rendering` loads OpenGL when images are needed.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen is None:
        os.environ["MUJOCO_GL"] = "disabled"
    try:
        return importlib.import_module("dm_control.suite")
    except ModuleNotFoundError as error:
        raise InputError(
            f"DeepMind Control is not installed here ({error}): pip install dm-control, or, from Python 3.13 on, where its "
            "package labmaze has no wheel, pip install dm-env lxml and pip install --no-deps dm-control."
        ) from error
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        if chosen is None:
            raise
        raise _no_opengl(chosen) from error
    finally:
        if chosen is None:
            del os.environ["MUJOCO_GL"]


def enable_rendering() -> None:
    """Set dm_control's renderer to the one that `MUJOCO_GL` names, else to EGL or OSMesa, which need no display."""
    render: Any = importlib.import_module("dm_control._render")
    name = renderer()
    if name == "glfw" and not has_display():
        raise _no_opengl(name)
    if name == render.BACKEND and name in _RENDERERS:
        return
    try:
        module, context = _RENDERERS[name]
        render.Renderer, render.BACKEND = getattr(importlib.import_module(module), context), name
    except (KeyError, ImportError, AttributeError, OSError, RuntimeError) as error:
        raise _no_opengl(name) from error


def renderer() -> str:
    """The renderer that `MUJOCO_GL` names, else EGL or OSMesa on Linux, and GLFW elsewhere."""
    if name := os.environ.get("MUJOCO_GL", "").lower():
        return name
    return "glfw" if sys.platform in ("darwin", "win32") else "egl" if ctypes.util.find_library("EGL") else "osmesa"


def has_display() -> bool:
    """Whether a window may be opened: on Linux, whether the environment names a display."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _no_opengl(name: str) -> InputError:
    return InputError(
        f"Rendering needs OpenGL and MUJOCO_GL={name} does not work here: install EGL (apt install libegl1) and set the "
        "environment variable MUJOCO_GL=egl, or OSMesa (apt install libosmesa6) and MUJOCO_GL=osmesa."
    )


def split_name(task: str, all_tasks: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    """`("ball_in_cup", "catch")` for "ball_in_cup_catch"; domains and tasks may both have underscores in their names."""
    for domain, name in all_tasks:
        if task == f"{domain}_{name}":
            return domain, name
    raise InputError(f"DeepMind Control has no task {task!r}; a task is a domain and a task such as walker_walk.")


def advance_function(physics: Any, task: Any, num_substeps: int) -> Callable[[np.ndarray], None]:
    """A function for one control step: set the control signal, then do the substeps in dm_control's order.

    It is created for each episode, because it compares MuJoCo's warning counts with those at the start of the episode. Tasks
    with their own `before_step`, `after_step` or physics are stepped through these methods.
    """
    from dm_control.mujoco import engine
    from dm_control.suite import base

    plain = (
        type(task).before_step is base.Task.before_step
        and type(task).after_step is base.Task.after_step  # it only recolours bodies if `visualize_reward` is on
        and type(physics).step is engine.Physics.step
        and type(physics).set_control is engine.Physics.set_control
        and physics.legacy_step
    )
    if plain:
        return _plain_advance(physics, num_substeps)

    def advance(control: np.ndarray) -> None:
        task.before_step(control, physics)
        physics.step(num_substeps)
        task.after_step(physics)

    return advance


def _plain_advance(physics: Any, num_substeps: int) -> Callable[[np.ndarray], None]:
    data = physics.data.ptr
    control_signal, warnings, before = data.ctrl, data.warning.number, data.warning.number.tobytes()
    step = control_step(physics.model.ptr, data, num_substeps)

    def advance(control: np.ndarray) -> None:
        control_signal[:] = control
        step()
        if warnings.tobytes() != before:
            _raise_physics_error(warnings > np.frombuffer(before, warnings.dtype))

    return advance


def control_step(model: Any, data: Any, num_substeps: int) -> Callable[[], None]:
    """A function that makes MuJoCo's calls of one control step."""
    mujoco: Any = importlib.import_module("mujoco")
    runge_kutta = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    mj_step, mj_step1, mj_step2 = mujoco.mj_step, mujoco.mj_step1, mujoco.mj_step2

    def step() -> None:
        if runge_kutta:
            mj_step(model, data, num_substeps)
        else:
            mj_step2(model, data)
            if num_substeps > 1:
                mj_step(model, data, num_substeps - 1)
        mj_step1(model, data)  # updates positions and velocities to the new state

    return step


def _raise_physics_error(raised: np.ndarray) -> None:
    """Raise dm_control's error if MuJoCo issued a warning."""
    from dm_control.rl import control

    mujoco: Any = importlib.import_module("mujoco")
    if names := [name for name, new in zip(mujoco.mjtWarning.__members__, raised, strict=False) if new]:
        raise control.PhysicsError(f"Physics state is invalid. Warning(s) raised: {', '.join(names)}")


def generic_views(env: Any) -> Views:
    """Observation and reward from the task's own methods, for any task."""
    physics, task = env.physics, env.task

    def fill_observation(row: np.ndarray) -> None:
        entries = task.get_observation(physics).values()
        np.concatenate([np.ravel(entry) for entry in entries], out=row, casting="same_kind")

    def reward() -> float:
        return float(task.get_reward(physics))

    return fill_observation, reward
