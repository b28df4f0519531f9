"""Transformations between the frames of a pour, and rotations; all in numpy.

- `flange_poses` converts poses of the pourer to poses of the flange, `pourer_transforms` converts joints to poses of
  the pourer. The frames are described in `actors.arm_geometry`.
- Rotations are matrices, vectors and quaternions (w first), of one or many. scipy has rotations too, but it takes a
  third of a second to import, which is too long for checking a file.

The kinematics of an arm is its `ArmModel`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_arm import JointArmSettings
from actors.arm_geometry import Pose
from sim_engine.collision import rotations
from sim_engine.scene import SampledMotion

FloatArray = NDArray[np.float64]


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
def cell_transforms(spec: JointArmSettings) -> CellTransforms:
    """The constant frames of a cell."""
    tool = transform_of(spec.tool)
    mount = about("x", spec.mount.tilt) @ about("z", spec.mount.turn)  # first turned about its own z, then tilted
    return CellTransforms(
        Transforms(mount, np.zeros(3)),
        Transforms(about("z", spec.cell.direction), np.array(spec.cell.receiver.vector)),
        tool,
        tool @ transform_of(spec.grip),
    )


def flange_poses(poses: FloatArray, spec: JointArmSettings) -> Transforms:
    """Poses of the flange in the base's frame.

    Args:
        poses: of the pourer in the world, shape (T, 7): x y z [m], qw qx qy qz.
        spec: of the arm and its cell.
    """
    cell = cell_transforms(spec)
    return cell.base.inverse @ cell.world @ Transforms(rotations(poses), poses[:, :3]) @ cell.pourer.inverse


def pourer_transforms(joints: FloatArray, spec: JointArmSettings) -> Transforms:
    """Poses of the pourer in the room's frame for joints (T, n) [rad]."""
    return flange_transforms(joints, spec) @ cell_transforms(spec).pourer


def flange_transforms(joints: FloatArray, spec: JointArmSettings) -> Transforms:
    """Poses of the flange in the room's frame for joints (T, n) [rad]."""
    return cell_transforms(spec).base @ Transforms(*spec.kinematics.forward(joints))


def quaternions(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (T, 4), w first, of rotation matrices (T, 3, 3), without jumps; the first has w ≥ 0."""
    q = to_quaternions(rotation)
    with_last = np.sum(q[1:] * q[:-1], axis=-1)
    sign = np.cumprod(np.where(with_last < 0.0, -1.0, 1.0))
    first = -1.0 if q[0, 0] < 0.0 else 1.0
    signed: FloatArray = q * first * np.concatenate([[1.0], sign])[:, None]
    return signed


def pourer_motion(
    joints: FloatArray, times: FloatArray, spec: JointArmSettings, *, grip_tilt: float = 0.0
) -> SampledMotion:
    """The motion of the pourer according to an arm's encoders.

    Args:
        joints: shape (T, n) [rad].
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
