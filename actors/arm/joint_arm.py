"""Arms with joints: the kinematics that planning needs, and the settings that all of them share.

- `ArmModel` is the kinematics of one arm: `actors.arm.ur.ur_kinematics` has a UR's in closed form,
  `actors.arm.urdf_chain` that of any chain from its URDF.
- `JointArmSettings` is the base class of their settings: the cell, how the pourer is held, and the limits.

Everything else about a path is the same for all of them: `actors.arm.planning`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Self

from actors.arm.arm_settings import ArmSettings
from actors.arm_geometry import ArmLimits, Centre, Mount, Pose, RobotCell, Speed, rotated
from sim_engine.settings.model import SET_BY_PROGRAM, Example
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from actors.arm.arm_interface import FloatArray

Acceleration = Annotated[float, Quantity("rad/s^2", "80 deg/s^2", 0.0, math.radians(2000.0), positive=True)]

_LIMITS = "{box: {low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}}"


@dataclass(frozen=True)
class LinkCapsule:
    """A link as a capsule.

    Attributes:
        name: for messages.
        first, second: its ends, as `ArmModel.points` counts; the number after the last point is the TCP.
        radius: [m].
    """

    name: str
    first: int
    second: int
    radius: float


class UnreachedError(Exception):
    """Poses of the flange that an arm cannot reach.

    Attributes:
        nominal: joints of an arm with nominal lengths, shape (T, n) [rad], which reaches them all; None without one.
    """

    def __init__(self, nominal: FloatArray | None = None) -> None:
        super().__init__("out of reach")
        self.nominal = nominal


class ArmModel(ABC):
    """Kinematics of one arm with n joints. Poses are those of the flange in the frame of the arm's base."""

    joint_names: tuple[str, ...]
    """Names in messages, in the order of the joints."""

    joint_low: tuple[float, ...]
    """Ranges of the joints [rad]."""

    joint_high: tuple[float, ...]

    joint_speed: tuple[float, ...]
    """Largest speeds [rad/s]."""

    range_remedy: str = "move the receiver, or wait at another 'home'"
    """The remedy for a path on which a joint leaves its range."""

    links: tuple[LinkCapsule, ...]
    """The links for collision checks, from the base to the tool."""

    bars: tuple[LinkCapsule, ...]
    """The links as they are drawn."""

    body: tuple[LinkCapsule, ...]
    """What a carried vessel must not touch."""

    hand: tuple[tuple[LinkCapsule, ...], ...]
    """For each capsule of `body`, the links near the flange that must not touch it."""

    checksum: str = ""
    """Of the arm's own calibration; '' for nominal lengths."""

    speed_slack: float = 1e-6
    """Relative tolerance of speed limits: rounding may put a path that is planned at a limit above it."""

    pose_error: tuple[float, float] = (0.0, 0.0)
    """Largest difference of a calibrated arm from its plan [m], [rad]."""

    @abstractmethod
    def forward(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (..., 3, 3) and positions (..., 3) [m] of the flange for joints (..., n) [rad]."""

    @abstractmethod
    def points(self, joints: FloatArray) -> FloatArray:
        """Points of the arm's capsules for joints (..., n) [rad], shape (..., P, 3) [m]; the first is the foot."""

    @abstractmethod
    def follow(self, rotation: FloatArray, position: FloatArray, near: FloatArray, home: FloatArray) -> FloatArray:
        """Joints along poses of the flange, without jumps, in the posture of home.

        Args:
            rotation, position: shapes (T, 3, 3) and (T, 3) [m].
            near: joints before the first pose, shape (n,) [rad].
            home: joints of the home pose [rad].

        Returns:
            Shape (T, n) [rad]; joints may leave their ranges.

        Raises:
            UnreachedError: some pose is out of reach.
        """

    @abstractmethod
    def step(self, rotation: FloatArray, position: FloatArray, start: FloatArray) -> FloatArray:
        """As `follow`, for a small step from joints that need not be in the posture of home."""

    @abstractmethod
    def out_of_reach(self, rotation: FloatArray, position: FloatArray, home: FloatArray) -> tuple[int, str]:
        """The pose of a path that is farthest out of reach in the posture of home: its index, and a sentence."""

    @abstractmethod
    def place_problem(self, rotation: FloatArray, position: FloatArray) -> str:
        """Why no posture reaches one pose, as a clause; '' if one does."""

    margin_names: tuple[str, ...]
    """What `margins` belong to, for messages."""

    @abstractmethod
    def margins(self, joints: FloatArray) -> FloatArray:
        """Distances of joints (..., n) from singular poses, shape (..., m); 0 is singular."""

    @abstractmethod
    def singular(self, joints: FloatArray, least: float, cure: str) -> Iterator[tuple[int, str]]:
        """Poses of a path (T, n) nearer to a singular one than `least`: index, and a sentence with the cure."""

    def link_error(self, joints: FloatArray) -> float:
        """Largest distance of a link from where `points` has it on a path (T, n) [m]."""
        return 0.0


class JointArmSettings(ArmSettings):
    """An arm with joints that holds the pourer: what planning and checks need."""

    mount: Mount = Mount()
    """Mounting of the robot; on a table unless given."""

    tool: Annotated[Pose, Example("{z: 180 mm}")]
    """Tool centre point in the flange's frame, as set on the teach pendant."""

    payload: Annotated[float, Quantity("kg", "1.5 kg", 0.0, 35.0)]
    """Mass of gripper and filled pourer, as set on the teach pendant."""

    payload_centre: Centre = Centre()
    """Centre of gravity of gripper and pourer in the flange's frame."""

    grip: Annotated[Pose, Example("{x: 60 mm, rx: 1.571 rad}")]
    """Pose of the pourer in the frame of the tool centre point: origin in the middle of its underside, z out of its opening, x towards the side where liquid leaves."""  # noqa: E501

    limits: Annotated[ArmLimits, Example(_LIMITS)]
    """Limits of the arm in this cell."""

    approach_speed: Speed = math.radians(40.0)
    """Speed of the fastest joint between home and pour."""

    approach_acceleration: Acceleration = math.radians(80.0)
    """Acceleration of the fastest joint between home and pour."""

    upright_speed: Speed = math.radians(10.0)
    """Speed at which a stopped, tilted pourer is brought upright."""

    warning_time: Annotated[float, Quantity("s", "3 s", 0.0, 60.0)] = 3.0
    """Time from the operator's consent to the first movement."""

    cell: Annotated[RobotCell, SET_BY_PROGRAM]
    """Objects around the arm: the laboratory's section `cell`."""

    @property
    @abstractmethod
    def kinematics(self) -> ArmModel:
        """The arm's kinematics."""

    @property
    @abstractmethod
    def home_joints(self) -> tuple[float, ...]:
        """The waiting pose of the arm, with the pourer upright [rad]."""

    def in_laboratory(self, cell: RobotCell | None, time_scale: float) -> Self:
        """See `ArmSettings.in_laboratory`."""
        return self.with_values(cell=cell, time_scale=time_scale)

    @property
    def payload_limit(self) -> float | None:
        """See `ArmSettings.payload_limit`."""
        return self.payload

    @property
    def tilt_speed_limit(self) -> float:
        """See `ArmSettings.tilt_speed_limit`; the limit of the last joint too, if the pourer turns about its axis."""
        import numpy as np

        home = np.array([self.home_joints, self.home_joints])
        home[1, -1] += 1.0
        before, after = self.kinematics.forward(home)[0]
        axis = np.array(rotated(self.tool, rotated(self.grip, (0.0, 1.0, 0.0))))  # of the tilt, in the flange's frame
        if np.linalg.norm(before.T @ after @ axis - axis) > 1e-3:
            return self.limits.tilt_speed
        return min(self.limits.tilt_speed, self.limits.joint_speed, self.kinematics.joint_speed[-1])

    @property
    def upright_time(self) -> float:
        """See `ArmSettings`."""
        return 4.0 * self.limits.tilt / self.upright_speed
