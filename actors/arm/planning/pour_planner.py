"""Plans a pour: from its motion to joints over time.

Approach, pour and retreat are checked before the first movement.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_arm import JointArmSettings
from actors.arm.planned_pour import JointPath, PourPath
from actors.arm.planning.path_checks import (
    check_clearance,
    check_limits,
    check_reach,
    check_stretch,
    check_way,
    refusal,
    report,
)
from actors.arm.planning.trajectory import (
    STEEPEST,
    STEP,
    OutOfReachError,
    Phases,
    RacingJointError,
    SampledPath,
    follow,
    followable,
    home_pose,
    pour_times,
    routes,
    travel,
)
from actors.interfaces import InvalidActionError, UnreachablePlaceError
from sim_engine.collision import rotations
from sim_engine.motion import Phase, PourMotion, turn
from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

ANGLE_ERROR, PLACE_ERROR = np.radians(0.1), 3e-4
"""Largest deviation from the required pose between two waypoints, where joints are linear [rad], [m]."""

FINEST = 8
"""Largest refinement of the waypoints before the planner reports that joints cannot follow the motion."""

MOST_WAYPOINTS = 1_200
"""Largest number of waypoints of a pour, because they are sent to the controller as a program."""

OVER = 0.02
"""Height above the receiver, in addition to `ArmLimits.clearance`, at which the pourer is carried over it [m]."""

UNTILT_ACCELERATION = STEEPEST / 10.0
"""Acceleration of the return to upright after a pour that ends tilted [rad/s²]."""


def plan_path(motion: PourMotion, spec: JointArmSettings, pourer: Vessel, receiver: Vessel) -> PourPath:
    """Plan the joints for a whole pour.

    The arm moves from home to the pour's first pose in straight lines with the pourer upright: directly, or, if that is
    forbidden, up, across the receiver's rim and down. It pours in the posture of home, since a change of posture would
    pass a singularity with a full vessel. It returns along the approach. A pour that ends tilted is brought upright
    first.

    Steps in speed, and accelerations above `trajectory.STEEPEST`, become ramps of that acceleration
    (`trajectory.followable`). Each such turn ends speed / STEEPEST later, and later phases are delayed by the same
    time. `PathReport.deviation` is the resulting difference from the requested tilt.

    Args:
        motion: as `sim_engine.motion.plan_motion` makes it.
        spec: of the arm and its cell.
        pourer, receiver: geometry of the scene's vessels.

    Returns:
        The path, with the results of its checks.

    Raises:
        InvalidActionError: the path is forbidden or impossible; the text lists all problems.
        UnreachablePlaceError: likewise, and so is every other pour that begins at the same place.
    """
    problems = check_limits(spec)
    if problems:
        raise InvalidActionError(refusal(problems))
    executed = followable(motion)
    phases: Phases = tuple((p.name, p.start, p.end) for p in executed.phases)
    first_pose = tuple(executed.sample(np.zeros(1))[0].tolist())
    approach, approached, wrong = _approach(first_pose, spec, pourer, receiver)
    problems = list(wrong)
    barred = bool(problems)
    pour = None
    try:
        pour = _pour(executed, np.array(spec.home_joints) if approach is None else approach.joints[-1], spec)
        during = SampledPath.of("pour", pour, spec, phases)
    except OutOfReachError as error:
        during = SampledPath.beyond("pour", pour_times(executed), error.poses, spec, phases)
        problems = [check_reach(during)]  # if the approach failed too, this is its cause
    problems += check_stretch(during, pourer, receiver)
    # hold, return and retreat pass through poses that tilt and approach have passed through
    nearest, texts = check_clearance(during, executed.phases[0].end, pourer, receiver)
    if approached >= spec.limits.clearance or nearest.index > 0:  # its first pose is the last one of the approach
        problems += texts
    if pour is not None and not problems and not _follows(pour, executed, spec):
        problems.append(
            "joints that are linear between waypoints leave the pour's poses by more than 0.1 deg or 0.3 mm"
        )
    if pour is not None and len(pour.times) > MOST_WAYPOINTS:
        problems.append(f"the pour needs {len(pour.times)} waypoints, a controller takes {MOST_WAYPOINTS}")
    if problems or pour is None or approach is None:
        raise (UnreachablePlaceError if barred else InvalidActionError)(refusal(problems))
    retreat = _retreat(executed, approach, pour, spec)
    back = SampledPath.of("retreat", retreat, spec)
    problems = check_stretch(back, pourer, receiver)
    if problems:
        raise InvalidActionError(refusal(problems))
    return PourPath(
        approach=approach,
        pour=pour,
        retreat=retreat,
        tilts=executed.tilt(pour.times),
        phases=phases,
        report=report(
            [SampledPath.of("approach", approach, spec), during, back],
            min(nearest.distance, approached),
            pourer,
            _deviation(motion, executed),
        ),
        calibration=spec.kinematics.checksum,
    )


@lru_cache(maxsize=16)
def _approach(
    start: tuple[float, ...], spec: JointArmSettings, pourer: Vessel, receiver: Vessel
) -> tuple[JointPath | None, float, tuple[str, ...]]:
    """The approach with the fewest problems, and the shortest of those, its clearance [m], and its problems.

    Args:
        start: first pose of the pourer in the world. Pours at one place share it, so that the approach is planned and
            checked only once for all of them.
        spec: of the arm and its cell.
        pourer, receiver: geometry.
    """
    over = receiver.rim_height + spec.limits.clearance + OVER
    best: tuple[JointPath | None, float, list[str]] | None = None
    for knots in routes(home_pose(spec), np.array(start), over):
        path: JointPath | None = None
        try:
            path = travel(knots, np.array(spec.home_joints), spec)
            sampled = SampledPath.of("approach", path, spec)
        except OutOfReachError as error:
            sampled = SampledPath.beyond(
                "approach", np.linspace(0.0, STEP * len(error.poses), len(error.poses)), error.poses, spec
            )
            problems, distance = [check_reach(sampled)], np.inf
        except RacingJointError as error:
            problems, distance = [check_way(error, spec)], np.inf
        else:
            nearest, problems = check_clearance(sampled, path.duration, pourer, receiver)
            problems += check_stretch(sampled, pourer, receiver)
            distance = nearest.distance
        if best is None or len(problems) < len(best[2]):
            best = (path, distance, problems)
        if not problems:
            break
    assert best is not None
    return best[0], best[1], tuple(best[2])


def _pour(motion: PourMotion, near: FloatArray, spec: JointArmSettings) -> JointPath:
    """Follow the motion within the allowed errors, with as few waypoints as possible."""
    finer = 1
    while True:
        times = pour_times(motion, finer)
        path = JointPath(times, follow(motion.sample(times), near, spec))
        if finer >= FINEST or _follows(path, motion, spec):
            return path
        finer *= 2


def _follows(path: JointPath, motion: PourMotion, spec: JointArmSettings) -> bool:
    middles = 0.5 * (path.times[1:] + path.times[:-1])
    wanted = motion.sample(middles)
    world = SampledPath("pour", middles, path.at(middles), spec)
    apart = np.linalg.norm(world.poses[:, :3] - wanted[:, :3], axis=-1)
    turned = np.linalg.norm(rotations(world.poses) - rotations(wanted), axis=(1, 2)) / np.sqrt(2.0)
    return bool(apart.max() < PLACE_ERROR and turned.max() < ANGLE_ERROR)


def _retreat(motion: PourMotion, approach: JointPath, pour: JointPath, spec: JointArmSettings) -> JointPath:
    """First to upright, if the pour ends tilted; then back along the approach."""
    times = approach.times[-1] - approach.times[::-1]
    back = JointPath(times, approach.joints[::-1])
    first, last = (float(motion.tilt(np.array([t]))[0]) - motion.tilt_error for t in (0.0, motion.duration))
    if abs(last - first) < 1e-9:
        return back
    segments = tuple(turn(0.0, last, first, spec.upright_speed, UNTILT_ACCELERATION))
    end = segments[-1].start + segments[-1].duration
    upright = replace(motion, segments=segments, phases=(Phase("untilt", 0.0, end),))
    first_part = _pour(upright, pour.joints[-1], spec)
    return JointPath(
        np.concatenate([first_part.times, end + back.times[1:]]),
        np.concatenate([first_part.joints, back.joints[1:]]),
    )


def _deviation(requested: PourMotion, executed: PourMotion) -> float:
    if requested is executed:
        return 0.0
    times = np.linspace(0.0, executed.duration, 2000)
    return float(np.abs(requested.tilt(times) - executed.tilt(times)).max())
