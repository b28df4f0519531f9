"""Kinematics of whole paths, transformations between the frames of a pour, and rotations; all in numpy.

- `forward`, `inverse` and `posture` are the closed forms of `ur_controller.robot_kinematics` on arrays.
- `flange_poses` converts poses of the pourer to poses of the flange, `pourer_transforms` converts joints to poses of
  the pourer. The frames are described in `actors.arm.arm_interface`.
- Rotations are matrices, vectors and quaternions (w first), of one or many. scipy has rotations too, but it takes a
  third of a second to import, which is too long for checking a file.

The virtual controller computes one pose every 2 ms. A planner computes a thousand at once, and distinguishes the
postures in which a pose can be reached. Both take the robots' lengths from one table; tests compare their results.

A *posture* is one of eight ways to reach a pose. It is defined by the side of the base's axis on which the shoulder is,
and by the directions in which wrist and elbow are bent. A path that avoids singularities stays in one posture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from actors.arm.ur.robot_models import MODELS, Calibration, RobotModel
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Pose
from sim_engine.collision import rotations
from sim_engine.scene import SampledMotion

__all__ = ["MODELS", "beyond_reach", "forward", "inverse", "link_points", "posture", "refined", "singularities"]

FloatArray = NDArray[np.float64]

POSTURES = 8

_SINGULAR_WRIST = 1e-6
"""Below this |sin q5| joints 4 and 6 rotate about the same axis; joint 6 is then set to 0."""


def forward(q: FloatArray, m: RobotModel) -> tuple[FloatArray, FloatArray]:
    """Pose of the flange.

    Args:
        q: joints, shape (..., 6) [rad].
        m: the robot.

    Returns:
        Rotation matrices (..., 3, 3) and positions (..., 3) [m], base frame.
    """
    if m.calibration is not None:
        return _chain(q, m.calibration)[2:]
    s1, c1, s5, c5, s6, c6 = (f(q[..., k]) for k in (0, 4, 5) for f in (np.sin, np.cos))
    q23 = q[..., 1] + q[..., 2]
    s, c = np.sin(q23 + q[..., 3]), np.cos(q23 + q[..., 3])
    # x and z of the frame after joint 4; its y is (s1, −c1, 0), the axis of joints 2 to 4
    x = np.stack([c1 * c, s1 * c, s], axis=-1)
    z = np.stack([c1 * s, s1 * s, -c], axis=-1)
    across = np.stack([s1, -c1, np.zeros_like(s1)], axis=-1)
    a = x * c5[..., None] + across * s5[..., None]
    tool = -x * s5[..., None] + across * c5[..., None]
    rotation = np.stack([a * c6[..., None] - z * s6[..., None], -a * s6[..., None] - z * c6[..., None], tool], axis=-1)
    reach = m.a2 * np.cos(q[..., 1]) + m.a3 * np.cos(q23)
    height = m.d1 + m.a2 * np.sin(q[..., 1]) + m.a3 * np.sin(q23)
    position = np.stack([c1 * reach, s1 * reach, height], axis=-1) + m.d4 * across + m.d5 * z + m.d6 * tool
    return rotation, position


def _chain(q: FloatArray, dh: Calibration) -> tuple[list[FloatArray], list[FloatArray], FloatArray, FloatArray]:
    """Directions of the joints' axes and a point on each, rotation and position of the flange of a calibrated robot."""
    rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
    position = np.zeros((*q.shape[:-1], 3))
    axes, points = [], []
    for k in range(6):
        s, c = np.sin(q[..., k] + dh.theta[k]), np.cos(q[..., k] + dh.theta[k])
        sa, ca = np.sin(dh.alpha[k]), np.cos(dh.alpha[k])
        zero = np.zeros_like(s)
        columns = [(c, s, zero), (-s * ca, c * ca, zero + sa), (s * sa, -c * sa, zero + ca)]
        turned = np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)
        axes.append(rotation[..., 2])
        points.append(position)
        step = np.stack([dh.a[k] * c, dh.a[k] * s, zero + dh.d[k]], axis=-1)
        position = position + (rotation @ step[..., None])[..., 0]
        rotation = rotation @ turned
    return axes, points, rotation, position


NEWTON_STEPS = 6
"""Most steps from the closed form's joints to those of a calibrated robot; two or three are usual."""


def refined(q: FloatArray, rotation: FloatArray, position: FloatArray, m: RobotModel) -> FloatArray:
    """Joints of a calibrated robot, by Newton steps from those of the closed form; the same joints if it is nominal.

    Args:
        q: joints that nearly reach the poses, shape (T, 6) [rad]; NaN if there are none.
        rotation, position: of the flange, shapes (T, 3, 3) and (T, 3) [m].
        m: the robot.

    Returns:
        Shape (T, 6) [rad]; NaN where there are none, as beyond the reach.
    """
    if m.calibration is None:
        return q
    q, solved = q.copy(), np.isfinite(q).all(axis=-1)
    for step in range(NEWTON_STEPS + 1):
        axes, points, flange, place = _chain(q[solved], m.calibration)
        apart = rotation[solved] @ np.swapaxes(flange, -1, -2)
        turn = 0.5 * np.stack([apart[:, 2, 1] - apart[:, 1, 2], apart[:, 0, 2] - apart[:, 2, 0],
                               apart[:, 1, 0] - apart[:, 0, 1]], axis=-1)  # fmt: skip
        error = np.concatenate([position[solved] - place, turn], axis=-1)
        if step == NEWTON_STEPS or not np.any(np.abs(error) > 1e-11):
            break
        columns = [
            np.concatenate([np.cross(axis, place - point), axis], axis=-1)
            for axis, point in zip(axes, points, strict=True)
        ]
        jacobian = np.stack(columns, axis=-1)
        transposed = np.swapaxes(jacobian, -1, -2)
        # slightly damped, so that a singular pose is no error here: its joints do not converge, and are NaN below
        change = np.linalg.solve(transposed @ jacobian + 1e-14 * np.eye(6), transposed @ error[..., None])
        q[solved] += change[..., 0]
    q[solved] = np.where(np.abs(error).max(axis=-1, keepdims=True) < 1e-8, q[solved], np.nan)
    return q


def inverse(rotation: FloatArray, position: FloatArray, m: RobotModel) -> FloatArray:
    """All postures that reach a pose of the flange; see `refined` for calibrated robots.

    Args:
        rotation: of the flange, shape (T, 3, 3).
        position: shape (T, 3) [m], base frame.
        m: the robot.

    Returns:
        Shape (T, 8, 6) [rad], each joint in −π … π, NaN if the pose is out of reach. Along a path a posture keeps its
        number: 4·shoulder + 2·wrist + elbow.
    """
    out = np.full((len(position), POSTURES, 6), np.nan)
    for number, (q1, q5, q6, q234, u, v) in enumerate(_wrists(rotation, position, m)):
        cos3 = (u * u + v * v - m.a2 * m.a2 - m.a3 * m.a3) / (2.0 * m.a2 * m.a3)
        with np.errstate(invalid="ignore"):
            bend = np.arccos(np.where(np.abs(cos3) > 1.0 + 1e-9, np.nan, np.clip(cos3, -1.0, 1.0)))
        for elbow, q3 in enumerate((bend, -bend)):
            q2 = np.arctan2(v, u) - np.arctan2(m.a3 * np.sin(q3), m.a2 + m.a3 * np.cos(q3))
            q = np.stack([q1, q2, q3, q234 - q2 - q3, q5, q6], axis=-1)
            q = np.where(np.isfinite(q).all(axis=-1, keepdims=True), q, np.nan)
            q = q - 2.0 * np.pi * np.round(q / (2.0 * np.pi))
            out[:, 2 * number + elbow] = refined(q, rotation, position, m)
    return out


def _wrists(rotation: FloatArray, position: FloatArray, m: RobotModel) -> Iterator[tuple[FloatArray, ...]]:
    """The four wrist postures.

    Each is given by q1, q5, q6, q2 + q3 + q4 and the position to which elbow and shoulder have to bring wrist 1, in the
    arm's plane from the shoulder [m]. All have shape (T,) and are NaN if the wrist cannot reach the pose."""
    r = rotation
    w = position - m.d6 * r[:, :, 2]
    radius = np.hypot(w[:, 0], w[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        # there is no solution inside the cylinder about the base that the wrist cannot enter: asin gives NaN
        offset = np.arcsin(np.where(radius < m.d4 - 1e-9, np.nan, np.minimum(1.0, m.d4 / radius)))
    bearing = np.arctan2(w[:, 1], w[:, 0])
    for q1 in (bearing + offset, bearing + np.pi - offset):
        s1, c1 = np.sin(q1), np.cos(q1)
        bend = np.arccos(np.clip(s1 * r[:, 0, 2] - c1 * r[:, 1, 2], -1.0, 1.0))
        for sign in (1.0, -1.0):
            q6 = np.arctan2(-sign * (s1 * r[:, 0, 1] - c1 * r[:, 1, 1]), sign * (s1 * r[:, 0, 0] - c1 * r[:, 1, 0]))
            q6 = np.where(np.abs(np.sin(bend)) < _SINGULAR_WRIST, 0.0, q6)
            z = -(r[:, :, 0] * np.sin(q6)[:, None] + r[:, :, 1] * np.cos(q6)[:, None])
            q234 = np.arctan2(c1 * z[:, 0] + s1 * z[:, 1], -z[:, 2])
            u = c1 * (w[:, 0] - m.d5 * z[:, 0]) + s1 * (w[:, 1] - m.d5 * z[:, 1])
            yield q1, sign * bend, q6, q234, u, w[:, 2] - m.d5 * z[:, 2] - m.d1


def posture(q: FloatArray, m: RobotModel) -> int:
    """Number of the posture of joints (6,), as `inverse` counts."""
    rotation, position = forward(q[None], m.nominal)
    solutions = inverse(rotation, position, m.nominal)[0]
    apart = np.abs(np.angle(np.exp(1j * (solutions - q)))).max(axis=-1)
    return int(np.nanargmin(apart))


def singularities(q: FloatArray, m: RobotModel) -> FloatArray:
    """Distance of joints from singularities, shape (..., 3): shoulder, elbow, wrist; 0 is singular.

    Elbow and wrist: |sin| of their angle. Shoulder: distance of the wrist from the plane through the base's axis and
    along joint 2's, divided by the length of both links.
    """
    q23 = q[..., 1] + q[..., 2]
    u = m.a2 * np.cos(q[..., 1]) + m.a3 * np.cos(q23) + m.d5 * np.sin(q23 + q[..., 3])
    shoulder = np.abs(u) / (abs(m.a2) + abs(m.a3))
    return np.stack([shoulder, np.abs(np.sin(q[..., 2])), np.abs(np.sin(q[..., 4]))], axis=-1)


def beyond_reach(rotation: FloatArray, position: FloatArray, m: RobotModel) -> FloatArray:
    """Distance of poses beyond the reach, shape (T, 8) [m], in every posture as `inverse` counts; 0 within reach.

    Negative if a pose is too near for the arm to fold or, inside the base's own cylinder, for the wrist to get there.
    """
    distances = np.stack([np.hypot(u, v) for *_, u, v in _wrists(rotation, position, m)], axis=-1)
    too_far = distances - abs(m.a2) - abs(m.a3)
    too_near = distances - abs(abs(m.a2) - abs(m.a3))
    w = position - m.d6 * rotation[:, :, 2]
    inside = (np.hypot(w[:, 0], w[:, 1]) - m.d4)[:, None]
    beyond = np.where(too_far > 0.0, too_far, np.minimum(too_near, 0.0))
    return np.repeat(np.where(np.isnan(distances), inside, beyond), 2, axis=-1)


def link_points(q: FloatArray, m: RobotModel) -> FloatArray:
    """Points along the arm's middle line, shape (..., 8, 3) [m].

    Shoulder, both ends of the upper arm, both ends of the forearm, wrist 1, wrist 2, flange. Upper arm and forearm run
    side by side: the upper arm is farther out by about d4, the forearm by a quarter of that.
    """
    s1, c1 = np.sin(q[..., 0]), np.cos(q[..., 0])
    zero = np.zeros_like(s1)
    radial, across = np.stack([c1, s1, zero], axis=-1), np.stack([s1, -c1, zero], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    q23 = q[..., 1] + q[..., 2]
    s, c = np.sin(q23 + q[..., 3]), np.cos(q23 + q[..., 3])
    shoulder = np.broadcast_to(m.d1 * up, across.shape)
    elbow = shoulder + m.a2 * (np.cos(q[..., 1])[..., None] * radial + np.sin(q[..., 1])[..., None] * up)
    w1 = elbow + m.a3 * (np.cos(q23)[..., None] * radial + np.sin(q23)[..., None] * up)
    w2 = w1 + m.d4 * across
    w3 = w2 + m.d5 * (s[..., None] * radial - c[..., None] * up)
    _, flange = forward(q, m.nominal)
    outside, inside = m.d4 * across, 0.25 * m.d4 * across
    return np.stack(
        [shoulder, shoulder + outside, elbow + outside, elbow + inside, w1 + inside, w2, w3, flange], axis=-2
    )


def about(axis: str, angle: float) -> FloatArray:
    """Matrix (3, 3) of a rotation by `angle` [rad] about 'x', 'y' or 'z'."""
    k = "xyz".index(axis)
    return from_vector(np.eye(3)[k] * angle)


def from_vector(vector: Sequence[float] | FloatArray) -> FloatArray:
    """Matrix (3, 3) of a rotation vector, whose length is the angle [rad] (Rodrigues' formula)."""
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    x, y, z = v / angle if angle > 0.0 else v
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # 1 − cos as 2 sin²: exact for angles of any size
    matrix: FloatArray = np.eye(3) + np.sin(angle) * cross + 2.0 * np.sin(0.5 * angle) ** 2 * (cross @ cross)
    return matrix


def to_quaternions(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (T, 4) of matrices (T, 3, 3); their signs are arbitrary.

    Each is computed from the largest of its own four components, which avoids division by values near zero. Source:
    Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1 (1978).
    """
    r = rotation
    trace = np.trace(r, axis1=1, axis2=2)
    diagonal = np.diagonal(r, axis1=1, axis2=2)
    # row k: 4 q_k q, for k = w, x, y, z
    products = np.empty((len(r), 4, 4))
    products[:, 0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[:, i + 1, i + 1] = 1.0 + 2.0 * diagonal[:, i] - trace
        products[:, 0, i + 1] = products[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        products[:, j + 1, k + 1] = products[:, k + 1, j + 1] = r[:, j, k] + r[:, k, j]
    largest = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=1)
    quaternions = products[np.arange(len(r)), largest]
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True), dtype=float)


def between(a: FloatArray, b: FloatArray, shares: FloatArray) -> FloatArray:
    """Quaternions (N, 4) on the shortest rotation from a to b, both (4,), at `shares` of its angle, 0 … 1 (N,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < 0.0:
        b, cosine = -b, -cosine
    across = b - cosine * a
    sine = float(np.linalg.norm(across))
    if sine < 1e-12:
        return np.repeat(a[None], len(shares), axis=0)
    angle = shares[:, None] * np.arctan2(sine, cosine)
    turned: FloatArray = np.cos(angle) * a + np.sin(angle) * (across / sine)
    return turned


@dataclass(frozen=True, eq=False)
class Transforms:
    """Rotations and positions of one or many frames in another.

    Attributes:
        rotation: shape (..., 3, 3).
        position: shape (..., 3) [m].
    """

    rotation: FloatArray
    position: FloatArray

    def __matmul__(self, inner: Transforms) -> Transforms:
        """Compose: `inner` is given in this frame, the result in this frame's parent."""
        return Transforms(self.rotation @ inner.rotation, self.apply(inner.position))

    def apply(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3) of this frame to its parent frame [m]."""
        moved: FloatArray = (self.rotation @ points[..., None])[..., 0] + self.position
        return moved

    @property
    def inverse(self) -> Transforms:
        """The inverse transformation."""
        back = np.swapaxes(self.rotation, -1, -2)
        return Transforms(back, -(back @ self.position[..., None])[..., 0])


def transform_of(pose: Pose) -> Transforms:
    """Convert a pose with a rotation vector."""
    return Transforms(from_vector([pose.rx, pose.ry, pose.rz]), np.array([pose.x, pose.y, pose.z]))


@dataclass(frozen=True, eq=False)
class CellTransforms:
    """Frames that are constant during a pour.

    Attributes:
        base: in the room's frame.
        world: in the room's frame.
        tool: TCP in the flange's frame.
        pourer: in the flange's frame.
    """

    base: Transforms
    world: Transforms
    tool: Transforms
    pourer: Transforms


@lru_cache(maxsize=32)
def cell_transforms(spec: UrArmSettings) -> CellTransforms:
    """The constant frames of a cell."""
    tool = transform_of(spec.tool)
    mount = about("x", spec.mount.tilt) @ about("z", spec.mount.turn)  # first turned about its own z, then tilted
    return CellTransforms(
        Transforms(mount, np.zeros(3)),
        Transforms(about("z", spec.cell.direction), np.array(spec.cell.receiver.vector)),
        tool,
        tool @ transform_of(spec.grip),
    )


def flange_poses(poses: FloatArray, spec: UrArmSettings) -> Transforms:
    """Poses of the flange in the base's frame.

    Args:
        poses: of the pourer in the world, shape (T, 7): x y z [m], qw qx qy qz.
        spec: of the arm and its cell.
    """
    cell = cell_transforms(spec)
    return cell.base.inverse @ cell.world @ Transforms(rotations(poses), poses[:, :3]) @ cell.pourer.inverse


def pourer_transforms(joints: FloatArray, spec: UrArmSettings) -> Transforms:
    """Poses of the pourer in the room's frame for joints (T, 6) [rad]."""
    return flange_transforms(joints, spec) @ cell_transforms(spec).pourer


def flange_transforms(joints: FloatArray, spec: UrArmSettings) -> Transforms:
    """Poses of the flange in the room's frame for joints (T, 6) [rad]."""
    return cell_transforms(spec).base @ Transforms(*forward(joints, spec.robot))


def quaternions(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (T, 4), w first, of rotation matrices (T, 3, 3), without jumps; the first has w ≥ 0."""
    q = to_quaternions(rotation)
    with_last = np.sum(q[1:] * q[:-1], axis=-1)
    sign = np.cumprod(np.where(with_last < 0.0, -1.0, 1.0))
    first = -1.0 if q[0, 0] < 0.0 else 1.0
    signed: FloatArray = q * first * np.concatenate([[1.0], sign])[:, None]
    return signed


def pourer_motion(
    joints: FloatArray, times: FloatArray, spec: UrArmSettings, *, grip_tilt: float = 0.0
) -> SampledMotion:
    """The motion of the pourer according to an arm's encoders.

    Args:
        joints: shape (T, 6) [rad].
        times: of the readings, shape (T,), increasing from 0 [s].
        spec: of the arm and its cell.
        grip_tilt: error of grip: the pourer is rotated in the gripper by this angle about its own y axis through the
            tool centre point, and therefore tilted more [rad]. An arm cannot measure it; it belongs to the ground truth
            of a virtual bench.

    Returns:
        The pourer's motion in the world.
    """
    cell = cell_transforms(spec)
    grip = cell.tool.inverse @ cell.pourer
    slipped = grip.rotation @ about("y", grip_tilt) @ grip.rotation.T
    held = cell.tool @ Transforms(slipped, np.zeros(3)) @ grip
    frames = cell.world.inverse @ flange_transforms(joints, spec) @ held
    return SampledMotion(times, np.concatenate([frames.position, quaternions(frames.rotation)], axis=-1))
