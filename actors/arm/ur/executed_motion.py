"""The executed motion, computed from readings, and the times of stops.

- `executed_path` and `best_lag` compute the measured path and its errors. They use no clock and no connection.
- `Stops` records stop requests from any thread, and whether the arm was seen to stand still (`StopTimes`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from actors.arm.arm_interface import FULL_SPEED
from actors.arm.planned_pour import ExecutedPath, FloatArray, JointPath
from actors.arm.planning.kinematics import cell_transforms, pourer_motion
from actors.arm.ur.ur_kinematics import forward
from actors.arm.ur.worker_messages import ForceSample, MotionOutcome, Sample
from actors.arm.ur_settings import UrArmSettings

LONGEST_LAG = 0.3
"""Largest lag that is searched to explain the difference between path and readings [s]."""

ON_PATH = 0.01
"""Largest difference of a joint between a reading and the path, if the arm follows the path [rad]."""


def executed_path(
    samples: list[Sample],
    path: JointPath,
    spec: UrArmSettings,
    *,
    completed: bool,
    slider: float = 1.0,
    forces: Sequence[ForceSample] = (),
) -> ExecutedPath:
    """The readings from the path's start on, in the controller's time.

    The controller's program sends its time on the path in every package. Both clocks are therefore related without the
    arrival times of packages. They run alike unless the controller slowed the motion; then the two are compared at the
    program's time, and the readings keep the controller's.

    Readings get lost on a busy computer, and a virtual arm at thirty times its speed sends about four per second of
    its time. Between two readings on the path the arm is taken to have followed it, and the path fills the gap.

    Args:
        samples: in the order of their times.
        path: the planned path.
        spec: of the arm.
        completed: False if it was stopped before its end.
        slider: lowest fraction of the programmed speed.
        forces: readings on the path.
    """
    stamps = np.array([t for t, _, _ in samples])
    joints = np.array([q for _, q, _ in samples]).reshape(-1, 6)
    clocks = np.array([c for _, _, c in samples])
    running = (clocks > 0.0) & (clocks < path.duration - 1e-6)
    if not np.any(running):
        running = clocks > 0.0
    if not np.any(running):
        return ExecutedPath(np.zeros(0), np.zeros((0, 6)), False, {})
    slowed, offsets = slider < FULL_SPEED, stamps[running] - clocks[running]
    times = stamps - float(offsets.min() if slowed else np.median(offsets))
    first = max(int(np.searchsorted(times, 0.0, side="right")) - 1, 0)
    times, joints, clocks = times[first:], joints[first:], clocks[first:]
    times[0] = max(times[0], 0.0) if len(times) > 1 else 0.0
    if times[0] > 0.0:
        times, joints = np.concatenate([[0.0], times]), np.vstack([path.joints[0], joints])
        clocks = np.concatenate([[0.0], clocks])
    planned = clocks if slowed else times
    followed = np.ones(len(times), dtype=bool) if completed else planned <= clocks.max()
    tracking = _tracking(planned[followed], joints[followed], path, spec) if np.any(followed) else {}
    if tracking and slowed:
        tracking["longest_gap"] = float(np.diff(times).max())
    if tracking:
        times, joints = _filled(times, joints, planned - tracking["lag"], path, spec.rate)
    poses = pourer_motion(joints, times, spec).poses if len(times) > 1 else np.zeros((0, 7))
    return ExecutedPath(times, joints, completed, tracking | {"slider": slider}, poses, _forces(forces))


def _filled(
    times: FloatArray, joints: FloatArray, planned: FloatArray, path: JointPath, rate: float
) -> tuple[FloatArray, FloatArray]:
    """Readings with points of the path between them where some are missing.

    Args:
        times: (T,) of the readings [s].
        joints: (T, n) then [rad].
        planned: (T,) times on the path [s].
        path: the planned path.
        rate: of readings if none is missing [1/s].
    """
    errors = joints - path.at(planned)
    follows = np.abs(errors).max(axis=1) < ON_PATH
    parts = []
    for k, gap in enumerate(np.diff(times)):
        count = max(round(gap * rate), 1) if follows[k] and follows[k + 1] else 1
        parts.append(k + np.arange(count) / count)
    index, readings = np.concatenate([*parts, [len(times) - 1.0]]), np.arange(len(times))
    error = np.column_stack([np.interp(index, readings, column) for column in errors.T])
    return np.interp(index, readings, times), path.at(np.interp(index, readings, planned)) + error


def _forces(readings: Sequence[ForceSample]) -> FloatArray:
    """See `ExecutedPath.forces`."""
    unknown = (np.nan,) * 6
    rows = [(clock, *(force or unknown), *(wrist or unknown)) for clock, force, wrist in readings]
    return np.array(rows).reshape(-1, 13)


def executed_dose(samples: list[Sample], spec: UrArmSettings, *, completed: bool) -> ExecutedPath:
    """The readings of a dose on the controller's clock; there is no planned motion to compare them with.

    Args:
        samples: in the order of their times.
        spec: of the arm.
        completed: False if it was stopped before its end.
    """
    if len(samples) < 2:
        return ExecutedPath(np.zeros(0), np.zeros((0, 6)), False, {})
    times = np.array([t for t, _, _ in samples])
    joints = np.array([q for _, q, _ in samples])
    times = times - times[0]
    return ExecutedPath(times, joints, completed, {}, pourer_motion(joints, times, spec).poses)


def best_lag(times: FloatArray, joints: FloatArray, path: JointPath) -> float:
    """The delay of the path that fits the readings best [s]."""
    low, high = 0.0, LONGEST_LAG
    for _ in range(4):
        candidates = np.linspace(low, high, 31)
        errors = [float(np.mean((joints - path.at(times - lag)) ** 2)) for lag in candidates]
        best = int(np.argmin(errors))
        low, high = candidates[max(best - 1, 0)], candidates[min(best + 1, 30)]
    return float(candidates[best])


def _tracking(times: FloatArray, joints: FloatArray, path: JointPath, spec: UrArmSettings) -> dict[str, float]:
    lag = best_lag(times, joints, path)
    planned = path.at(times - lag)
    angles = np.abs(joints - planned).max(axis=1)
    model, tool = spec.robot, cell_transforms(spec).tool.position
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


@dataclass(frozen=True)
class StopTimes:
    """Delays of a stop, measured from the call.

    Attributes:
        answered: until the program was seen to accept the order [s]; None if it was stopped by other means.
        standing: until the arm was seen to stand still [s].
    """

    answered: float | None
    standing: float


class Stops:
    """Stop state, shared by the thread that moves the arm and those that stop it.

    Attributes:
        count: of stops so far.
        unseen: the last motion ended without the arm being seen to stand still.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._under_way = False
        self._outcome: MotionOutcome | None = None
        self.count = 0
        self.unseen = False

    # ---- for the moving thread

    def begin(self) -> None:
        """Record the start of a motion."""
        with self._changed:
            self._under_way, self._outcome, self.unseen = True, None, False

    def came_to(self, outcome: MotionOutcome) -> None:
        """Record the outcome of the motion."""
        with self._changed:
            self._outcome = outcome
            self.unseen = outcome.moved and outcome.standing is None

    def lost(self) -> None:
        """Record that the outcome of the motion is unknown."""
        self.unseen = True

    def end(self) -> None:
        """Record the end of the motion."""
        with self._changed:
            self._under_way = False
            self._changed.notify_all()

    def wait_for_one(self, since: int, seconds: float) -> bool:
        """Wait, unless another stop is requested. Returns whether one was."""
        with self._changed:
            return self._changed.wait_for(lambda: self.count != since, max(seconds, 0.0))

    # ---- for the stopping threads

    @property
    def under_way(self) -> bool:
        """Whether a motion is running or announced."""
        return self._under_way

    def ask(self) -> int:
        """Record a stop request. Returns the number of stops so far."""
        with self._changed:
            self.count += 1
            self._changed.notify_all()
            return self.count

    def wait_for_end(self, seconds: float) -> bool:
        """Wait for the end of the motion. Returns whether it has ended."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._under_way, seconds)

    def times(self, asked: float) -> StopTimes | None:
        """Delays of the stop that was requested at a time [s of `time.monotonic`]; None if nothing had moved."""
        outcome = self._outcome
        if outcome is None or outcome.standing is None:
            return None
        answered = None if outcome.answered is None else max(0.0, outcome.answered - asked)
        return StopTimes(answered, max(0.0, outcome.standing - asked))
