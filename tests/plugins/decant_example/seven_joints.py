"""An arm with seven joints: its URDF, and the calls that follow a joint trajectory and read the joints.

    arm: {kind: seven-joint, home: [-25 deg, 35 deg, 0 deg, …], tool: {z: 100 mm}, …}

Replace `SimulatedRobot` by the interface of your robot, and `seven_joints.urdf` by its description.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from decant.plugins import ArmFacts, ChainArmKind, ChainArmSettings, JointPath, JointReading

from .simulated_robot import SimulatedRobot


class SevenJointSettings(ChainArmSettings):
    """An arm with seven joints."""

    urdf = Path(__file__).with_name("seven_joints.urdf")
    base_link, flange_link = "base", "flange"

    kind: Literal["seven-joint"] = "seven-joint"
    """An arm with seven joints."""


class SevenJointRobot:
    """See `decant.plugins.JointRobot`."""

    def __init__(self, spec: SevenJointSettings) -> None:
        self.cable = SimulatedRobot(spec.home, spec.time_scale)

    def connect(self) -> ArmFacts:
        return ArmFacts(model="seven-joint", serial="7", version="1.0", problem=self.read().problem)

    def read(self) -> JointReading:
        moment, joints, tripped = self.cable.read()
        return JointReading(moment, joints, "a protective stop: reset it at the robot" if tripped else "")

    def begin(self, path: JointPath) -> None:
        self.cable.follow(path.times, path.joints)

    def halt(self) -> None:
        self.cable.hold()

    def close(self) -> None:
        pass


class SevenJointKind(ChainArmKind[SevenJointSettings]):
    """Arms with seven joints."""

    settings, robot = SevenJointSettings, SevenJointRobot
