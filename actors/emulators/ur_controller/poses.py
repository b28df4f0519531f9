"""Poses in a robot controller's format: x, y, z [m] and a rotation vector [rad].

The functions use plain scalars because they run at 500 Hz. A rotation matrix is a tuple of its nine entries, row by
row; a vector is a tuple of three.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, pi, sin, sqrt

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
Transform = tuple[Matrix, Vector]
"""A rotation and a position."""

IDENTITY: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def rotation_matrix(rotation: Sequence[float]) -> Matrix:
    """Matrix of a rotation vector [rad]."""
    x, y, z = rotation
    angle = sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return (1.0, -z, y, z, 1.0, -x, -y, x, 1.0)
    x, y, z = x / angle, y / angle, z / angle
    c, s = cos(angle), sin(angle)
    t = 1.0 - c
    return (
        t * x * x + c,
        t * x * y - s * z,
        t * x * z + s * y,
        t * x * y + s * z,
        t * y * y + c,
        t * y * z - s * x,
        t * x * z - s * y,
        t * y * z + s * x,
        t * z * z + c,
    )


def rotation_vector(m: Matrix) -> Vector:
    """Rotation vector [rad] of a matrix; its length is at most π."""
    x, y, z = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    sine = 0.5 * sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (m[0] + m[4] + m[8] - 1.0)
    angle = atan2(sine, cosine)
    if sine > 1e-7:
        k = 0.5 * angle / sine
        return (k * x, k * y, k * z)
    if cosine > 0.0:
        return (0.5 * x, 0.5 * y, 0.5 * z)
    return _half_turn(m)


def _half_turn(m: Matrix) -> Vector:
    # At an angle of π the antisymmetric part vanishes; the symmetric part contains the axis: m = 2·n·nᵀ − 1.
    i = max(range(3), key=lambda k: m[4 * k])
    length = sqrt(max(0.5 * (m[4 * i] + 1.0), 0.0))
    axis = [0.0, 0.0, 0.0]
    for k in range(3):
        axis[k] = length if k == i else 0.25 * (m[3 * i + k] + m[3 * k + i]) / length
    norm = sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    return (pi * axis[0] / norm, pi * axis[1] / norm, pi * axis[2] / norm)


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """Matrix product."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    return (
        a0 * b0 + a1 * b3 + a2 * b6,
        a0 * b1 + a1 * b4 + a2 * b7,
        a0 * b2 + a1 * b5 + a2 * b8,
        a3 * b0 + a4 * b3 + a5 * b6,
        a3 * b1 + a4 * b4 + a5 * b7,
        a3 * b2 + a4 * b5 + a5 * b8,
        a6 * b0 + a7 * b3 + a8 * b6,
        a6 * b1 + a7 * b4 + a8 * b7,
        a6 * b2 + a7 * b5 + a8 * b8,
    )


def transpose(m: Matrix) -> Matrix:
    """Inverse of a rotation."""
    return (m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8])


def rotate(m: Matrix, v: Sequence[float]) -> Vector:
    """Matrix times vector."""
    x, y, z = v
    return (m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z)


def compose(a: Transform, b: Transform) -> Transform:
    """Compose two transforms: b, given in the frame a, in the frame in which a is given."""
    m, p = a
    x, y, z = rotate(m, b[1])
    return multiply(m, b[0]), (p[0] + x, p[1] + y, p[2] + z)


def invert(a: Transform) -> Transform:
    """Inverse of a transform."""
    back = transpose(a[0])
    x, y, z = rotate(back, a[1])
    return back, (-x, -y, -z)


def transform_of(pose: Sequence[float]) -> Transform:
    """Transform of a pose x, y, z, rx, ry, rz."""
    return rotation_matrix(pose[3:6]), (pose[0], pose[1], pose[2])


def pose_of(frame: Transform) -> tuple[float, float, float, float, float, float]:
    """Pose of a transform."""
    return (*frame[1], *rotation_vector(frame[0]))


def norm3(v: Sequence[float]) -> float:
    """Length of a vector."""
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Distance of two points, or of the positions of two poses [m]."""
    return sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


def rotation_between(a: Matrix, b: Matrix) -> Vector:
    """Rotation vector, in a's own axes, that turns a into b [rad]."""
    return rotation_vector(multiply(transpose(a), b))


def angle_between(a: Matrix, b: Matrix) -> float:
    """Angle between two rotations [rad]."""
    return norm3(rotation_between(a, b))
