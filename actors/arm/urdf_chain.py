"""Any arm from its URDF: kinematics, ranges, speeds and collision geometry, by Pinocchio.

- `ChainModel` is the `ArmModel` of the links between a base and a flange.
- `ChainArmSettings` and `ChainArmKind` are the base classes of such arms; a plug-in adds a driver
  (`actors.arm.joint_driver.JointArm`).

**Redundancy.** Of all joints that reach a pose, those nearest to home are taken, each joint measured by its range. They
are a function of the pose, so that a path that returns to a pose returns to the same joints, and the elbow does not
flip: a path along which they jump is refused.

Limitations: revolute joints only. Meshes and boxes count as the smallest capsule around them that lies along one of
their principal axes.

Source of Pinocchio: Carpentier et al., The Pinocchio C++ library, SII 2019.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_arm import ArmModel, JointArmSettings, LinkCapsule, UnreachedError
from actors.arm.joint_arm_kind import JointArmKind
from actors.arm_geometry import Angle, RobotCell
from sim_engine.settings.model import Example, Problems
from sim_engine.settings.plugin_registry import DISTRIBUTION

FloatArray = NDArray[np.float64]

GRIPPER_RADIUS = 0.04
"""Radius of the capsule from the flange to the tool centre point [m]: a slim gripper."""

JUMP = math.radians(15.0)
"""Largest change of a joint between two poses of a path; more is another posture [rad]."""

POSE_ERROR = 1e-9
"""Largest error of a solution [m], [rad]."""

HOME_ERROR = 1e-6
"""Largest step that a solution still makes towards home [rad]."""

ITERATIONS = 200
LONGEST_STEP = 0.3
"""Largest change of a joint in one iteration [rad]."""

STARTS = 12
"""Random joints from which a place is tried that home does not reach."""


class ChainError(ValueError):
    """A URDF is not the arm that is asked for; the text says what is missing."""


class ChainModel(ArmModel):
    """The links of a URDF between a base and a flange.

    Args:
        urdf: the file; meshes, also those of `package://`, are sought in its folder and in all folders above it.
        base, flange: names of links.

    Raises:
        ChainError: the file cannot be read, or has no such chain of limited revolute joints.
    """

    margin_names = ("arm",)

    def __init__(self, urdf: Path, base: str, flange: str) -> None:
        import pinocchio as pin

        self._pin = pin
        try:
            whole = pin.buildModelFromUrdf(str(urdf))
        except (ValueError, RuntimeError) as error:
            raise ChainError(f"{urdf}: can't be read as a URDF: {error}") from None
        for name in (base, flange):
            if not whole.existBodyName(name):
                links = ", ".join(f.name for f in whole.frames if f.type == pin.FrameType.BODY)
                raise ChainError(f"{urdf}: has no link '{name}'; there are {links}")
        frame, root = whole.frames[whole.getBodyId(flange)], whole.frames[whole.getBodyId(base)]
        chain = [k for k in whole.supports[frame.parentJoint] if k > root.parentJoint]
        if not chain or root.parentJoint not in whole.supports[frame.parentJoint]:
            raise ChainError(f"{urdf}: no joint moves link '{flange}' against link '{base}'")
        for k in chain:
            self._check_joint(urdf, whole, k)
        folders = [str(folder) for folder in urdf.absolute().parents]
        try:
            shapes = pin.buildGeomFromUrdf(whole, str(urdf), pin.GeometryType.COLLISION, package_dirs=folders)
        except (ValueError, RuntimeError) as error:
            raise ChainError(
                f"{urdf}: its collision geometry can't be read ({error}); meshes are sought in its folder and above"
            ) from None
        kept = [whole.names[k] for k in chain]
        others = [k for k in range(1, whole.njoints) if k not in chain]
        try:
            self._model, self._shapes = pin.buildReducedModel(whole, shapes, others, pin.neutral(whole))
        except ValueError as error:
            raise ChainError(f"{urdf}: links and joints need names of their own: {error}") from None
        frame, root = (self._model.frames[self._model.getBodyId(name)] for name in (flange, base))
        self._tip, self._flange = frame.parentJoint, frame.placement
        self._root, self._frame = root.placement.inverse(), self._model.getBodyId(flange)
        model, count = self._model, len(kept)
        self.joint_names = tuple(f"joint {k} ({name})" for k, name in enumerate(model.names.tolist()[1:], start=1))
        self.joint_low, self.joint_high, self.joint_speed = (
            tuple(map(float, values))
            for values in (model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit)
        )
        self._low, self._high = np.array(self.joint_low), np.array(self.joint_high)
        self._softness = np.square(self._high - self._low)
        self._reach = float(sum(np.linalg.norm(p.translation) for p in model.jointPlacements.tolist()[2:])) + float(
            np.linalg.norm(self._flange.translation)
        )
        self._make_capsules(count)

    @staticmethod
    def _check_joint(urdf: Path, whole: Any, k: int) -> None:
        name, kind = whole.names[k], whole.joints[k].shortname()
        if whole.joints[k].nq != 1 or not kind.startswith("JointModelR"):
            unlimited = kind.startswith("JointModelRU")
            why = "turns without limits" if unlimited else f"is a {kind.removeprefix('JointModel')}"
            raise ChainError(f"{urdf}: joint '{name}' {why}; a revolute joint with limits is needed")
        index = whole.joints[k].idx_q
        low, high, speed = (
            float(values[index]) for values in (whole.lowerPositionLimit, whole.upperPositionLimit, whole.velocityLimit)
        )
        if not (-100.0 < low < high < 100.0 and 0.0 < speed < 1e3):
            raise ChainError(f"{urdf}: joint '{name}' has no limits; add <limit lower upper velocity effort>")

    def _make_capsules(self, count: int) -> None:
        joints: list[int] = []
        ends: list[FloatArray] = []
        made: list[tuple[int, LinkCapsule]] = []
        for shape in self._shapes.geometryObjects.tolist():
            points, radius = _capsule(shape)
            first = 1 + len(ends)
            name = self._model.frames[shape.parentFrame].name
            made.append((shape.parentJoint, LinkCapsule(name, first, first + 1, radius)))
            joints += [shape.parentJoint] * 2
            ends += [shape.placement.act(point) for point in points]
        self._ends = np.array(joints, dtype=int), np.array(ends).reshape(-1, 3)
        flange = 1 + len(ends)
        gripper = LinkCapsule("gripper", flange, flange + 1, GRIPPER_RADIUS)
        near = (*(link for joint, link in made if joint >= count - 1), gripper)
        self.links = (*(link for joint, link in made if joint >= 2), gripper)
        bars = (*(link for _, link in made), gripper)
        self.bars = (replace(bars[0], first=0), *bars[1:])
        body = [(joint, link) for joint, link in made if joint <= count - 3]
        self.body = tuple(link for _, link in body)
        self.hand = tuple(near if joint <= count - 4 else () for joint, _ in body)

    # ---- forwards

    def _frames(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Frames of all joints (N, n + 1, 3, 3) and (N, n + 1, 3), the first of the base, for joints (N, n)."""
        data = self._model.createData()
        rotations = np.empty((len(joints), self._model.njoints, 3, 3))
        positions = np.empty((len(joints), self._model.njoints, 3))
        for i, q in enumerate(joints):
            self._pin.forwardKinematics(self._model, data, q)
            for k in range(self._model.njoints):
                placement = data.oMi[k]
                rotations[i, k], positions[i, k] = placement.rotation, placement.translation
        turn, shift = self._root.rotation, self._root.translation
        return turn @ rotations, positions @ turn.T + shift

    def forward(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `ArmModel.forward`."""
        rotations, positions = self._frames(joints.reshape(-1, joints.shape[-1]))
        tip = rotations[:, self._tip]
        place = tip @ self._flange.translation + positions[:, self._tip]
        shape = joints.shape[:-1]
        return (tip @ self._flange.rotation).reshape(*shape, 3, 3), place.reshape(*shape, 3)

    def points(self, joints: FloatArray) -> FloatArray:
        """See `ArmModel.points`: the foot, both ends of each capsule, the flange."""
        rotations, positions = self._frames(joints.reshape(-1, joints.shape[-1]))
        owner, local = self._ends
        ends = (rotations[:, owner] @ local[:, :, None])[..., 0] + positions[:, owner]
        flange = rotations[:, self._tip] @ self._flange.translation + positions[:, self._tip]
        foot = np.zeros((len(positions), 1, 3))
        points = np.concatenate([foot, ends, flange[:, None]], axis=1)
        return points.reshape(*joints.shape[:-1], *points.shape[1:])

    def _jacobian(self, data: Any, q: FloatArray) -> tuple[Any, FloatArray]:
        """Pose of the flange in the model's frame, and its Jacobian (6, n), velocity first."""
        pin = self._pin
        pin.computeJointJacobians(self._model, data, q)
        pose = pin.updateFramePlacement(self._model, data, self._frame)
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return pose, pin.getFrameJacobian(self._model, data, self._frame, axes)

    def margins(self, joints: FloatArray) -> FloatArray:
        """See `ArmModel.margins`: the smallest singular value of the Jacobian, lengths as shares of the reach."""
        data = self._model.createData()
        flat = joints.reshape(-1, joints.shape[-1])
        stack = np.array([self._jacobian(data, q)[1] for q in flat])
        stack[:, :3] /= self._reach
        least: FloatArray = np.linalg.svd(stack, compute_uv=False)[:, -1:]
        return least.reshape(*joints.shape[:-1], 1)

    def singular(self, joints: FloatArray, least: float, cure: str) -> Iterator[tuple[int, str]]:
        """See `ArmModel.singular`."""
        margins = self.margins(joints)[:, 0]
        worst = int(np.argmin(margins))
        if margins[worst] < least:
            yield worst, f"the arm {margins[worst]:.2f} from a singular pose, {least:.2f} are asked for; {cure}"

    # ---- backwards

    def _solve(self, pose: Any, start: FloatArray, home: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joints nearest to home that reach a pose, by damped Newton steps; and the error that is left, shape (6,)."""
        pin, data = self._pin, self._model.createData()
        q, soft = start.copy(), self._softness
        for _ in range(ITERATIONS):
            here, jacobian = self._jacobian(data, q)
            error = np.concatenate([pose.translation - here.translation, pin.log3(pose.rotation @ here.rotation.T)])
            weighted = soft[:, None] * jacobian.T
            square = jacobian @ weighted
            square[np.diag_indices(6)] += 1e-10 + 1e-3 * float(error @ error)
            inverse = np.linalg.solve(square, np.column_stack([error, jacobian @ (home - q)]))
            reach, along = weighted @ inverse[:, 0], (home - q) - weighted @ inverse[:, 1]
            if np.abs(error).max() < POSE_ERROR and np.abs(along).max() < HOME_ERROR:
                break
            step = reach + along
            q = q + step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        return q, error

    def _poses(self, rotation: FloatArray, position: FloatArray) -> list[Any]:
        base = self._root.inverse()
        return [base * self._pin.SE3(r, p) for r, p in zip(rotation, position, strict=True)]

    def follow(self, rotation: FloatArray, position: FloatArray, near: FloatArray, home: FloatArray) -> FloatArray:
        """See `ArmModel.follow`."""
        joints: list[FloatArray] = []
        before = near
        for pose in self._poses(rotation, position):
            q, error = self._solve(pose, before, home)
            if np.abs(error).max() > 1e-6 or (joints and np.abs(q - before).max() > JUMP):
                raise UnreachedError
            joints.append(q)
            before = q
        return np.array(joints)

    def step(self, rotation: FloatArray, position: FloatArray, start: FloatArray) -> FloatArray:
        """See `ArmModel.step`: the spare joint stays where it is."""
        return self.follow(rotation, position, start, start)

    def out_of_reach(self, rotation: FloatArray, position: FloatArray, home: FloatArray) -> tuple[int, str]:
        """See `ArmModel.out_of_reach`."""
        before, worst, farthest = home, 0, 0.0
        for index, pose in enumerate(self._poses(rotation, position)):
            q, error = self._solve(pose, before, home)
            apart = float(np.linalg.norm(error[:3]))
            if np.abs(error).max() <= 1e-6 and np.abs(q - before).max() > JUMP and index:
                return index, "the arm would have to change its posture; move the receiver, or wait at another 'home'"
            if apart > farthest * (1.0 + 1e-6) + 1e-6 or (not farthest and np.abs(error).max() > 1e-6):
                worst, farthest = index, max(apart, 1e-6)
            before = q if np.abs(error).max() <= 1e-6 else before
        return worst, f"out of the arm's reach by {1e3 * farthest:.0f} mm; move the receiver nearer or lower"

    def place_problem(self, rotation: FloatArray, position: FloatArray) -> str:
        """See `ArmModel.place_problem`."""
        pose, middle, rng = self._poses(rotation, position)[0], 0.5 * (self._low + self._high), np.random.default_rng(0)
        apart = []
        for start in [middle, *rng.uniform(self._low, self._high, (STARTS, len(middle)))]:
            _, error = self._solve(pose, start, middle)
            if np.abs(error).max() <= 1e-6:
                return ""
            apart.append(float(np.linalg.norm(error[:3])))
        return f"out of reach by {1e3 * min(apart):.0f} mm; move the receiver nearer to the base"


def _capsule(shape: Any) -> tuple[list[FloatArray], float]:
    """Ends and radius of a capsule around a collision shape, in the shape's frame [m]."""
    geometry, up = shape.geometry, np.array([0.0, 0.0, 1.0])
    name = type(geometry).__name__
    if name == "Sphere":
        return [np.zeros(3), np.zeros(3)], float(geometry.radius)
    if name in ("Cylinder", "Capsule"):
        return [geometry.halfLength * up, -geometry.halfLength * up], float(geometry.radius)
    if name == "Box":
        half = geometry.halfSide
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    elif hasattr(geometry, "vertices"):
        corners = np.array(geometry.vertices())
    else:
        raise ChainError(f"collision geometry of the kind {name} is not supported: use a mesh, box, cylinder or sphere")
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    axes = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2]
    best: tuple[float, list[FloatArray], float] | None = None
    for axis in axes:
        along = (corners - middle) @ axis
        across = np.linalg.norm(corners - middle - along[:, None] * axis, axis=1)
        radius = float(across.max())
        cap = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
        low, high = float((along + cap).min()), float((along - cap).max())
        if low > high:
            low = high = 0.5 * (low + high)
        volume = math.pi * radius**2 * (high - low + 4.0 / 3.0 * radius)
        if best is None or volume < best[0]:
            best = volume, [middle + low * axis, middle + high * axis], radius
    assert best is not None
    return best[1], best[2]


@lru_cache(maxsize=16)
def chain_of(urdf: Path, base: str, flange: str) -> ChainModel:
    """The chain of a URDF; it is read once."""
    return ChainModel(urdf, base, flange)


class ChainArmSettings(JointArmSettings):
    """An arm with the kinematics of its URDF."""

    urdf: ClassVar[Path]
    """The file. Collision meshes lie in its folder, or in the folders of their packages above it, at any depth."""

    base_link: ClassVar[str] = "base_link"
    """Link whose frame is the arm's base."""

    flange_link: ClassVar[str] = "flange"
    """Link whose frame is the flange."""

    home: Annotated[tuple[Angle, ...], Example("[0 deg, -45 deg, 0 deg, -135 deg, 0 deg, 90 deg, 45 deg]")]
    """Waiting pose of the arm, with the pourer upright: all joints, from the base on."""

    @property
    def kinematics(self) -> ChainModel:
        """See `JointArmSettings.kinematics`."""
        return chain_of(self.urdf, self.base_link, self.flange_link)

    @property
    def home_joints(self) -> tuple[float, ...]:
        """See `JointArmSettings.home_joints`."""
        return self.home


S = TypeVar("S", bound=ChainArmSettings)


class ChainArmKind(JointArmKind[S]):
    """An arm with the kinematics of its URDF; a subclass adds `settings` and `robot`."""

    robot: ClassVar[type[Any]]
    """Class of the robot (`actors.arm.joint_driver.JointRobot`), made from the settings; importable by name."""

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmKind.driver`."""
        from actors.arm.joint_driver import JointArm

        return JointArm, (self.spec, self.robot)

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        arm = problems.within("arm")
        if text := self.missing():
            arm.add(text, of="kind")
            return
        try:
            chain = self.spec.kinematics
        except ChainError as error:
            arm.add(str(error), of="kind")
            return
        if arm.valid("home") and len(self.spec.home) != len(chain.joint_names):
            arm.add(f"has {len(self.spec.home)} joints; this arm has {len(chain.joint_names)}", "home")
            return
        super().check_laboratory(problems, mode=mode, cell=cell)

    def missing(self) -> str | None:
        """See `ArmKind.missing`."""
        if importlib.util.find_spec("pinocchio") is not None:
            return None
        return f"the kinematics of an arm from its URDF needs Pinocchio; run: pip install '{DISTRIBUTION}[urdf]'"
