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
    """A figure of a UR arm, drawn from its kinematics.

    Args:
        spec: of the arm and its cell (`actors.arm.arm_settings.UrArmSettings`).
    """

    spec: Any

    @property
    def bars(self) -> tuple[Bar, ...]:
        """See `ArmFigure.bars`."""
        return (
            Bar("base", 0.075),
            Bar("shoulder", 0.068),
            Bar("upper arm", 0.055),
            Bar("elbow", 0.055),
            Bar("forearm", 0.045),
            Bar("wrist 1", 0.043),
            Bar("wrist 2", 0.043),
            Bar("wrist 3", 0.04),
            Bar("gripper", 0.022),
        )

    @property
    def home(self) -> tuple[float, ...]:
        """See `ArmFigure.home`."""
        return tuple(self.spec.home.angles)

    @property
    def table(self) -> float:
        """See `ArmFigure.table`."""
        return float(self.spec.cell.table - self.spec.cell.receiver.vector[2])

    def ends(self, joints: FloatArray) -> FloatArray:
        """See `ArmFigure.ends`."""
        from actors.arm.planning.kinematics import cell_transforms, flange_transforms, link_points

        cell, q = cell_transforms(self.spec), np.asarray(joints, dtype=float)
        points = cell.base.apply(link_points(q, self.spec.robot))
        foot = np.broadcast_to(cell.base.position, (*q.shape[:-1], 1, 3))
        flange = flange_transforms(q, self.spec)
        tool = (flange @ cell.tool).position[..., None, :]
        chain = cell.world.inverse.apply(np.concatenate([foot, points, tool], axis=-2))
        ends: FloatArray = np.stack([chain[..., :-1, :], chain[..., 1:, :]], axis=-2)
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
