"""Checks before any motion whether a pour is feasible."""

from __future__ import annotations

import functools

from actors.arm.arm_interface import PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.interfaces import InvalidActionError
from sim_engine.action import Action
from sim_engine.motion import PourMotion, plan_motion
from sim_engine.scene import PoseError, Scene
from sim_engine.simulator import check_motion
from sim_engine.vessel.shapes import VesselSpec
from sim_engine.vessel.vessel import Vessel, build_vessel, check_holds


@functools.lru_cache(maxsize=16)
def vessel(spec: VesselSpec) -> Vessel:
    """Build a vessel once per specification: the distance grid of a mesh takes seconds."""
    return build_vessel(spec)


def plan_pour(scene: Scene, action: Action) -> PourMotion:
    """Plan the motion of the pourer with the same definitions as the simulator.

    Args:
        scene: vessels and liquid.
        action: how to pour.

    Raises:
        InvalidActionError: the vessels would touch, the pourer cannot hold the load, or the motion cannot be executed.
    """
    try:
        pourer, receiver = vessel(scene.pourer), vessel(scene.receiver)
        check_holds(pourer, scene.liquid.volume)
        motion = plan_motion(scene, action, pourer, receiver)
        check_motion(motion, scene, action, pourer, receiver, PoseError())
    except (ValueError, OSError) as error:
        raise InvalidActionError(str(error)) from error
    return motion


def path_of(scene: Scene, action: Action, arm: ArmSettings | None) -> PlannedPour | None:
    """Check an action, by the arm that will make it if there is one. Every command that tries an action calls this.

    Args:
        scene: vessels and liquid.
        action: how to pour.
        arm: of the laboratory; None: the pour only has to be possible.

    Returns:
        The arm's path; None without an arm.

    Raises:
        InvalidActionError: the pour is impossible, or the arm can't make it.
    """
    if arm is None:
        plan_pour(scene, action)
        return None
    try:
        return arm_kind(arm).plan(scene, action)
    except ValueError as error:
        raise InvalidActionError(str(error)) from error
