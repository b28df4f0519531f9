"""The robots with the controllers that they pretend to have."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from actors.arm.ur import robot_models as models
from actors.arm.ur.robot_models import Joints, RobotModel


@dataclass(frozen=True, kw_only=True)
class ControlledModel(RobotModel):
    """One model of robot with its controller.

    Attributes:
        version: of the controller's software: major, minor, bugfix, build.
        remote_control: whether the controller knows the remote-control mode.
        serial: its number; digits only.
        primary_type: robot type and subtype in configuration data.
    """

    version: tuple[int, int, int, int]
    remote_control: bool
    serial: str
    primary_type: tuple[int, int]

    @property
    def e_series(self) -> bool:
        """Whether the controller belongs to the generation after CB3."""
        return self.version[0] >= 5


UR10 = ControlledModel(
    **vars(models.UR10), version=(3, 15, 8, 106339), remote_control=False, serial="2016300123", primary_type=(2, 2)
)

UR10E = ControlledModel(
    **vars(models.UR10E), version=(5, 12, 6, 1102099), remote_control=True, serial="20205300456", primary_type=(2, 1)
)

MODELS = {"ur10": UR10, "ur10e": UR10E}
"""By the name that starts them."""

HOME: Joints = tuple(radians(v) for v in (0.0, -90.0, 90.0, -90.0, -90.0, 0.0))  # type: ignore[assignment]
"""Where a robot stands when its controller is started: a pose in the middle of its reach, away from singularities."""
