"""Checks of an arm's settings and of its paths. All problems are reported at once, before anything moves.

- `check_limits` and `outside` check the settings when a laboratory's file is read, before any pour.
- The other functions check a path; each problem is a message for the user who can change it.
- `recheck` checks a path again immediately before it is executed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import PathReport
from actors.arm.joint_arm import ArmModel, JointArmSettings
from actors.arm.planned_pour import JointPath
from actors.arm.planning.collision_geometry import Nearest, hull, nearest_links, nearest_to_itself, nearest_to_receiver
from actors.arm.planning.kinematics import (
    cell_transforms,
    flange_poses,
    flange_transforms,
    pourer_transforms,
    transform_of,
)
from actors.arm.planning.trajectory import RacingJointError, SampledPath
from actors.interfaces import InvalidActionError
from sim_engine.vessel.distance_grid import MARGIN
from sim_engine.vessel.vessel import Vessel

UPRIGHT = math.radians(3.0)
"""Largest tilt of a pourer that waits or is carried [rad], because it is full."""

POURED_OVER = math.cos(math.radians(45.0))
"""Share of the way from the pourer to the hand, towards where liquid leaves, above which the hand is poured over."""


def check_limits(spec: JointArmSettings) -> list[str]:
    """Problems of an arm's settings; empty if there are none. Messages name the keys of a laboratory's file."""
    limits = spec.limits
    low, high = np.array(limits.box.low.vector), np.array(limits.box.high.vector)
    if np.any(low >= high):
        axis = "xyz"[int(np.argmax(low >= high))]
        return [f"limits.box: {axis} of 'low' should be smaller than that of 'high'"]
    return [*_speed_limits(spec), *_clearance(spec), *_grip(spec), *_receiver(spec), *_home(spec)]


def _speed_limits(spec: JointArmSettings) -> list[str]:
    problems = []
    deg = math.degrees
    if spec.approach_speed > spec.limits.joint_speed:
        problems.append(
            f"approach_speed: {deg(spec.approach_speed):.4g} deg/s is above limits.joint_speed, "
            f"{deg(spec.limits.joint_speed):.4g} deg/s"
        )
    if spec.upright_speed > spec.limits.tilt_speed:
        problems.append(
            f"upright_speed: {deg(spec.upright_speed):.4g} deg/s is above limits.tilt_speed, "
            f"{deg(spec.limits.tilt_speed):.4g} deg/s"
        )
    return problems


def _clearance(spec: JointArmSettings) -> list[str]:
    if spec.limits.clearance <= MARGIN:
        return []
    return [
        f"limits.clearance: {1e3 * spec.limits.clearance:.4g} mm is more than the {1e3 * MARGIN:.0f} mm up to which "
        "distances between vessels are known"
    ]


def _grip(spec: JointArmSettings) -> list[str]:
    tool, grip = transform_of(spec.tool), transform_of(spec.grip)
    hand = -grip.rotation.T @ tool.rotation.T @ tool.position  # from the tool centre point, in the pourer's frame
    if hand[0] <= POURED_OVER * np.linalg.norm(hand):
        return []
    return ["grip: the hand is where the liquid leaves, and would be poured over; turn it about the pourer's axis"]


def _receiver(spec: JointArmSettings) -> list[str]:
    problems = []
    x, y, z = spec.cell.receiver.vector
    low, high = spec.limits.box.low.vector, spec.limits.box.high.vector
    if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
        problems.append(f"cell.receiver: ({x:.3f}, {y:.3f}) m lies outside limits.box, seen from above")
    for number, plane in enumerate(spec.limits.planes, 1):
        # a horizontal plane may pass above the receiver's position
        if abs(plane.normal[2]) < 0.5 and float(np.dot(plane.normal, spec.cell.receiver.vector)) < plane.offset:
            problems.append(f"cell.receiver: ({x:.3f}, {y:.3f}, {z:.3f}) m lies beyond plane {number} of limits.planes")
    if z < spec.cell.table - 1e-6:
        problems.append(f"cell.receiver: stands at {z:.3f} m, below cell.table at {spec.cell.table:.3f} m")
    flange = flange_poses(np.array([[-0.1, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]]), spec)
    if text := spec.kinematics.place_problem(flange.rotation, flange.position):
        problems.append(
            f"cell.receiver: an upright pourer beside it, 100 mm up, is {text}, or turn 'direction' or 'grip'"
        )
    return problems


def _home(spec: JointArmSettings) -> list[str]:
    model, q = spec.kinematics, np.array([spec.home_joints])
    problems = []
    for k, angle in enumerate(spec.home_joints):
        if not model.joint_low[k] <= angle <= model.joint_high[k]:
            problems.append(
                f"home: {model.joint_names[k]} at {math.degrees(angle):.1f} deg is outside its range of "
                f"{_range(model, k)}"
            )
    pourer = pourer_transforms(q, spec)
    lean = math.acos(float(np.clip(pourer.rotation[0, 2, 2], -1.0, 1.0)))
    if lean > UPRIGHT:
        problems.append(
            f"home: the pourer leans {math.degrees(lean):.1f} deg there; it waits full, at most "
            f"{math.degrees(UPRIGHT):.0f} deg are allowed. Are 'tool', 'grip' and 'mount' right?"
        )
    tool = flange_transforms(q, spec).apply(cell_transforms(spec).tool.position)
    for name, point in (("the tool", tool[0]), ("the pourer", pourer.position[0])):
        problems += [f"home: {name} is {text}" for text in outside(point, spec)]
    for name, margin in zip(model.margin_names, model.margins(q)[0], strict=True):
        if margin < spec.limits.singularity:
            problems.append(
                f"home: the {name} is {margin:.2f} from singular, limits.singularity asks for "
                f"{spec.limits.singularity:.2f}; bend it more"
            )
    return problems


def outside(point: np.ndarray[tuple[int], np.dtype[np.float64]], spec: JointArmSettings) -> list[str]:
    """Violations of box, planes and table at a point of the room's frame, shape (3,) [m]."""
    texts = []
    for axis, value, low, high in zip(
        "xyz", point, spec.limits.box.low.vector, spec.limits.box.high.vector, strict=True
    ):
        if not low <= value <= high:
            texts.append(f"outside the box, at {axis} = {value:.3f} m ({low:.3f} … {high:.3f} m are allowed)")
    for number, plane in enumerate(spec.limits.planes, 1):
        beyond = plane.offset - float(np.dot(plane.normal, point))
        if beyond > 0.0:
            texts.append(f"{1e3 * beyond:.1f} mm beyond plane {number}")
    if point[2] < spec.cell.table:
        texts.append(f"{1e3 * (spec.cell.table - point[2]):.1f} mm below the table")
    return texts


FloatArray = NDArray[np.float64]

SLACK = 1e-6
"""Relative tolerance of tilts: rounding may put a path that is planned at a limit above it."""

TURNING_SLACK = 3e-4
"""Additional tolerance of the speed of the tilt, which is a difference of sampled poses: 1.3e-4 with a Franka."""

THROUGH = 0.02
"""Below this distance from a singularity a path counts as passing through it when speeds are checked."""

MOVE = "move the receiver"
"""How the problems of a pour's path are solved."""

LARGEST_STEP = math.radians(15.0)
"""The largest step of a joint between two waypoints [rad]; a larger one is a jump."""


def check_stretch(sampled: SampledPath, pourer: Vessel, receiver: Vessel) -> list[str]:
    """Problems of a path, except the distance of the pourer from the receiver."""
    points = hull(pourer)
    problems = [*_tilts(sampled), *_places(sampled, points)]
    if sampled.unreached is not None:
        return [*_speeds(sampled, points), *problems]
    problems = [
        *_ranges(sampled),
        *_singular(sampled),
        *problems,
        *_links(sampled, receiver),
        *_itself(sampled, points),
    ]
    if sampled.margins.min() < THROUGH:
        return problems  # joints then move too fast, but that is not the cause
    return [*_joint_speeds(sampled), *_speeds(sampled, points), *problems]


def check_way_limits(sampled: SampledPath, points: FloatArray) -> list[str]:
    """Problems of a way on which no liquid is poured: limits, table and speeds, without a receiver.

    Args:
        sampled: the way.
        points: outermost points of the carried vessel, shape (V, 3) [m].
    """
    table, _ = nearest_links(sampled, None)
    cure = "teach another pose"
    problems = [*_ranges(sampled), *_singular(sampled, cure), *_tilts(sampled), *_places(sampled, points, cure)]
    if table.distance < 0.0:
        problems.append(
            f"the {table.name} would come {-1e3 * table.distance:.0f} mm too near to the table, "
            f"{sampled.when(table.index)}"
        )
    problems += _itself(sampled, points, cure)
    if sampled.margins.min() >= THROUGH:
        problems += [*_joint_speeds(sampled), *_speeds(sampled, points)]
    return problems


def check_clearance(sampled: SampledPath, until: float, pourer: Vessel, receiver: Vessel) -> tuple[Nearest, list[str]]:
    """Smallest distance of the pourer from the receiver until a time [s], and the problems with it."""
    nearest = nearest_to_receiver(sampled, until, pourer, receiver)
    least = sampled.spec.limits.clearance
    if nearest.distance >= least:
        return nearest, []
    tilt = math.degrees(float(sampled.tilts[nearest.index]))
    apart = 1e3 * nearest.distance
    how = "would touch the receiver"
    if apart >= 0.05:
        how = f"would come within {apart:.1f} mm of the receiver"
    elif apart <= -0.05:
        how = f"would run {-apart:.1f} mm into the receiver"
    return nearest, [
        f"the pourer {how} at a tilt of {tilt:.0f} deg, {sampled.when(nearest.index)}; "
        f"{1e3 * least:.0f} mm have to stay free: a larger x_offset or height clears it"
    ]


def check_reach(unreached: SampledPath) -> str:
    """Message about a path of which some poses cannot be reached in the posture of home."""
    assert unreached.unreached is not None
    worst, text = unreached.model.out_of_reach(
        unreached.unreached.rotation, unreached.unreached.position, np.array(unreached.spec.home_joints)
    )
    # an impossible path has no times yet
    return f"{'on the way from home' if unreached.name == 'approach' else unreached.when(worst)}: {text}"


def check_way(racing: RacingJointError, spec: JointArmSettings) -> str:
    """Message about a way from home through a singularity."""
    direction = math.degrees(spec.cell.direction)
    facing = math.degrees(math.remainder(spec.cell.direction + racing.heading, 2.0 * math.pi))
    turned = math.degrees(racing.turn)
    why = (
        f"home holds the pourer as for a direction of {facing:.0f} deg, and cell.direction is {direction:.0f} deg: the "
        f"full pourer would be turned by {turned:.0f} deg on its way"
        if turned >= 1.0
        else "on the way from home"
    )
    cure = f"set cell.direction nearer to {facing:.0f} deg, or wait at a 'home' nearer to the pour"
    return (
        f"{why}, through a place where two joints turn about one axis and "
        f"{spec.kinematics.joint_names[racing.joint]} would "
        f"have to race; {cure if turned >= 1.0 else 'move the receiver, or let the arm wait elsewhere'}"
    )


def report(parts: list[SampledPath], clearance: float, pourer: Vessel, deviation: float) -> PathReport:
    """Results of the checks of a whole path.

    Args:
        parts: approach, pour, retreat.
        clearance: smallest distance of pourer and receiver [m].
        pourer: geometry.
        deviation: of the tilt from the requested one [rad].
    """
    joint_speeds = np.array([s.joint_speeds.max(axis=0) for s in parts]).max(axis=0)
    points = hull(pourer)
    lows, highs = [], []
    for s in parts:
        lows += [s.tool.min(axis=0), [_support(s, axis, points)[0].min() for axis in np.eye(3)]]
        highs += [s.tool.max(axis=0), [-_support(s, -axis, points)[0].min() for axis in np.eye(3)]]
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    return PathReport(
        joint_speed=float(joint_speeds.max()),
        fastest_joint=int(np.argmax(joint_speeds)),
        joint_name=parts[0].model.joint_names[int(np.argmax(joint_speeds))],
        tool_speed=max(float(s.point_speeds(points).max()) for s in parts),
        tilt=max(float(s.tilts.max()) for s in parts),
        tilt_speed=max(float(s.turning.max()) for s in parts),
        singularity=min(float(s.margins.min()) for s in parts),
        clearance=clearance,
        low=(float(low[0]), float(low[1]), float(low[2])),
        high=(float(high[0]), float(high[1]), float(high[2])),
        duration=sum(float(s.times[-1]) for s in parts),
        deviation=deviation,
    )


def recheck(path: JointPath, spec: JointArmSettings) -> None:
    """Check a path again immediately before it is executed, without information about its purpose.

    Checks ranges, joint speeds and jumps; tool centre point and the pourer's underside against box, planes and table.

    Raises:
        InvalidActionError: the path must not be executed; the text lists all problems.
    """
    times, joints = path.times, path.joints
    count = len(spec.home_joints)
    if times.ndim != 1 or len(times) < 2 or joints.shape != (len(times), count):
        raise InvalidActionError(f"the path has no two waypoints of {count} joints each")
    if not (np.isfinite(times).all() and np.isfinite(joints).all()) or times[0] != 0.0 or np.any(np.diff(times) <= 0):
        raise InvalidActionError("the path's times should increase from 0, and all its numbers be finite")
    problems = []
    jumps = np.abs(np.diff(joints, axis=0))
    if jumps.max() > LARGEST_STEP:
        row, joint = divmod(int(np.argmax(jumps)), count)
        degrees = math.degrees(jumps.max())
        problems.append(
            f"{spec.kinematics.joint_names[joint]} would jump by {degrees:.0f} deg, {times[row]:.2f} s into the path"
        )
    sampled = SampledPath.of("path", path, spec)
    problems += [*_ranges(sampled), *_joint_speeds(sampled), *_places(sampled, np.zeros((1, 3)))]
    if problems:
        raise InvalidActionError(refusal(problems))


def refusal(problems: list[str]) -> str:
    """All problems of a path in one text."""
    if len(problems) == 1:
        return f"the arm can't make this pour: {problems[0]}"
    return "the arm can't make this pour:\n" + "\n".join(f"  - {problem}" for problem in problems)


def _first_worst(values: FloatArray) -> int:
    """First index of the largest value; during a hold the value stays constant to within rounding."""
    most = float(values.max())
    return int(np.argmax(values >= most - 1e-6 * abs(most) - 1e-9))


def _range(model: ArmModel, joint: int) -> str:
    low, high = math.degrees(model.joint_low[joint]), math.degrees(model.joint_high[joint])
    return f"±{high:.0f} deg" if low == -high else f"{low:.0f} … {high:.0f} deg"


def _ranges(s: SampledPath) -> Iterator[str]:
    for k, name in enumerate(s.model.joint_names):
        beyond = np.maximum(s.model.joint_low[k] - s.joints[:, k], s.joints[:, k] - s.model.joint_high[k])
        worst = _first_worst(beyond)
        if beyond[worst] > 0.0:
            yield (
                f"{name} would turn to {math.degrees(float(s.joints[worst, k])):.1f} deg, {s.when(worst)}; its range "
                f"is {_range(s.model, k)}: {s.model.range_remedy}"
            )


def _joint_speeds(s: SampledPath) -> Iterator[str]:
    for k, (name, fastest) in enumerate(zip(s.model.joint_names, s.model.joint_speed, strict=True)):
        most = min(fastest, s.spec.limits.joint_speed)
        worst = _first_worst(s.joint_speeds[:, k])
        speed = float(s.joint_speeds[worst, k])
        if speed > most * _tolerated(s):
            yield (
                f"{name} would turn at {math.degrees(speed):.4g} deg/s, {s.when(worst)}; "
                f"{math.degrees(most):.0f} deg/s are allowed: {_slower(s, 'joint_speed' if most < fastest else None)}"
            )


def _tolerated(s: SampledPath) -> float:
    """Factor of a speed limit that a path may reach."""
    return 1.0 + s.model.speed_slack


def _slower(s: SampledPath, limit: str | None) -> str:
    """The remedy for an excessive speed; `limit`: key of the laboratory's file that could allow it, if there is one."""
    lower = "angular_velocity or return_velocity" if s.name == "pour" else "approach_speed"
    return f"lower {lower}" + ("" if limit is None else f", or raise arm.limits.{limit}")


def _singular(s: SampledPath, cure: str = MOVE) -> Iterator[str]:
    for index, text in s.model.singular(s.joints, s.spec.limits.singularity, cure):
        yield f"{s.when(index)}: {text}"


def _speeds(s: SampledPath, points: FloatArray) -> Iterator[str]:
    speeds = s.point_speeds(points)
    worst = _first_worst(speeds)
    if speeds[worst] > s.spec.limits.tool_speed * _tolerated(s):
        yield (
            f"tool or pourer would move at {speeds[worst]:.2f} m/s, {s.when(worst)}; "
            f"{s.spec.limits.tool_speed:.2f} m/s are allowed: {_slower(s, 'tool_speed')}"
        )
    worst = _first_worst(s.turning)
    if s.turning[worst] > s.spec.limits.tilt_speed * (_tolerated(s) + TURNING_SLACK):
        yield (
            f"the pourer would turn at {math.degrees(s.turning[worst]):.0f} deg/s, {s.when(worst)}; "
            f"{math.degrees(s.spec.limits.tilt_speed):.0f} deg/s are allowed: {_slower(s, 'tilt_speed')}"
        )


def _tilts(s: SampledPath) -> Iterator[str]:
    worst = _first_worst(s.tilts)
    # on the approach the pourer is full, so a smaller limit holds than during a pour
    upright = s.name in ("approach", "way")
    most = UPRIGHT if upright else s.spec.limits.tilt
    if s.tilts[worst] > most * (1.0 + SLACK):
        yield (
            f"the pourer would lean {math.degrees(s.tilts[worst]):.1f} deg, {s.when(worst)}; "
            f"{math.degrees(most):.1f} deg are allowed"
            f"{' while it is full' if upright else ': lower max_angle, or raise arm.limits.tilt'}"
        )


def _places(s: SampledPath, points: FloatArray, cure: str = MOVE) -> Iterator[str]:
    """Violations of box, planes and table by the TCP and points (V, 3) of the pourer."""
    limits = s.spec.limits
    for k, axis in enumerate("xyz"):
        for sign, bound, word in ((1.0, limits.box.low.vector[k], "least"), (-1.0, limits.box.high.vector[k], "most")):
            for thing, where, value in _beyond(s, sign * np.eye(3)[k], sign * bound, points):
                yield (
                    f"{thing} would leave the box at {axis} = {sign * value:.3f} m, {s.when(where)}; "
                    f"at {word} {bound:.3f} m are allowed: {cure}, or widen arm.limits.box"
                )
    for number, plane in enumerate(limits.planes, 1):
        for thing, where, value in _beyond(s, np.array(plane.normal), plane.offset, points):
            yield f"{thing} would go {1e3 * (plane.offset - value):.1f} mm beyond plane {number}, {s.when(where)}"
    table = s.spec.cell.table
    for thing, where, value in _beyond(s, np.array([0.0, 0.0, 1.0]), table, points):
        yield f"{thing} would go {1e3 * (table - value):.1f} mm below the table, {s.when(where)}"


def _beyond(s: SampledPath, normal: FloatArray, offset: float, points: FloatArray) -> Iterator[tuple[str, int, float]]:
    """The point that violates normal · point ≥ offset most: its name, sample, and normal · point [m]."""
    tool = s.tool @ normal
    if tool.min() < offset:
        yield "the tool", _first_worst(-tool), float(tool.min())
    least, lowest = _support(s, normal, points)
    if least.min() < offset:
        where = _first_worst(-least)
        rim = points[lowest[where], 2] > 0.5 * points[:, 2].max() > 0.0
        yield f"the pourer's {'rim' if rim else 'underside'}", where, float(least.min())


def _support(s: SampledPath, normal: FloatArray, points: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Smallest normal · point of the pourer's points (V, 3) at every sample [m], and the index of that point; each
    (N,).
    """
    along = (normal @ s.pourer.rotation) @ points.T
    return s.pourer.position @ normal + along.min(axis=1), along.argmin(axis=1)


def _links(s: SampledPath, receiver: Vessel) -> Iterator[str]:
    table, cup = nearest_links(s, receiver)
    if table.distance < 0.0:
        yield f"the {table.name} would come {-1e3 * table.distance:.0f} mm too near to the table, {s.when(table.index)}"
    if cup.distance < s.spec.limits.clearance:
        yield (
            f"the {cup.name} would come within {1e3 * cup.distance:.0f} mm of the receiver, {s.when(cup.index)}; "
            f"{1e3 * s.spec.limits.clearance:.0f} mm have to stay free"
        )


def _itself(
    s: SampledPath, points: FloatArray, cure: str = "turn 'direction', or wait at another 'home'"
) -> Iterator[str]:
    thing, nearest = nearest_to_itself(s, points)
    if nearest.distance < s.spec.limits.clearance:
        apart = 1e3 * nearest.distance
        how = f"come within {apart:.0f} mm of" if apart > 0.0 else f"run {-apart:.0f} mm into"
        yield (
            f"{thing} would {how} the arm's {nearest.name}, {s.when(nearest.index)}; "
            f"{1e3 * s.spec.limits.clearance:.0f} mm have to stay free: {cure}"
        )
