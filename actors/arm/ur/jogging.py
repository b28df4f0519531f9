"""Small steps for setting up: checked, limited, as paths like any other. Pure."""

from __future__ import annotations

import math

import numpy as np

from actors.arm.errors import ArmRefusedError
from actors.arm.geometry import JOINT_NAMES, Joints
from actors.arm.joint_path import FloatArray, JointPath
from actors.arm.path.kinematics import MODELS, forward, inverse
from actors.arm.path.limits import outside
from actors.arm.path.transforms import cell_transforms, flange_transforms
from actors.arm.spec import UrArmSpec

FARTHEST_TURN, FARTHEST_WAY = math.radians(10.0), 0.05
"""The largest single step [rad], [m]."""

FASTEST_TURN, FASTEST_WAY = math.radians(20.0), 0.1
"""[rad/s], [m/s]."""

AXES = ("x", "y", "z", "rx", "ry", "rz")
_JOINT_AXES = tuple(f"joint {k}" for k in range(1, 7))
_POINTS = 101


def jog_path(spec: UrArmSpec, joints: Joints, axis: str, amount: float, speed: float) -> JointPath:
    """A step from where the arm stands.

    Args:
        spec: limits and tool.
        joints: where it stands [rad].
        axis: see `UrArm.jog`.
        amount: [rad] or [m].
        speed: [rad/s] or [m/s].

    Raises:
        ArmRefusedError: too far, too fast, out of reach, or out of where the arm may be.
    """
    if axis not in (*AXES, *_JOINT_AXES):
        raise ArmRefusedError(f"no axis '{axis}'; there are {', '.join((*_JOINT_AXES, *AXES))}")
    straight = axis in ("x", "y", "z")
    farthest, fastest = (FARTHEST_WAY, FASTEST_WAY) if straight else (FARTHEST_TURN, FASTEST_TURN)
    if not 0.0 < abs(amount) <= farthest:
        raise ArmRefusedError(f"a step is at most 50 mm or 10°; {_show(amount, straight)} was asked for")
    if not 0.0 < speed <= fastest:
        raise ArmRefusedError(f"a step's speed is at most 100 mm/s or 20°/s; {_show(speed, straight)}/s was asked for")
    duration = max(2.0 * abs(amount) / speed, 0.2)
    times = np.linspace(0.0, duration, _POINTS)
    share = 0.5 - 0.5 * np.cos(np.pi * times / duration)  # the fastest of it is π/2 of the mean, below the speed
    start = np.array(joints)
    if axis in _JOINT_AXES:
        points = np.repeat(start[None], _POINTS, axis=0)
        points[:, _JOINT_AXES.index(axis)] += share * amount
    else:
        points = _tool_steps(spec, start, axis, share * amount)
    _check(spec, points)
    return JointPath(times, points)


def _tool_steps(spec: UrArmSpec, start: FloatArray, axis: str, amounts: FloatArray) -> FloatArray:
    model, tool = MODELS[spec.model], cell_transforms(spec).tool
    rotation, position = forward(start[None], model)
    rotations, positions = np.repeat(rotation, _POINTS, axis=0), np.repeat(position, _POINTS, axis=0)
    along = np.eye(3)[AXES.index(axis) % 3]
    if axis in ("x", "y", "z"):
        positions = positions + amounts[:, None] * along
    else:
        point = position + rotation @ tool.position
        turns = np.stack([_turn(along, angle) for angle in amounts])
        rotations = turns @ rotation
        positions = point - (rotations @ tool.position[None, :, None])[..., 0]
    solutions = inverse(rotations, positions, model)
    points = [start]
    for candidates in solutions[1:]:
        turned = candidates - 2.0 * np.pi * np.round((candidates - points[-1]) / (2.0 * np.pi))
        apart = np.abs(turned - points[-1]).max(axis=-1)
        if not np.isfinite(apart).any() or np.nanmin(apart) > 0.05:
            raise ArmRefusedError("the arm can't make this step: out of its reach, or past a singularity")
        points.append(turned[int(np.nanargmin(apart))])
    return np.stack(points)


def _turn(axis: FloatArray, angle: float) -> FloatArray:
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turned: FloatArray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return turned


def _check(spec: UrArmSpec, points: FloatArray) -> None:
    model = MODELS[spec.model]
    for name, positions, most in zip(JOINT_NAMES, points.T, model.joint_range, strict=True):
        if np.abs(positions).max() > most:
            raise ArmRefusedError(f"{name} would leave its range")
    flange = flange_transforms(points[[0, -1]], spec)
    frames = {"tool": cell_transforms(spec).tool.position, "pourer": cell_transforms(spec).pourer.position}
    for thing, place in frames.items():
        begin, end = flange.apply(place)
        # Who stands outside may come back in: only what a step makes worse is refused.
        if np.any(_beyond(end, spec) > np.maximum(_beyond(begin, spec), 0.0) + 1e-9):
            raise ArmRefusedError(f"the {thing} would be {', '.join(outside(end, spec))}")


def _beyond(point: FloatArray, spec: UrArmSpec) -> FloatArray:
    """How far a point lies beyond each limit [m], negative inside."""
    limits = spec.limits
    planes = [plane.offset - float(np.dot(plane.normal, point)) for plane in limits.planes]
    low, high = np.array(limits.box_low) - point, point - np.array(limits.box_high)
    return np.concatenate([low, high, planes, [spec.cell.table - point[2]]])


def _show(value: float, straight: bool) -> str:
    return f"{1e3 * value:.1f} mm" if straight else f"{math.degrees(value):.1f}°"
