"""Settings of a UR arm: plain values. `actors.device_kinds.UrArmKind` joins them with driver and planner."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import Field, Strict

from actors.arm.joint_arm import JointArmSettings
from actors.arm.ur.robot_models import MODELS, Calibration, RobotModel, plausible_calibration
from actors.arm_geometry import JointAngles, Joints
from sim_engine.settings.model import NOT_IN_FINGERPRINT, SET_BY_PROGRAM, Choice, Example, FilePath, Text
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFacts
    from actors.arm.ur.ur_kinematics import UrKinematics

ArmModel = Annotated[str, Choice(lambda: tuple(MODELS), similar=False)]

_HOME = "{base: 0 deg, shoulder: -90 deg, elbow: 90 deg, wrist1: 0 deg, wrist2: -90 deg, wrist3: 0 deg}"


class UrArmSettings(JointArmSettings):
    """A UR arm that holds the pourer."""

    digital_outputs: ClassVar[bool] = True

    kind: Literal["ur"] = "ur"
    """A UR robot; the default kind."""

    model: Annotated[ArmModel, Example("ur10e")]
    """Model of the robot."""

    address: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """Network address of its controller; a virtual laboratory starts its own controller."""

    home: Annotated[JointAngles, Example(_HOME)]
    """Waiting pose of the arm, with the pourer upright."""

    rate: Annotated[float, Quantity("1/s", "125 Hz", 100.0, 500.0)] = 125.0
    """Rate at which the joints are read back; readings missing between two on the planned path are taken from it."""

    registers: Annotated[int, Strict(), Field(ge=0, le=44), NOT_IN_FINGERPRINT] = 43
    """First of the three integer inputs of the controller that are written, and of the four double inputs that a dose
    writes; 0 to 23 are reserved for a fieldbus."""

    calibration_file: Annotated[FilePath | None, NOT_IN_FINGERPRINT] = None
    """Recording of this robot by 'decant robot check --record', with whose calibrated lengths pours are checked before it is connected; those of a plausible robot unless given."""  # noqa: E501

    calibration: Annotated[Calibration | None, SET_BY_PROGRAM] = None
    """Calibration of this robot: as `calibration_file` records it, and once it is connected, as its controller reports it. None for nominal lengths."""  # noqa: E501

    @property
    def robot(self) -> RobotModel:
        """The robot's kinematics: nominal, or calibrated."""
        return _robot(self.model, self.calibration)

    @property
    def kinematics(self) -> UrKinematics:
        """See `JointArmSettings.kinematics`."""
        from actors.arm.ur.ur_kinematics import kinematics_of

        return kinematics_of(self.robot)

    @property
    def home_joints(self) -> Joints:
        """See `JointArmSettings.home_joints`."""
        return self.home.angles

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


@lru_cache(maxsize=64)
def _robot(model: str, calibration: Calibration | None) -> RobotModel:
    return replace(MODELS[model], calibration=calibration)
