"""Observation and reward of the ten tasks from prebuilt NumPy views of MuJoCo's data, bit for bit dm_control's.

dm_control looks up every quantity by name in every step, which costs more than the physics of a small body. Each function
here does the lookups once and returns `(fill_observation, reward)`. The arithmetic has dm_control's order and constants, and
uses NumPy's `exp`, `log1p` and `arcsinh`, whose last bit can differ from libm's. `tests/envs/test_dmc.py` compares each with
dm_control over complete episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

FillObservation = Callable[[np.ndarray], None]
"""Writes the observation into a float32 row."""
Reward = Callable[[], float]
"""The reward of the current state, in float64."""
Views = tuple[FillObservation, Reward]


def views_for(task: str) -> Callable[[Any], Views] | None:
    """The function that builds the views of a task from its dm_control environment; None if the task has no views."""
    return {
        "finger_spin": finger_spin,
        "hopper_stand": hopper,
        "hopper_hop": hopper,
        "pendulum_swingup": pendulum_swingup,
        "walker_stand": walker,
        "walker_walk": walker,
        "walker_run": walker,
        "acrobot_swingup": acrobot_swingup,
        "cheetah_run": cheetah_run,
        "quadruped_run": quadruped_run,
    }.get(task)


def finger_spin(env: Any) -> Views:
    """Sparse: 1 while the body spins fast enough."""
    from dm_control.suite import finger

    joints, tip, spinner = sensors(env, "proximal", "distal"), sensors(env, "tip"), sensors(env, "spinner")
    tip_xz, spinner_xz = tip[0::2], spinner[0::2]
    velocity, touch = sensors(env, "proximal_velocity", "hinge_velocity"), sensors(env, "touchtop", "touchbottom")
    hinge_velocity = sensors(env, "hinge_velocity")
    fastest = -finger._SPIN_VELOCITY

    def fill_observation(row: np.ndarray) -> None:
        row[0:2] = joints
        np.subtract(tip_xz, spinner_xz, out=row[2:4], casting="same_kind")
        row[4:7] = velocity
        np.log1p(touch, out=row[7:9], casting="same_kind")

    return fill_observation, lambda: float(hinge_velocity.item() <= fastest)


def hopper(env: Any) -> Views:
    """Standing times hopping speed, or standing times small controls."""
    from dm_control.suite import hopper as suite

    data, model = env.physics.data.ptr, env.physics.model.ptr
    position, velocity, control, touch = data.qpos[1:], data.qvel, data.ctrl, sensors(env, "touch_toe", "touch_heel")
    torso, foot = data.xipos[model.body("torso").id, 2, ...], data.xipos[model.body("foot").id, 2, ...]
    speed = sensors(env, "torso_subtreelinvel")[0, ...]
    lowest, hop_speed = suite._STAND_HEIGHT, float(suite._HOP_SPEED)
    hopping = linear_tolerance(hop_speed, hop_speed / 2, 0.5)

    def fill_observation(row: np.ndarray) -> None:
        row[0:6] = position
        row[6:13] = velocity
        np.log1p(touch, out=row[13:15], casting="same_kind")

    def hop_reward() -> float:
        return hopping(speed.item()) if lowest <= torso.item() - foot.item() <= 2 else 0.0

    def stand_reward() -> float:
        if not lowest <= torso.item() - foot.item() <= 2:
            return 0.0
        small = [1.0 - c * c if -1.0 < c < 1.0 else 0.0 for c in control.tolist()]
        return (float(np.add.reduce(small)) / len(small) + 4) / 5  # NumPy's mean, in NumPy's order of summation

    return fill_observation, hop_reward if env.task._hopping else stand_reward


def pendulum_swingup(env: Any) -> Views:
    """Sparse: 1 while the pole is upright."""
    from dm_control.suite import pendulum

    data, model = env.physics.data.ptr, env.physics.model.ptr
    frame = data.xmat[model.body("pole").id]
    orientation, vertical, velocity = frame[8:1:-6], frame[8, ...], data.qvel
    lowest = pendulum._COSINE_BOUND

    def fill_observation(row: np.ndarray) -> None:
        row[0:2] = orientation  # zz, xz
        row[2:3] = velocity

    return fill_observation, lambda: 1.0 if lowest <= vertical.item() <= 1 else 0.0


def acrobot_swingup(env: Any) -> Views:
    """A Gaussian of the distance from the tip to the target's ball."""
    data, model = env.physics.data.ptr, env.physics.model.ptr
    upper, lower = model.body("upper_arm").id, model.body("lower_arm").id
    horizontal, vertical = data.xmat[upper : lower + 1, 2], data.xmat[upper : lower + 1, 8]
    velocity = data.qvel
    target, tip = data.site_xpos[model.site("target").id], data.site_xpos[model.site("tip").id]
    radius = float(model.site("target").size[0])

    def fill_observation(row: np.ndarray) -> None:
        row[0:2] = horizontal
        row[2:4] = vertical
        row[4:6] = velocity

    def reward() -> float:
        tip_to_target = target - tip
        distance = math.sqrt(tip_to_target.dot(tip_to_target))  # as np.linalg.norm
        return 1.0 if distance <= radius else gaussian(distance - radius)

    return fill_observation, reward


def cheetah_run(env: Any) -> Views:
    """Linear in the forward speed."""
    from dm_control.suite import cheetah

    data = env.physics.data.ptr
    position, velocity, speed = data.qpos[1:], data.qvel, sensors(env, "torso_subtreelinvel")[0, ...]
    run_speed = float(cheetah._RUN_SPEED)
    running = linear_tolerance(run_speed, run_speed, 0.0)

    def fill_observation(row: np.ndarray) -> None:
        row[0:8] = position
        row[8:17] = velocity

    return fill_observation, lambda: running(speed.item())


def walker(env: Any) -> Views:
    """Standing upright, times the forward speed if the task moves."""
    from dm_control.suite import walker as suite

    data, model = env.physics.data.ptr, env.physics.model.ptr
    torso = model.body("torso").id
    orientations, velocity = data.xmat[1:, 0:3:2], data.qvel  # xx, xz of each body
    height, upright = data.xpos[torso, 2, ...], data.xmat[torso, 8, ...]
    speed = sensors(env, "torso_subtreelinvel")[0, ...]
    lowest, margin, move_speed = suite._STAND_HEIGHT, suite._STAND_HEIGHT / 2, float(env.task._move_speed)
    moving = linear_tolerance(move_speed, move_speed / 2, 0.5)

    def fill_observation(row: np.ndarray) -> None:
        row[0:14].reshape(7, 2)[:] = orientations
        row[14] = height
        row[15:24] = velocity

    def stand_reward() -> float:
        tall = height.item()
        standing = 1.0 if lowest <= tall else gaussian((lowest - tall) / margin)
        return (3 * standing + (1 + upright.item()) / 2) / 4

    def move_reward() -> float:
        return stand_reward() * (5 * moving(speed.item()) + 1) / 6

    return fill_observation, stand_reward if move_speed == 0 else move_reward


def quadruped_run(env: Any) -> Views:
    """Upright times the forward speed."""
    data, model = env.physics.data.ptr, env.physics.model.ptr
    joint_position, joint_velocity, activation = data.qpos[7:], data.qvel[6:], data.act  # all but the free root
    torso_velocity, speed = sensors(env, "velocimeter"), sensors(env, "velocimeter")[0, ...]
    upright = data.xmat[model.body("torso").id, 8, ...]
    imu = sensors(env, "imu_accel", "imu_gyro")
    force_torque = sensors(env, "force_toe_front_left", "torque_toe_back_left")
    desired_speed = float(env.task._desired_speed)
    moving, standing = linear_tolerance(desired_speed, desired_speed, 0.5), linear_tolerance(1.0, 2.0, 0.0)

    def fill_observation(row: np.ndarray) -> None:
        row[0:16] = joint_position
        row[16:32] = joint_velocity
        row[32:44] = activation
        row[44:47] = torso_velocity
        row[47] = upright
        row[48:54] = imu
        np.arcsinh(force_torque, out=row[54:78], casting="same_kind")

    return fill_observation, lambda: standing(upright.item()) * moving(speed.item())


def sensors(env: Any, first: str, last: str | None = None) -> np.ndarray:
    """The readings of one sensor, or of all from the first to the last in the model's order."""
    model = env.physics.model.ptr
    start, end = model.sensor(first), model.sensor(last or first)
    return env.physics.data.ptr.sensordata[start.adr[0] : end.adr[0] + end.dim[0]]


def linear_tolerance(lower: float, margin: float, value_at_margin: float) -> Callable[[float], float]:
    """dm_control's `rewards.tolerance(x, (lower, inf), margin, "linear", value_at_margin)` for one number."""
    scale = 1 - value_at_margin

    def tolerance(x: float) -> float:
        if lower <= x:
            return 1.0
        scaled = (lower - x) / margin * scale
        return 1 - scaled if abs(scaled) < 1 else 0.0

    return tolerance


_GAUSSIAN_SCALE = float(np.sqrt(-2 * np.log(0.1)))  # 0.1 at the margin, dm_control's default


def gaussian(distance: float) -> float:
    """dm_control's Gaussian sigmoid of a distance in units of the margin."""
    return float(np.exp(-0.5 * (distance * _GAUSSIAN_SCALE) ** 2))
