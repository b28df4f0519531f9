"""Is a pour possible at all? Answered before anything moves."""

from __future__ import annotations

import functools
import math

import numpy as np

from actors.protocols import InvalidActionError
from sim_engine.action import Action
from sim_engine.contact import describe_contact, first_contact
from sim_engine.motion import PourMotion, plan_motion
from sim_engine.task import Scene
from sim_engine.vessel.build import build_vessel
from sim_engine.vessel.spec import VesselSpec
from sim_engine.vessel.vessel import Vessel, check_holds

TURN_STEP = math.radians(0.5)
"""Turn between two poses that are checked: 2 mm at the far end of a 250 mm vessel."""

_built = functools.lru_cache(maxsize=16)(build_vessel)


def _vessel(spec: VesselSpec) -> Vessel:
    return _built(spec)


def plan_pour(scene: Scene, action: Action) -> PourMotion:
    """The motion that the arm will make.

    Args:
        scene: vessels and liquid.
        action: how to pour.

    Raises:
        InvalidActionError: the vessels would touch, the pourer can't hold the load, or the motion can't be made.
    """
    try:
        pourer, receiver = _vessel(scene.pourer), _vessel(scene.receiver)
        check_holds(pourer, scene.liquid.volume)
        motion = plan_motion(scene, action, pourer, receiver)
    except ValueError as error:
        raise InvalidActionError(str(error)) from error
    tilted = next(phase.end for phase in motion.phases if phase.name == "tilt")
    # The way back leads through the same poses. Turning is slower at both ends, so that the steps are smaller there.
    times = np.linspace(0.0, tilted, 2 + math.ceil(tilted * action.angular_velocity / TURN_STEP))
    poses = motion.sample(times)
    contact = first_contact(pourer, receiver, poses)
    if contact is not None:
        tilt = float(motion.tilt(times)[contact.index])
        raise InvalidActionError(describe_contact(contact, tilt=tilt))
    return motion
