"""A part of an executed pour, sampled densely, with what its checks look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_path import JointPath
from actors.arm.path.kinematics import MODELS, RobotModel, link_points, singularities
from actors.arm.path.transforms import Transforms, cell_transforms, flange_poses, flange_transforms, quaternions
from actors.arm.spec import UrArmSpec

FloatArray = NDArray[np.float64]
Phases = tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Approach, pour or retreat.

    Attributes:
        name: one of these.
        times: (N,) of waypoints, and of middles between them [s].
        joints: (N, 6) [rad]; of no meaning where `unreached`.
        spec: of the arm and its cell.
        phases: of a pour: name, start and end [s]; empty otherwise.
        unreached: flange in the base's frame, for poses that the arm can't take: some have one all the same.
    """

    name: str
    times: FloatArray
    joints: FloatArray
    spec: UrArmSpec
    phases: Phases = ()
    unreached: Transforms | None = None

    @classmethod
    def of(cls, name: str, path: JointPath, spec: UrArmSpec, phases: Phases = ()) -> Stretch:
        """A path with middles between its waypoints: joints are linear in between, poses all but."""
        times = np.sort(np.concatenate([path.times, 0.5 * (path.times[1:] + path.times[:-1])]))
        return cls(name, times, path.at(times), spec, phases)

    @classmethod
    def beyond(cls, name: str, times: FloatArray, poses: FloatArray, spec: UrArmSpec, phases: Phases = ()) -> Stretch:
        """Poses of the pourer in the world (N, 7) of which some can't be reached."""
        return cls(name, times, np.zeros((len(times), 6)), spec, phases, flange_poses(poses, spec))

    @cached_property
    def links(self) -> FloatArray:
        """Points along the arm, see `link_points`, and its TCP; room frame, shape (N, 9, 3) [m]."""
        points = link_points(self.joints, self.model)
        room = cell_transforms(self.spec).base.apply(points.reshape(-1, 3)).reshape(points.shape)
        return np.concatenate([room, self.tool[:, None]], axis=1)

    @property
    def model(self) -> RobotModel:
        """The robot."""
        return MODELS[self.spec.model]

    @cached_property
    def flange(self) -> Transforms:
        """Room frame."""
        base = cell_transforms(self.spec).base
        return flange_transforms(self.joints, self.spec) if self.unreached is None else base @ self.unreached

    @cached_property
    def tool(self) -> FloatArray:
        """TCP, room frame, shape (N, 3) [m]."""
        return self.flange.apply(cell_transforms(self.spec).tool.position)

    @cached_property
    def pourer(self) -> Transforms:
        """Room frame."""
        return self.flange @ cell_transforms(self.spec).pourer

    @cached_property
    def poses(self) -> FloatArray:
        """Poses of the pourer in the world, shape (N, 7)."""
        world = cell_transforms(self.spec).world.inverse @ self.pourer
        return np.concatenate([world.position, quaternions(world.rotation)], axis=-1)

    @cached_property
    def tilts(self) -> FloatArray:
        """Tilts of the pourer from upright, shape (N,), ≥ 0 [rad]."""
        axis = self.pourer.rotation[:, :, 2]
        return np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), axis[:, 2])

    @cached_property
    def steps(self) -> FloatArray:
        """Between two samples, shape (N − 1,) [s]."""
        return np.diff(self.times)

    @cached_property
    def joint_speeds(self) -> FloatArray:
        """Between two samples, shape (N − 1, 6), ≥ 0 [rad/s]."""
        speeds: FloatArray = np.abs(np.diff(self.joints, axis=0)) / self.steps[:, None]
        return speeds

    @cached_property
    def turning(self) -> FloatArray:
        """Angular velocity of the pourer between two samples, shape (N − 1,) [rad/s]."""
        q = self.poses[:, 3:]
        half = np.linalg.norm(q[1:] - q[:-1], axis=-1)  # chord of unit quaternions, exact to third order in the angle
        turning: FloatArray = 4.0 * np.arcsin(np.minimum(0.5 * half, 1.0)) / self.steps
        return turning

    @cached_property
    def margins(self) -> FloatArray:
        """From singularities: shoulder, elbow, wrist, shape (N, 3)."""
        return singularities(self.joints, self.model)

    def point_speeds(self, points: FloatArray) -> FloatArray:
        """Speeds of the fastest of the TCP and points (V, 3) of the pourer between samples, shape (N − 1,) [m/s]."""
        turn, shift = np.diff(self.pourer.rotation, axis=0), np.diff(self.pourer.position, axis=0)
        moved = np.sqrt(np.square(turn @ points.T + shift[:, :, None]).sum(axis=1).max(axis=1))
        tool = np.linalg.norm(np.diff(self.tool, axis=0), axis=-1)
        speeds: FloatArray = np.maximum(moved, tool) / self.steps
        return speeds

    def when(self, index: int) -> str:
        """A moment in words: '0.81 s into the tilt'."""
        t = float(self.times[index])
        for name, start, end in self.phases:
            if t <= end + 1e-6:
                if end - start > 1e-6 and t >= end - 1e-6:
                    return f"at the {name}'s end, {t:.2f} s into the pour"
                return f"{t - start:.2f} s into the {name}"
        if t >= self.times[-1] - 1e-6:
            return f"at the {self.name}'s end"
        return f"{t:.2f} s into the {self.name}"
