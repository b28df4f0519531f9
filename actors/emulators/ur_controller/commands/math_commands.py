"""Commands that only compute."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

from actors.emulators.ur_controller.commands.command_arguments import six
from actors.emulators.ur_controller.robot_kinematics import (
    Matrix,
    compose,
    distance,
    invert,
    multiply,
    pose_of,
    rotation_between,
    rotation_matrix,
    rotation_vector,
    transform_of,
    transpose,
)
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Command
from actors.emulators.ur_controller.urscript.script_values import LONGEST_STRING, UrPose, number, numbers, show


def pose_trans(p_from: Any, p_from_to: Any) -> UrPose:
    """Express a pose, given in the frame of another pose, in the frame in which that other pose is given."""
    return UrPose(pose_of(compose(transform_of(six(p_from)), transform_of(six(p_from_to)))))


def pose_inv(p_from: Any) -> UrPose:
    """Return the inverse of a pose."""
    return UrPose(pose_of(invert(transform_of(six(p_from)))))


def pose_add(p_1: Any, p_2: Any) -> UrPose:
    """Add the positions and compose the rotations."""
    a, b = transform_of(six(p_1)), transform_of(six(p_2))
    shift = [x + y for x, y in zip(a[1], b[1], strict=True)]
    return UrPose([*shift, *rotation_vector(multiply(a[0], b[0]))])


def pose_sub(p_to: Any, p_from: Any) -> UrPose:
    """Subtract the positions; return the rotation from one to the other."""
    a, b = transform_of(six(p_to)), transform_of(six(p_from))
    shift = [x - y for x, y in zip(a[1], b[1], strict=True)]
    return UrPose([*shift, *rotation_vector(multiply(a[0], transpose(b[0])))])


def interpolate_pose(p_from: Any, p_to: Any, alpha: Any) -> UrPose:
    """Interpolate between two poses for 0 … 1, or extrapolate."""
    a, b, k = transform_of(six(p_from)), transform_of(six(p_to)), number(alpha)
    shift = [x + k * (y - x) for x, y in zip(a[1], b[1], strict=True)]
    turn = [k * r for r in rotation_between(a[0], b[0])]
    return UrPose([*shift, *rotation_vector(multiply(a[0], rotation_matrix(turn)))])


def pose_dist(p_from: Any, p_to: Any) -> float:
    """Return the distance of two poses: norm over position and rotation together, as a controller computes it."""
    return math.sqrt(sum(x * x for x in pose_sub(p_to, p_from)))


def norm(a: Any) -> float:
    """Return the length of a list, or the absolute value of a number."""
    if isinstance(a, list):
        return math.sqrt(sum(number(x) ** 2 for x in a))
    return abs(number(a))


def normalize(v: Any) -> list[float]:
    """Return a list divided by its length."""
    vector, size = numbers(v, length(v)), norm(v)
    return [x / size for x in vector]


def rpy2rotvec(rpy: Any) -> list[float]:
    """Convert roll, pitch, yaw to a rotation vector [rad]."""
    r, p, y = numbers(rpy, 3)
    yaw, pitch, roll = rotation_matrix((0, 0, y)), rotation_matrix((0, p, 0)), rotation_matrix((r, 0, 0))
    return list(rotation_vector(multiply(yaw, multiply(pitch, roll))))


def rotvec2rpy(rotation: Any) -> list[float]:
    """Convert a rotation vector to roll, pitch, yaw [rad]."""
    m: Matrix = rotation_matrix(numbers(rotation, 3))
    return [math.atan2(m[7], m[8]), math.atan2(-m[6], math.hypot(m[7], m[8])), math.atan2(m[3], m[0])]


def length(v: Any) -> int:
    """Return the number of entries of a list."""
    if not isinstance(v, list):
        raise ScriptError(f"{show(v)} is not a list")
    return len(v)


def str_cat(a: Any, b: Any) -> str:
    """Concatenate two strings."""
    joined = show(a) + show(b)
    if len(joined) > LONGEST_STRING:
        raise ScriptError(f"a string of more than {LONGEST_STRING} characters")
    return joined


def make_list(count: Any, value: Any, capacity: Any = 0) -> list[Any]:
    """Return a list of equal entries."""
    entries = int(number(count))
    if not 0 <= entries <= 10_000:
        raise ScriptError("a list has 0 … 10000 entries")
    return [value] * entries


def _unary(function: Callable[[float], float]) -> Callable[[Any], Any]:
    return lambda f: function(number(f))


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: _unary(getattr(math, name)) for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sqrt", "exp")},
    "ceil": _unary(math.ceil),
    "floor": _unary(math.floor),
    "abs": lambda f: abs(number(f)),
    "d2r": _unary(math.radians),
    "r2d": _unary(math.degrees),
    "atan2": lambda x, y: math.atan2(number(x), number(y)),
    "pow": lambda base, exponent: math.pow(number(base), number(exponent)),
    "log": lambda b, f: math.log(number(f), number(b)),
    "random": random.random,
    "norm": norm,
    "normalize": normalize,
    "point_dist": lambda p_from, p_to: distance(six(p_from), six(p_to)),
    "pose_trans": pose_trans,
    "pose_inv": pose_inv,
    "pose_add": pose_add,
    "pose_sub": pose_sub,
    "pose_dist": pose_dist,
    "interpolate_pose": interpolate_pose,
    "rpy2rotvec": rpy2rotvec,
    "rotvec2rpy": rotvec2rpy,
    "length": length,
    "get_list_length": length,
    "make_list": make_list,
    "str_cat": str_cat,
    "str_len": lambda s: len(show(s)),
    "to_str": show,
    "to_num": lambda s: number(float(s)),
}

COMMANDS = {name: Command(function) for name, function in _FUNCTIONS.items()}
"""Commands by name; they are the same for every controller."""
