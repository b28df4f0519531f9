"""Paths to pour along, and settings of an arm that fit them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from actors.arm.arm_interface import PathReport
from actors.arm.planned_pour import JointPath, PourPath
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import ArmLimits, Box, Centre, JointAngles, Point, Pose, RobotCell

HOME = tuple(math.radians(v) for v in (0.0, -90.0, 90.0, -90.0, -90.0, 0.0))
START = tuple(math.radians(v) for v in (12.0, -85.0, 88.0, -93.0, -90.0, 3.0))

REPORT = PathReport(
    joint_speed=1.0,
    fastest_joint=5,
    tool_speed=0.5,
    tilt=1.2,
    tilt_speed=1.0,
    singularity=0.5,
    clearance=0.01,
    low=(0.0, 0.0, 0.0),
    high=(1.0, 1.0, 1.0),
    duration=10.0,
)


def settings(address: str = "", **changes: Any) -> UrArmSettings:
    """An arm with a tool and a payload."""
    spec = UrArmSettings(
        model="ur10e",
        limits=ArmLimits(box=Box(low=Point.of(-1.5, -1.5, -0.5), high=Point.of(1.5, 1.5, 2.0))),
        cell=RobotCell(receiver=Point.of(0.8, 0.0, 0.0), direction=0.0),
        home=JointAngles.of(*HOME),
        **({"address": address} if address else {}),
        tool=Pose(z=0.15),
        grip=Pose(rx=math.pi),  # the flange looks down, the pourer up
        payload=1.2,
        payload_centre=Centre.of(0.0, 0.0, 0.08),
        warning_time=1.0,
    )
    return spec.with_values(**changes)


def smooth(begin: Any, end: Any, duration: float, step: float = 0.03) -> JointPath:
    """From rest to rest."""
    times = np.linspace(0.0, duration, max(2, round(duration / step)) + 1)
    u = times / duration
    share = 10 * u**3 - 15 * u**4 + 6 * u**5
    return JointPath(times, np.asarray(begin) + share[:, None] * (np.asarray(end) - np.asarray(begin)))


def pour_path(angle: float = math.radians(70.0), speed: float = math.radians(60.0), hold: float = 1.0) -> PourPath:
    """Tilt by the last joint, with the elbow helping; hold; return."""
    tilted = np.array(START) + np.array([0.0, 0.05, -0.05, 0.0, 0.1, angle])
    duration = 1.875 * angle / speed
    tilt, back = smooth(START, tilted, duration), smooth(tilted, START, duration)
    times = np.concatenate([tilt.times, duration + hold + back.times])
    joints = np.vstack([tilt.joints, back.joints])
    ends = (duration, duration + hold, 2.0 * duration + hold)
    return PourPath(
        approach=smooth(HOME, START, 1.5),
        pour=JointPath(times, joints),
        retreat=smooth(START, HOME, 1.5),
        tilts=np.abs(joints[:, 5] - START[5]),
        phases=(("tilt", 0.0, ends[0]), ("hold", ends[0], ends[1]), ("return", ends[1], ends[2])),
        report=REPORT,
    )
