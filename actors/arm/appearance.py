"""The appearance of an arm in the live view: the positions of its links for given joints, drawn as rounded bars.

The bars are computed from the kinematics, so that no manufacturer's meshes are needed. This module contains no driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import Bar

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LinkFigure:
    """A figure of an arm with joints, drawn from its kinematics.

    Args:
        spec: of the arm and its cell (`actors.arm.joint_arm.JointArmSettings`).
    """

    spec: Any

    @property
    def bars(self) -> tuple[Bar, ...]:
        """See `ArmFigure.bars`."""
        return tuple(Bar(link.name, link.radius) for link in self.spec.kinematics.bars)

    @property
    def home(self) -> tuple[float, ...]:
        """See `ArmFigure.home`."""
        return tuple(self.spec.home_joints)

    @property
    def table(self) -> float:
        """See `ArmFigure.table`."""
        return float(self.spec.cell.table - self.spec.cell.receiver.vector[2])

    def ends(self, joints: FloatArray) -> FloatArray:
        """See `ArmFigure.ends`."""
        from actors.arm.planning.kinematics import cell_transforms, flange_transforms

        cell, q, model = cell_transforms(self.spec), np.asarray(joints, dtype=float), self.spec.kinematics
        tool = (flange_transforms(q, self.spec) @ cell.tool).position[..., None, :]
        points = np.concatenate([cell.base.apply(model.points(q)), tool], axis=-2)
        chain = cell.world.inverse.apply(points)
        first, second = ([getattr(link, end) for link in model.bars] for end in ("first", "second"))
        ends: FloatArray = np.stack([chain[..., first, :], chain[..., second, :]], axis=-2)
        return ends

    def tool(self, joints: FloatArray) -> FloatArray:
        """See `ArmFigure.tool`."""
        from actors.arm.planning.kinematics import cell_transforms, flange_transforms, quaternions

        cell = cell_transforms(self.spec)
        frames = cell.world.inverse @ flange_transforms(np.asarray(joints, dtype=float), self.spec) @ cell.tool
        return np.concatenate([frames.position, quaternions(frames.rotation)], axis=-1)

    def pourer(self, joints: FloatArray) -> FloatArray:
        """See `ArmFigure.pourer`."""
        from actors.arm.planning.kinematics import cell_transforms, pourer_transforms, quaternions

        held = cell_transforms(self.spec).world.inverse @ pourer_transforms(np.asarray(joints, float), self.spec)
        return np.concatenate([held.position, quaternions(held.rotation)], axis=-1)

    def tool_of(self, poses: FloatArray) -> FloatArray:
        """See `ArmFigure.tool_of`."""
        from actors.arm.planning.kinematics import Transforms, cell_transforms
        from sim_engine.collision import rotations

        cell = cell_transforms(self.spec)
        held = Transforms(rotations(poses), np.asarray(poses, dtype=float)[:, :3])
        places: FloatArray = (held @ cell.pourer.inverse @ cell.tool).position
        return places

    def executed(self, record: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        """See `ArmFigure.executed`."""
        from actors.arm.planned_pour import unpack

        if "packed" not in record:
            return None
        read = unpack(dict(record))
        return read.times, read.joints
