"""What can be run and makes little sense: warned of, with the part of the box of actions that would.

Finding it costs no pour: a stream that can't hit its receiver (a free jet's range), and tilts that are faster
than the laboratory's arm may turn.
"""

from __future__ import annotations

import itertools
import math

from actors.arm.spec import ArmSpec
from orchestrator.config.yaml.source import Loc
from orchestrator.plan import CalibrationPlan, DeploymentPlan
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.lip import flow_course
from sim_engine.motion import plan_motion
from sim_engine.space import Axis, Space
from sim_engine.task import Scene
from sim_engine.vessel.vessel import Vessel

BESIDE = 0.015
"""How far beside the opening the middle of a stream may pass and still bring something into it [m]."""

LEAST = 1.0 / 3.0
"""Part of a range of offsets from which a stream has to hit: below it most pours of a campaign are wasted."""

MOST_TRIED = 9
"""Pours of a box, other than in x_offset, whose streams are worked out."""

Senseless = tuple[tuple[Loc, ...], str]
"""Keys where it may stand, the most particular first, and what to say."""


def senseless(
    plan: CalibrationPlan | DeploymentPlan,
    scene: Scene,
    pourer: Vessel,
    receiver: Vessel,
    arm: ArmSpec | None,
    known: dict[tuple[object, ...], float | None],
) -> list[Senseless]:
    """What makes little sense about the actions of a stage in one of its scenes.

    Args:
        plan: of the stage.
        scene: one of its scenes.
        pourer, receiver: geometry of the scene's vessels, which hold its load.
        arm: of the laboratory, if it has one.
        known: landings that were worked out before; they don't depend on the receiver. Filled here.
    """
    told = [_misses(plan.actions, scene, pourer, receiver, known)]
    if arm is not None and arm.tilt_speed_limit is not None:
        told += [
            _too_fast(plan.actions, scene, name, arm.tilt_speed_limit)
            for name in ("angular_velocity", "return_velocity")
        ]
    return [one for one in told if one is not None]


def _misses(
    actions: Space, scene: Scene, pourer: Vessel, receiver: Vessel, known: dict[tuple[object, ...], float | None]
) -> Senseless | None:
    """An x_offset from which the stream passes beside the receiver."""
    half, hits, beside, below = receiver.opening_radius + BESIDE, [], 0.0, False
    for values in _spread(tuple(axis for axis in actions.axes if axis.name != "x_offset")):
        try:
            action = scene.action({"x_offset": 0.0, **values})
        except ValueError:
            continue  # no such action, which is reported elsewhere
        key = (scene.pourer, scene.liquid, scene.pivot, scene.hold_cap, action)
        if key not in known:
            known[key] = _landing(scene, action, pourer, receiver)
        landing = known[key]
        if landing is not None and math.isnan(landing):
            below = True
        elif landing is not None and abs(action.y_offset) < half:
            chord = math.sqrt(half**2 - action.y_offset**2)
            hits.append((landing - chord, landing + chord))
        elif landing is not None:
            beside = min(beside or math.inf, abs(action.y_offset))
    if not hits and below:
        text = (
            f"the liquid leaves the lip below the rim of '{scene.receiver.name}'; a larger height would bring it above"
        )
        return _where(actions, "height"), text
    if not hits:
        if not beside:
            return None  # nothing leaves, which is reported elsewhere
        return (
            _where(actions, "y_offset"),
            f"the stream passes {1e3 * beside:.0f} mm beside the axis of '{scene.receiver.name}', whose opening has a "
            f"radius of {1e3 * receiver.opening_radius:.0f} mm",
        )
    low, high = min(low for low, _ in hits), max(high for _, high in hits)
    axis = next((axis for axis in actions.axes if axis.name == "x_offset"), None)
    fixed = scene.fixed.get("x_offset")
    if axis is not None:
        part = max(0.0, min(high, axis.upper) - max(low, axis.lower)) / (axis.upper - axis.lower)
        if part >= LEAST:
            return None
        share = (
            "from no x_offset in this range can a stream hit"
            if part == 0.0
            else f"only from {100 * part:.0f} % of this range can a stream hit"
        )
    elif fixed is not None and not low <= fixed <= high:
        share = "from this x_offset no stream can hit"
    else:
        return None
    ends = f"{math.ceil(1e3 * low):d} … {math.floor(1e3 * high):d} mm"
    return (
        _where(actions, "x_offset"),
        f"{share} '{scene.receiver.name}': a free jet comes down in it from an x_offset of {ends}",
    )


def _landing(scene: Scene, action: Action, pourer: Vessel, receiver: Vessel) -> float | None:
    """Where the stream comes down if the pourer stands over the receiver's axis [m]; None if nothing leaves.

    Not a number if most of it leaves below the receiver's rim.
    """
    try:
        course = flow_course(plan_motion(scene, action, pourer, receiver), scene.liquid, pourer, receiver)
    except ValueError:
        return None  # a motion that can't be made, which is reported elsewhere
    if course is None:
        return None
    return course.landing() if course.quantile(course.fall, 0.5) > 0.0 else math.nan


def _too_fast(actions: Space, scene: Scene, name: str, most: float) -> Senseless | None:
    """A range of speeds whose fastest part the arm refuses."""
    axis = next((axis for axis in actions.axes if axis.name == name), None)
    if axis is None or axis.upper <= most * (1.0 + 1e-9):
        return None
    middle = {other.name: other.decode(0.5) for other in actions.axes}
    try:
        action = scene.action({**middle, name: axis.upper})
    except ValueError:
        return None
    peak = axis.upper
    if action.angular_acceleration is not None:  # a short turn doesn't get that fast
        peak = min(peak, math.sqrt(action.max_angle * action.angular_acceleration))
    if peak <= most * (1.0 + 1e-4):
        return None
    unit = ACTION_DIMENSIONS[name]
    return (
        _where(actions, name),
        f"goes up to {axis.upper / unit.factor:.4g} {unit.display_unit}, and the arm turns the pourer at "
        f"{most / unit.factor:.4g} {unit.display_unit} at most (arm.limits.tilt_speed): faster actions are refused one "
        "by one. End the range there",
    )


def _where(actions: Space, name: str) -> tuple[Loc, ...]:
    """Keys that an action dimension may have its values from."""
    return (("actions", name), ("actions",)) if name in actions.names else (("motion", name),)


def _spread(axes: tuple[Axis, ...]) -> list[dict[str, float]]:
    """The middle, and as many corners as may be."""
    corners = itertools.islice(itertools.product((0.0, 1.0), repeat=len(axes)), MOST_TRIED - 1)
    points = [(0.5,) * len(axes), *corners] if axes else [()]
    return [{axis.name: axis.decode(u) for axis, u in zip(axes, point, strict=True)} for point in points]
