"""Forward kinematics of the six-axis arm, in closed form, and poses in a robot controller's format.

A pose is x, y, z [m] and a rotation vector [rad]. The functions use plain scalars because they run at 500 Hz. A
rotation matrix is a tuple of its nine entries, row by row; a vector is a tuple of three.

Source: standard Denavit–Hartenberg frames with twists π/2, 0, 0, π/2, −π/2, 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, pi, sin, sqrt

from actors.arm.ur.robot_models import Calibration, RobotModel

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


def rotate(m: Matrix, v: Sequence[float]) -> Vector:
    """Matrix times vector."""
    x, y, z = v
    return (m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z)


def compose(a: Transform, b: Transform) -> Transform:
    """Compose two transforms: b, given in the frame a, in the frame in which a is given."""
    m, p = a
    x, y, z = rotate(m, b[1])
    return multiply(m, b[0]), (p[0] + x, p[1] + y, p[2] + z)


def transform_of(pose: Sequence[float]) -> Transform:
    """Transform of a pose x, y, z, rx, ry, rz."""
    return rotation_matrix(pose[3:6]), (pose[0], pose[1], pose[2])


def pose_of(frame: Transform) -> tuple[float, float, float, float, float, float]:
    """Pose of a transform."""
    return (*frame[1], *rotation_vector(frame[0]))


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Distance of two points, or of the positions of two poses [m]."""
    return sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


class Kinematics:
    """Kinematics of one robot model. Poses are those of the flange; the caller composes a tool.

    A calibrated robot follows its calibration: `flange` and `velocity`. The others use nominal lengths,
    since single frames of a calibrated robot may be hundreds of metres away.

    Args:
        model: lengths and joint ranges.
    """

    def __init__(self, model: RobotModel) -> None:
        self.model = model

    def flange(self, q: Sequence[float]) -> Transform:
        """Transform of the flange in the base's frame [m]."""
        if self.model.calibration is not None:
            return _frames(q, self.model.calibration)[-1]
        m = self.model
        q1, q2, q3, q4, q5, q6 = q
        s1, c1, s5, c5, s6, c6 = sin(q1), cos(q1), sin(q5), cos(q5), sin(q6), cos(q6)
        s2, c2, s23, c23 = sin(q2), cos(q2), sin(q2 + q3), cos(q2 + q3)
        s, c = sin(q2 + q3 + q4), cos(q2 + q3 + q4)
        # x and z of the frame after joint 4; its y is (s1, −c1, 0), the axis of joints 2 to 4.
        xx, xy, xz = c1 * c, s1 * c, s
        zx, zy, zz = c1 * s, s1 * s, -c
        ax, ay, az = xx * c5 + s1 * s5, xy * c5 - c1 * s5, xz * c5
        tx, ty, tz = -xx * s5 + s1 * c5, -xy * s5 - c1 * c5, -xz * s5
        reach = m.a2 * c2 + m.a3 * c23
        return (
            (
                ax * c6 - zx * s6,
                -ax * s6 - zx * c6,
                tx,
                ay * c6 - zy * s6,
                -ay * s6 - zy * c6,
                ty,
                az * c6 - zz * s6,
                -az * s6 - zz * c6,
                tz,
            ),
            (
                c1 * reach + m.d4 * s1 + m.d5 * zx + m.d6 * tx,
                s1 * reach - m.d4 * c1 + m.d5 * zy + m.d6 * ty,
                m.d1 + m.a2 * s2 + m.a3 * s23 + m.d5 * zz + m.d6 * tz,
            ),
        )

    def axes(self, q: Sequence[float]) -> tuple[list[Vector], list[Vector]]:
        """Directions of the six joint axes and a point on each, base frame [m]."""
        m = self.model
        q1, q2, q3, q4, q5, _ = q
        s1, c1, s5, c5 = sin(q1), cos(q1), sin(q5), cos(q5)
        s, c = sin(q2 + q3 + q4), cos(q2 + q3 + q4)
        across, wrist = (s1, -c1, 0.0), (c1 * s, s1 * s, -c)
        tool = (-c1 * c * s5 + s1 * c5, -s1 * c * s5 - c1 * c5, -s * s5)
        upper, both = m.a2 * cos(q2), m.a2 * cos(q2) + m.a3 * cos(q2 + q3)
        shoulder = (0.0, 0.0, m.d1)
        elbow = (c1 * upper, s1 * upper, m.d1 + m.a2 * sin(q2))
        w1 = (c1 * both, s1 * both, elbow[2] + m.a3 * sin(q2 + q3))
        w2 = (w1[0] + m.d4 * across[0], w1[1] + m.d4 * across[1], w1[2])
        w3 = (w2[0] + m.d5 * wrist[0], w2[1] + m.d5 * wrist[1], w2[2] + m.d5 * wrist[2])
        return [(0.0, 0.0, 1.0), across, across, across, wrist, tool], [(0.0, 0.0, 0.0), shoulder, elbow, w1, w2, w3]

    def velocity(
        self, q: Sequence[float], qd: Sequence[float], point: Vector
    ) -> tuple[float, float, float, float, float, float]:
        """Velocity of a point fixed to the flange [m/s] and the flange's angular velocity [rad/s], base frame."""
        if self.model.calibration is None:
            axes, origins = self.axes(q)
        else:
            before = [(IDENTITY, (0.0, 0.0, 0.0)), *_frames(q, self.model.calibration)[:5]]
            axes, origins = [(r[2], r[5], r[8]) for r, _ in before], [origin for _, origin in before]
        vx = vy = vz = wx = wy = wz = 0.0
        px, py, pz = point
        for (ax, ay, az), (ox, oy, oz), rate in zip(axes, origins, qd, strict=True):
            if rate:
                rx, ry, rz = px - ox, py - oy, pz - oz
                vx += rate * (ay * rz - az * ry)
                vy += rate * (az * rx - ax * rz)
                vz += rate * (ax * ry - ay * rx)
                wx += rate * ax
                wy += rate * ay
                wz += rate * az
        return vx, vy, vz, wx, wy, wz


def _frames(q: Sequence[float], dh: Calibration) -> list[Transform]:
    """Denavit–Hartenberg frames of the six links, base frame."""
    frame: Transform = (IDENTITY, (0.0, 0.0, 0.0))
    frames = []
    for joint, theta, a, d, twist in zip(q, dh.theta, dh.a, dh.d, dh.alpha, strict=True):
        angle = joint + theta
        turned = multiply(rotation_matrix((0.0, 0.0, angle)), rotation_matrix((twist, 0.0, 0.0)))
        frame = compose(frame, (turned, (a * cos(angle), a * sin(angle), d)))
        frames.append(frame)
    return frames
