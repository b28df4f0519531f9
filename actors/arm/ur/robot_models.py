"""The two robots: lengths, masses and limits. Plain values.

Source of the Denavit–Hartenberg parameters, masses and centres of mass: the manufacturer's public page "DH Parameters
for calculations of kinematics and dynamics". Nominal: the factory calibration of a real robot differs from them by 2 to
8 mm and 0.4 to 1.35° at the tool.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import radians

Vector = tuple[float, float, float]
Joints = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class RobotModel:
    """One model of robot.

    Attributes:
        name: on the controller's dashboard.
        d1, a2, a3, d4, d5, d6: lengths [m]; a2 and a3 are negative by convention.
        masses: of the links [kg].
        centres: of the links' masses, in their own frames [m].
        joint_speed: largest speed of each joint [rad/s].
        joint_range: largest rotation of each joint in either direction [rad].
        frequency: control cycles per second [Hz].
    """

    name: str
    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    masses: tuple[float, ...]
    centres: tuple[Vector, ...]
    frequency: int
    joint_speed: Joints = field(default=tuple(radians(v) for v in (120.0, 120.0, 180.0, 180.0, 180.0, 180.0)))  # type: ignore[assignment]
    joint_range: Joints = field(default=tuple(radians(363.0) for _ in range(6)))  # type: ignore[assignment]


UR10 = RobotModel(
    name="UR10",
    d1=0.1273,
    a2=-0.612,
    a3=-0.5723,
    d4=0.163941,
    d5=0.1157,
    d6=0.0922,
    masses=(7.1, 12.7, 4.27, 2.0, 2.0, 0.365),
    centres=(
        (0.021, 0.0, 0.027),
        (0.38, 0.0, 0.158),
        (0.24, 0.0, 0.068),
        (0.0, 0.007, 0.018),
        (0.0, 0.007, 0.018),
        (0.0, 0.0, -0.026),
    ),
    frequency=125,
)

UR10E = RobotModel(
    name="UR10",
    d1=0.1807,
    a2=-0.6127,
    a3=-0.57155,
    d4=0.17415,
    d5=0.11985,
    d6=0.11655,
    masses=(7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
    centres=(
        (0.021, 0.0, 0.027),
        (0.38, 0.0, 0.158),
        (0.24, 0.0, 0.068),
        (0.0, 0.007, 0.018),
        (0.0, 0.007, 0.018),
        (0.0, 0.0, -0.026),
    ),
    frequency=500,
)

MODELS = {"ur10": UR10, "ur10e": UR10E}
"""Models by their names in configuration files."""
