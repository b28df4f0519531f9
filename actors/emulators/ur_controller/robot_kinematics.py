"""Forward and inverse kinematics of the six-axis arm, in closed form, and poses in a robot controller's format.

A pose is x, y, z [m] and a rotation vector [rad]. The functions use plain scalars because they run at 500 Hz. A
rotation matrix is a tuple of its nine entries, row by row; a vector is a tuple of three.

Source: standard Denavit–Hartenberg frames with twists π/2, 0, 0, π/2, −π/2, 0. Three parallel axes (2, 3, 4) decouple
the inverse: joint 1 follows from the wrist position, 5 and 6 from the orientation, 2, 3, 4 from a triangle in the
plane. There are up to eight solutions: shoulder left or right, wrist up or down, elbow up or down.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import acos, asin, atan2, cos, hypot, pi, sin, sqrt

from actors.arm.ur.robot_models import Calibration, Joints, RobotModel

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


_SINGULAR_WRIST = 1e-6
"""Below this |sin q5| joints 4 and 6 turn about the same axis, and q6 keeps its given value."""


_SHIFTS = 40
"""Largest number of shifts; each leaves a few percent of the error, and more near a singularity."""


class Kinematics:
    """Kinematics of one robot model. Poses are those of the flange; the caller composes a tool.

    A calibrated robot follows its calibration: `flange`, `velocity` and `nearest`. The others use nominal lengths,
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

    def links(self, q: Sequence[float]) -> list[Transform]:
        """Denavit–Hartenberg frames of the six links, each at its link's distal end, base frame."""
        return _frames(q, self.model.nominal.parameters)

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

    def inverse(self, flange: Transform, q6: float = 0.0) -> Iterator[Joints]:
        """Yield all joint positions, each in (−π, π], for a flange transform; none if it is out of the workspace.

        Args:
            flange: target transform.
            q6: used for a singular wrist, where joint 6 is arbitrary [rad].
        """
        m = self.model
        r, p = flange
        wx, wy, wz = p[0] - m.d6 * r[2], p[1] - m.d6 * r[5], p[2] - m.d6 * r[8]
        radius = hypot(wx, wy)
        if radius < m.d4 - 1e-9 or radius == 0.0:
            return  # inside the cylinder about the base that the wrist cannot enter
        bearing, offset = atan2(wy, wx), asin(min(1.0, m.d4 / radius))
        for q1 in (bearing + offset, bearing + pi - offset):
            s1, c1 = sin(q1), cos(q1)
            cos5 = max(-1.0, min(1.0, s1 * r[2] - c1 * r[5]))
            for q5 in (acos(cos5), -acos(cos5)):
                sin5 = sin(q5)
                if abs(sin5) < _SINGULAR_WRIST:
                    sixth = q6
                else:
                    sixth = atan2(-(s1 * r[1] - c1 * r[4]) / sin5, (s1 * r[0] - c1 * r[3]) / sin5)
                s6, c6 = sin(sixth), cos(sixth)
                zx, zy, zz = -(r[0] * s6 + r[1] * c6), -(r[3] * s6 + r[4] * c6), -(r[6] * s6 + r[7] * c6)
                q234 = atan2(c1 * zx + s1 * zy, -zz)
                u = c1 * (wx - m.d5 * zx) + s1 * (wy - m.d5 * zy)
                w = wz - m.d5 * zz - m.d1
                cos3 = (u * u + w * w - m.a2 * m.a2 - m.a3 * m.a3) / (2.0 * m.a2 * m.a3)
                if abs(cos3) > 1.0 + 1e-9:
                    continue
                bend = acos(max(-1.0, min(1.0, cos3)))
                for q3 in (bend, -bend):
                    q2 = atan2(w, u) - atan2(m.a3 * sin(q3), m.a2 + m.a3 * cos(q3))
                    yield _turn(q1), _turn(q2), q3, _turn(q234 - q2 - q3), q5, sixth

    def nearest(self, flange: Transform, near: Sequence[float]) -> Joints | None:
        """Return the solution nearest to `near` within the joint ranges; None if there is none.

        For a calibrated robot the target of the closed form is shifted until its solution leads to `flange`.

        Args:
            flange: target transform.
            near: joint positions [rad]; solutions may lie beyond ±π to stay near them.
        """
        q = self._nominal_nearest(flange, near)
        if self.model.calibration is None:
            return q
        target = flange
        for _ in range(_SHIFTS):
            if q is None:
                return None
            pose = self.flange(q)
            if distance(pose[1], flange[1]) < 1e-9 and angle_between(pose[0], flange[0]) < 1e-9:
                return q
            target = compose(compose(flange, invert(pose)), target)
            q = self._nominal_nearest(target, q)
        return None

    def _nominal_nearest(self, flange: Transform, near: Sequence[float]) -> Joints | None:
        best: Joints | None = None
        least = float("inf")
        limits = self.model.joint_range
        for solution in self.inverse(flange, near[5]):
            total = 0.0
            turned = []
            for angle, previous, limit in zip(solution, near, limits, strict=True):
                k = angle + 2.0 * pi * round((previous - angle) / (2.0 * pi))
                if k > limit:
                    k -= 2.0 * pi
                elif k < -limit:
                    k += 2.0 * pi
                total += (k - previous) ** 2
                turned.append(k)
            if total < least:
                least = total
                best = (turned[0], turned[1], turned[2], turned[3], turned[4], turned[5])
        return best


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


def _turn(angle: float) -> float:
    return angle - 2.0 * pi * round(angle / (2.0 * pi))
