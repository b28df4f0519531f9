"""Whether an arm's settings make sense in themselves: asked when a laboratory's file is read, before any pour."""

from __future__ import annotations

import math

import numpy as np

from actors.arm.geometry import JOINT_NAMES
from actors.arm.path.kinematics import MODELS, beyond_reach, inverse, singularities
from actors.arm.path.transforms import cell_transforms, flange_poses, flange_transforms, pourer_transforms
from actors.arm.spec import UrArmSpec
from sim_engine.vessel.sdf import MARGIN

UPRIGHT = math.radians(3.0)
"""How far a pourer that waits or travels may lean [rad]: it is full."""

PARTS = ("shoulder", "elbow", "wrist")
"""As `singularities` counts."""


def check_limits(spec: UrArmSpec) -> list[str]:
    """What is wrong with the settings of an arm; empty if nothing is. Texts name the keys of a laboratory's file."""
    limits = spec.limits
    low, high = np.array(limits.box_low), np.array(limits.box_high)
    if np.any(low >= high):
        axis = "xyz"[int(np.argmax(low >= high))]
        return [f"limits.box: {axis} of 'low' should be smaller than that of 'high'"]
    return [*_speeds(spec), *_clearance(spec), *_receiver(spec), *_home(spec)]


def _speeds(spec: UrArmSpec) -> list[str]:
    problems = []
    deg = math.degrees
    if spec.approach_speed > spec.limits.joint_speed:
        problems.append(
            f"approach_speed: {deg(spec.approach_speed):.4g} deg/s is above limits.joint_speed, "
            f"{deg(spec.limits.joint_speed):.4g} deg/s"
        )
    if spec.untilt_speed > spec.limits.tilt_speed:
        problems.append(
            f"untilt_speed: {deg(spec.untilt_speed):.4g} deg/s is above limits.tilt_speed, "
            f"{deg(spec.limits.tilt_speed):.4g} deg/s"
        )
    return problems


def _clearance(spec: UrArmSpec) -> list[str]:
    if spec.limits.clearance <= MARGIN:
        return []
    return [
        f"limits.clearance: {1e3 * spec.limits.clearance:.4g} mm is more than the {1e3 * MARGIN:.0f} mm up to which "
        "distances between vessels are known"
    ]


def _receiver(spec: UrArmSpec) -> list[str]:
    problems = []
    x, y, z = spec.cell.receiver
    low, high = spec.limits.box_low, spec.limits.box_high
    if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
        problems.append(f"cell.receiver: ({x:.3f}, {y:.3f}) m lies outside limits.box, seen from above")
    for number, plane in enumerate(spec.limits.planes, 1):
        # a plane that lies flat may well pass above where the receiver stands
        if abs(plane.normal[2]) < 0.5 and float(np.dot(plane.normal, spec.cell.receiver)) < plane.offset:
            problems.append(f"cell.receiver: ({x:.3f}, {y:.3f}, {z:.3f}) m lies beyond plane {number} of limits.planes")
    if z < spec.cell.table - 1e-6:
        problems.append(f"cell.receiver: stands at {z:.3f} m, below cell.table at {spec.cell.table:.3f} m")
    model = MODELS[spec.model]
    beside = np.array([[-0.1, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]])
    flange = flange_poses(beside, spec)
    if not np.isfinite(inverse(flange.rotation, flange.position, model)).any():
        beyond = beyond_reach(flange.rotation, flange.position, model)[0]
        least = 1e3 * float(beyond[np.argmin(np.abs(beyond))])
        text = (
            f"out of reach by {least:.0f} mm; move the receiver nearer to the base"
            if least > 0.0
            else f"{-least:.0f} mm too near to the arm's base; move the receiver away from it"
        )
        problems.append(
            f"cell.receiver: an upright pourer beside it, 100 mm up, is {text}, or turn 'direction' or 'grip'"
        )
    return problems


def _home(spec: UrArmSpec) -> list[str]:
    model, q = MODELS[spec.model], np.array([spec.home])
    problems = []
    for name, angle, most in zip(JOINT_NAMES, spec.home, model.joint_range, strict=True):
        if abs(angle) > most:
            problems.append(
                f"home: {name} at {math.degrees(angle):.1f} deg is outside its range of ±{math.degrees(most):.0f} deg"
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
    margins = singularities(q, model)[0]
    for part, margin in zip(PARTS, margins, strict=True):
        if margin < spec.limits.singularity:
            problems.append(
                f"home: the {part} is {margin:.2f} from singular, limits.singularity asks for "
                f"{spec.limits.singularity:.2f}; bend it more"
            )
    return problems


def outside(point: np.ndarray[tuple[int], np.dtype[np.float64]], spec: UrArmSpec) -> list[str]:
    """Where a point of the room's frame, shape (3,) [m], is not where it may be: box, planes, table."""
    texts = []
    for axis, value, low, high in zip("xyz", point, spec.limits.box_low, spec.limits.box_high, strict=True):
        if not low <= value <= high:
            texts.append(f"outside the box, at {axis} = {value:.3f} m ({low:.3f} … {high:.3f} m are allowed)")
    for number, plane in enumerate(spec.limits.planes, 1):
        beyond = plane.offset - float(np.dot(plane.normal, point))
        if beyond > 0.0:
            texts.append(f"{1e3 * beyond:.1f} mm beyond plane {number}")
    if point[2] < spec.cell.table:
        texts.append(f"{1e3 * (spec.cell.table - point[2]):.1f} mm below the table")
    return texts
