"""A UR10e beside a receiver, and pours for it. The pourer is gripped from the side, so that wrist 3 tilts it."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.arm.planning.kinematics import flange_poses
from actors.arm.planning.trajectory import follow
from actors.arm.ur.robot_models import MODELS
from actors.arm.ur.ur_kinematics import inverse, posture
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import ArmLimits, Box, JointAngles, Point, Pose, RobotCell
from orchestrator.campaigns.file_loading import load_vessel
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.motion import PourMotion, plan_motion
from sim_engine.scene import Pivot, Scene
from sim_engine.vessel.vessel import Vessel, build_vessel

FloatArray = NDArray[np.float64]

CONFIGS = Path(__file__).parents[2] / "configs"

LIMITS = ArmLimits(
    box=Box(low=Point.of(0.25, -0.6, 0.0), high=Point.of(1.0, 0.4, 0.9)),
    joint_speed=170 * DEG,
    tilt_speed=155 * DEG,
    clearance=3e-3,
)
SPEC = UrArmSettings(
    model="ur10e",
    limits=LIMITS,
    cell=RobotCell(receiver=Point.of(0.75, 0.0, 0.06), direction=90 * DEG),
    home=JointAngles.of(-14 * DEG, -91 * DEG, -115 * DEG, -154 * DEG, -104 * DEG, 0.0),
    tool=Pose(z=0.17),
    payload=0.0,
    grip=Pose(y=-0.06, rx=-90 * DEG),
)
ACTION = Action(
    angular_velocity=60 * DEG,
    x_offset=0.098,
    height=0.1,
    max_angle=110 * DEG,
    angular_acceleration=600 * DEG,
    hold_time=0.5,
    return_velocity=90 * DEG,
)


@cache
def vessel(name: str) -> Vessel:
    """A shipped vessel."""
    return build_vessel(load_vessel(CONFIGS / "vessels" / f"{name}.yaml"))


def motion(action: Action = ACTION, receiver: str = "tumbler", pivot: Pivot | None = None) -> PourMotion:
    """Out of the beaker."""
    scene = Scene("s", vessel("beaker").spec, vessel(receiver).spec, Liquid(name="water", mass=0.2), pivot or Pivot())
    return plan_motion(scene, action, vessel("beaker"), vessel(receiver))


def limited(**changes: Any) -> UrArmSettings:
    """The cell with other limits."""
    return SPEC.with_values(limits=LIMITS.with_values(**changes))


def placed(**changes: Any) -> UrArmSettings:
    """The cell with other things in it."""
    return SPEC.with_values(cell=SPEC.cell.with_values(**changes))


def waiting_at(x: float, y: float, z: float) -> UrArmSettings:
    """The cell with a home that has the pourer upright at a place of the world, in the same posture."""
    pose = np.array([[x, y, z, 1.0, 0.0, 0.0, 0.0]])
    q = follow(pose, np.array(SPEC.home.angles), SPEC)[0]
    return SPEC.with_values(home=JointAngles.of(q[0], q[1], q[2], q[3], q[4], q[5]))


def cell_of(model: str, **changes: Any) -> UrArmSettings:
    """A cell of the size of a model's reach, with a home in the same posture as in `SPEC`."""
    robot = MODELS[model]
    small = model in ("ur3", "ur3e")
    share = 0.75 if model == "ur18" else 0.7  # of the reach: nearer, the wide wrist of a UR18 meets its upper arm
    x = 0.38 if small else round(share * (abs(robot.a2) + abs(robot.a3)), 3)
    spec = SPEC.with_values(
        model=model,
        limits=LIMITS.with_values(box=Box(low=Point.of(0.05, -0.9, -0.3), high=Point.of(1.6, 0.9, 1.2))),
        cell=SPEC.cell.with_values(receiver=Point.of(x, 0.0, 0.12 if small else 0.06)),
        tool=Pose(z=0.09 if small else 0.17),
    )
    waiting = np.array(
        [[-0.16, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0] if small else [-0.296, -0.003, 0.303, 1.0, 0.0, 0.0, 0.0]]
    )
    flange = flange_poses(waiting, spec)
    home = inverse(flange.rotation, flange.position, robot)[0, posture(np.array(SPEC.home.angles), SPEC.robot)]
    return spec.with_values(home=JointAngles.of(*map(float, home)), **changes)


def turned(rotations: FloatArray, others: FloatArray) -> FloatArray:
    """Angles between rotation matrices, shape (T,) [rad]."""
    chord = np.linalg.norm(rotations - others, axis=(-2, -1)) / math.sqrt(8.0)
    return 2.0 * np.arcsin(np.minimum(chord, 1.0))
