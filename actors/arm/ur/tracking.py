"""What an arm did, from what was read of it, and how well it followed its path. Pure."""

from __future__ import annotations

import numpy as np

from actors.arm.joint_path import ExecutedPath, FloatArray, JointPath
from actors.arm.path.kinematics import MODELS, forward
from actors.arm.path.transforms import cell_transforms, pourer_motion
from actors.arm.spec import UrArmSpec
from actors.arm.ur.messages import Sample

LONGEST_LAG = 0.3
"""Searched for the lag that explains most of the difference [s]."""


def executed_path(
    samples: list[Sample], path: JointPath, spec: UrArmSpec, *, completed: bool, slider: float = 1.0
) -> ExecutedPath:
    """What was read, on the path's own clock.

    The controller's program tells in every package how far on the path it is, so that both clocks are joined without
    asking when a package arrived here.

    Args:
        samples: in the order of their times.
        path: that was to be followed.
        spec: of the arm.
        completed: False if it was stopped on the way.
        slider: lowest position of the speed slider.
    """
    stamps = np.array([t for t, _, _ in samples])
    joints = np.array([q for _, q, _ in samples]).reshape(-1, 6)
    clocks = np.array([c for _, _, c in samples])
    running = (clocks > 0.0) & (clocks < path.duration - 1e-6)
    if not np.any(running):
        running = clocks > 0.0
    if not np.any(running):
        return ExecutedPath(np.zeros(0), np.zeros((0, 6)), False, {})
    times = stamps - float(np.median(stamps[running] - clocks[running]))
    first = max(int(np.searchsorted(times, 0.0, side="right")) - 1, 0)
    times, joints = times[first:], joints[first:]
    times[0] = max(times[0], 0.0) if len(times) > 1 else 0.0
    if times[0] > 0.0:
        times, joints = np.concatenate([[0.0], times]), np.vstack([path.joints[0], joints])
    followed = np.ones(len(times), dtype=bool) if completed else times <= clocks.max()
    tracking = _tracking(times[followed], joints[followed], path, spec) if np.any(followed) else {}
    poses = pourer_motion(joints, times, spec).poses if len(times) > 1 else np.zeros((0, 7))
    return ExecutedPath(times, joints, completed, tracking | {"slider": slider}, poses)


def best_lag(times: FloatArray, joints: FloatArray, path: JointPath) -> float:
    """By how much the path has to be delayed to be most like what was read [s]."""
    low, high = 0.0, LONGEST_LAG
    for _ in range(4):
        candidates = np.linspace(low, high, 31)
        errors = [float(np.mean((joints - path.at(times - lag)) ** 2)) for lag in candidates]
        best = int(np.argmin(errors))
        low, high = candidates[max(best - 1, 0)], candidates[min(best + 1, 30)]
    return float(candidates[best])


def _tracking(times: FloatArray, joints: FloatArray, path: JointPath, spec: UrArmSpec) -> dict[str, float]:
    lag = best_lag(times, joints, path)
    planned = path.at(times - lag)
    angles = np.abs(joints - planned).max(axis=1)
    model, tool = MODELS[spec.model], cell_transforms(spec).tool.position
    points = []
    for q in (joints, planned):
        rotation, position = forward(q, model)
        points.append(position + rotation @ tool)
    apart = np.linalg.norm(points[0] - points[1], axis=1)
    return {
        "rms_angle": float(np.sqrt(np.mean((joints - planned) ** 2))),
        "max_angle": float(angles.max()),
        "rms_tool": float(np.sqrt(np.mean(apart**2))),
        "max_tool": float(apart.max()),
        "lag": lag,
        "longest_gap": float(np.diff(times).max()) if len(times) > 1 else float("inf"),
    }
