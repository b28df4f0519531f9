"""Settings of a UR arm: plain values. `actors.device_kinds.UrArmKind` joins them with driver and planner."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, Strict

from actors.arm.arm_settings import ArmSettings
from actors.arm.ur.robot_models import MODELS, Calibration, RobotModel, plausible_calibration
from actors.arm_geometry import ArmLimits, Centre, JointAngles, Mount, Pose, RobotCell, Speed
from sim_engine.settings.model import NOT_IN_FINGERPRINT, SET_BY_PROGRAM, Choice, Example, FilePath, Text
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFacts

ArmModel = Annotated[str, Choice(lambda: tuple(MODELS), similar=False)]

Acceleration = Annotated[float, Quantity("rad/s^2", "80 deg/s^2", 0.0, math.radians(2000.0), positive=True)]

_HOME = "{base: 0 deg, shoulder: -90 deg, elbow: 90 deg, wrist1: 0 deg, wrist2: -90 deg, wrist3: 0 deg}"
_LIMITS = "{box: {low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}}"


class UrArmSettings(ArmSettings):
    """A UR arm that holds the pourer."""

    kind: Literal["ur"] = "ur"
    """A UR robot; the default kind."""

    model: Annotated[ArmModel, Example("ur10e")]
    """Model of the robot."""

    address: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """Network address of its controller; a virtual laboratory starts its own controller."""

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

    home: Annotated[JointAngles, Example(_HOME)]
    """Waiting pose of the arm, with the pourer upright."""

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

    rate: Annotated[float, Quantity("1/s", "125 Hz", 100.0, 500.0)] = 125.0
    """Rate at which the joints are read back."""

    registers: Annotated[int, Strict(), Field(ge=0, le=44), NOT_IN_FINGERPRINT] = 43
    """First of the three integer inputs of the controller that are written, and of the four double inputs that a dose
    writes; 0 to 23 are reserved for a fieldbus."""

    cell: Annotated[RobotCell, SET_BY_PROGRAM]
    """Objects around the arm: the laboratory's section `cell`."""

    calibration_file: Annotated[FilePath | None, NOT_IN_FINGERPRINT] = None
    """Recording of this robot by 'decant robot check --record', with whose calibrated lengths pours are checked before it is connected; those of a plausible robot unless given."""  # noqa: E501

    calibration: Annotated[Calibration | None, SET_BY_PROGRAM] = None
    """Calibration of this robot: as `calibration_file` records it, and once it is connected, as its controller reports it. None for nominal lengths."""  # noqa: E501

    @property
    def robot(self) -> RobotModel:
        """The robot's kinematics: nominal, or calibrated."""
        return _robot(self.model, self.calibration)

    def in_laboratory(self, cell: RobotCell | None, time_scale: float) -> Self:
        """See `ArmSettings.in_laboratory`."""
        return self.with_values(cell=cell, time_scale=time_scale)

    def fitted_to(self, facts: ArmFacts) -> Self:
        """See `ArmSettings.fitted_to`: the robot's calibration."""
        return self.with_values(calibration=getattr(facts, "kinematics", None))

    def expected(self, *, virtual: bool) -> Self:
        """See `ArmSettings.expected`: the recorded calibration; else, and on a virtual bench, a plausible one."""
        recorded = None if virtual else self.calibration
        return self.with_values(calibration=recorded or plausible_calibration(MODELS[self.model]))

    @property
    def title(self) -> str:
        """See `ArmSettings.title`."""
        return f"{self.model.upper()} at {self.address}"

    @property
    def payload_limit(self) -> float | None:
        """See `ArmSettings.payload_limit`."""
        return self.payload

    @property
    def tilt_speed_limit(self) -> float:
        """See `ArmSettings.tilt_speed_limit`."""
        return self.limits.tilt_speed

    @property
    def upright_time(self) -> float:
        """See `ArmSettings`."""
        return 4.0 * self.limits.tilt / self.upright_speed


@lru_cache(maxsize=64)
def _robot(model: str, calibration: Calibration | None) -> RobotModel:
    return replace(MODELS[model], calibration=calibration)
