"""`live_pour`: liquid that follows a motion as it becomes known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_engine.action import DEG, Action
from sim_engine.errors import InvalidSceneError
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.live_pour import LivePour
from sim_engine.motion import recorded_motion
from sim_engine.outcome import ParticleState
from sim_engine.scene import PourTask, SampledMotion, Scene
from sim_engine.simulator import SLICE, PourSimulator
from sim_engine.vessel.shapes import cylinder

SCENE = Scene(
    "dose",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("bowl", inner_radius=0.06, inner_height=0.1),
    Liquid(mass=0.3),
)
ACTION = Action(angular_velocity=60 * DEG, x_offset=0.11, height=0.08, hold_time=0.0)
TASK = PourTask(SCENE, ACTION, SimulationParameters(particles=250), 3)

MOTIONS = {
    "a dose": ([0.0, 0.6, 3.0, 3.4, 3.8, 5.0], [0.0, 25.0, 52.0, 52.0, 0.0, 0.0]),
    "turned back before anything flows": ([0.0, 0.8, 1.2, 1.6, 2.8, 3.6], [0.0, 20.0, 5.0, 20.0, 60.0, 0.0]),
    "at once": ([0.0, 0.3, 0.8, 2.0], [0.0, 75.0, 75.0, 0.0]),
}


def executed(simulator: PourSimulator, name: str) -> SampledMotion:
    """A motion as an arm reports it, 125 times a second."""
    corners, tilts = MOTIONS[name]
    times = np.arange(0.0, corners[-1], 8e-3)
    vessels = simulator.vessel(SCENE.pourer), simulator.vessel(SCENE.receiver)
    return recorded_motion(SCENE, ACTION, *vessels, times, np.interp(times, corners, tilts) * DEG)


@pytest.mark.parametrize("mirrored", [False, True], ids=["whole", "mirrored"])
@pytest.mark.parametrize("name", MOTIONS)
def test_the_liquid_is_bit_for_bit_that_of_the_motion_given_beforehand(
    simulator: PourSimulator, name: str, mirrored: bool
) -> None:
    motion = executed(simulator, name)
    task = replace(TASK, scene=replace(SCENE, mirrored=mirrored), frame_rate=1.0 / SLICE, motion=motion)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sim_engine.simulator.MIRRORED_FROM", 0)
        whole = simulator.simulate(task)
    assert whole.outcome.mirrored is mirrored
    assert whole.frames is not None
    assert whole.outcome.received > 0.02  # 0.048 on one processor, more than 0.05 on others
    frames: dict[float, tuple[NDArray[np.float32], NDArray[np.uint8]]] = {}
    # the joints of an emulated arm leave the plane as little
    aside = np.array([0.0, 7e-6, 0.0, 0.0, 7e-8, 0.0, 7e-8]) * mirrored
    pour = LivePour(simulator, TASK, motion.poses[0] + aside, mirrored=mirrored)
    for first in range(1, len(motion.times)):  # several poses at once would leave out recorded moments
        state = pour.advance(motion.times[first : first + 1], motion.poses[first : first + 1] - aside)
        frames[round(state.time, 9)] = pour.particles()
    state = pour.advance(motion.times[-1:] + 1.0, motion.poses[-1:])
    assert state.received == pytest.approx(SCENE.liquid.mass * whole.outcome.received, abs=0.01)
    compared = 0
    for time, positions, states in zip(whole.frames.times, whole.frames.positions, whole.frames.states, strict=True):
        if (alike := frames.get(round(float(time), 9))) is not None and ParticleState.IN_FLIGHT in states:
            np.testing.assert_array_equal(alike[0], positions)
            np.testing.assert_array_equal(alike[1], states)
            compared += 1
    assert compared > 4


def test_a_thick_liquid_flows_live_as_in_a_pour_that_is_given_beforehand(simulator: PourSimulator) -> None:
    motion = executed(simulator, "at once")
    thick = replace(TASK, scene=replace(SCENE, liquid=Liquid(mass=0.3, density=1200.0, dynamic_viscosity=0.02)))
    whole = simulator.simulate(replace(thick, motion=motion)).outcome
    pour = LivePour(simulator, thick, motion.poses[0])
    pour.advance(motion.times[1:], motion.poses[1:])
    state = pour.advance(motion.times[-1:] + 1.0, motion.poses[-1:])
    assert state.invalid is None
    assert 0.3 * whole.received > 0.02
    assert state.received == pytest.approx(0.3 * whole.received, abs=4e-3)


def test_masses_of_a_live_pour_add_up_to_the_load_and_nothing_flows_from_an_upright_cup(
    simulator: PourSimulator,
) -> None:
    motion = executed(simulator, "a dose")
    pour = LivePour(simulator, TASK, motion.poses[0])
    upright = pour.advance(np.array([2.0]), motion.poses[:1])
    assert (upright.time, upright.in_pourer, upright.invalid) == (2.0, 0.3, None)
    assert len(pour.particles()[0]) == TASK.parameters.particles
    state = pour.advance(2.0 + motion.times[1:], motion.poses[1:])
    assert state.in_pourer + state.in_flight + state.received + state.spilled == pytest.approx(0.3)
    assert 0.0 < state.received < 0.3


def test_a_live_pour_says_what_it_cannot_simulate(simulator: PourSimulator) -> None:
    motion = executed(simulator, "at once")
    sticky = replace(TASK, parameters=SimulationParameters.from_values({"lip_adhesion": 1.0}))
    with pytest.raises(InvalidSceneError, match="set lip_adhesion to 0"):
        LivePour(simulator, sticky, motion.poses[0])
    aside = motion.poses + np.array([0.0, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="plane of symmetry"):
        LivePour(simulator, TASK, aside[0], mirrored=True).advance(motion.times[1:], aside[1:])
    pour = LivePour(simulator, TASK, motion.poses[0])
    pour.advance(motion.times[1:80], motion.poses[1:80])
    with pytest.raises(ValueError, match="increase"):
        pour.advance(motion.times[70:80], motion.poses[70:80])
    pour = LivePour(simulator, TASK, motion.poses[0])
    pour.advance(motion.times[1:80], motion.poses[1:80])
    simulator.simulate(replace(TASK, motion=motion))
    with pytest.raises(RuntimeError, match="another pour"):
        pour.advance(motion.times[80:], motion.poses[80:])
