"""`dribbling`: liquid that runs down the outside of the pourer: when it does, where it drips, and what a simulation
makes of it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim_engine.action import DEG, Action
from sim_engine.dribbling import DribblingCourse, critical_weber, dribbling_course, outer_wall
from sim_engine.lip_flow import flow_course, weber
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.model_validity import regimes
from sim_engine.motion import plan_motion
from sim_engine.outcome import ParticleState, PourOutcome
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import Vessel, build_vessel

CUP = cylinder("cup", inner_radius=0.04, inner_height=0.1)
GLASS = cylinder("glass", inner_radius=0.045, inner_height=0.09)
WATER = Liquid(mass=0.1996)
SCENE = Scene("scene", CUP, GLASS, WATER)
TRICKLE = Action(angular_velocity=10 * DEG, max_angle=80 * DEG, x_offset=0.095, height=0.1)
"""A quarter of it leaves at a Weber number below 2 and at tilts below 90°."""


def course(adhesion: float = 1.0, action: Action = TRICKLE, liquid: Liquid = WATER, **at: Any) -> DribblingCourse:
    pourer, receiver = build_vessel(CUP), build_vessel(GLASS)
    motion = plan_motion(replace(SCENE, liquid=liquid), action, pourer, receiver)
    found = dribbling_course(motion, liquid, pourer, receiver, adhesion=adhesion, **at)
    assert found is not None
    return found


def simulated(simulator: PourSimulator, adhesion: float, particles: int = 500, **more: Any) -> PourOutcome:
    parameters = SimulationParameters(particles=particles, lip_adhesion=adhesion)
    return simulator.simulate(PourTask(SCENE, TRICKLE, parameters, 1, **more)).outcome


def test_onset_follows_the_work_of_adhesion() -> None:
    """Duez et al. 2010: wetting decides; a liquid that does not wet never dribbles."""
    assert critical_weber(1.0, 0.0) == 2.0
    assert critical_weber(2.0, 0.5 * math.pi) == pytest.approx(2.0)
    shares = [course(2.0, liquid=WATER.model_copy(update={"contact_angle": a * DEG})).share for a in (0, 60, 120, 180)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.2
    assert shares[-1] == 0.0


def test_slow_pours_dribble_more_than_quick_ones() -> None:
    shares = [
        course(action=TRICKLE.with_values(angular_velocity=w * DEG, max_angle=70 * DEG)).share for w in (3, 5, 60)
    ]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.3
    quick = course(action=TRICKLE.with_values(angular_velocity=60 * DEG, max_angle=120 * DEG))
    assert 0.0 < quick.share < 0.01


def test_a_straight_cup_beyond_a_right_angle_does_not_dribble() -> None:
    """Its outer wall rises from the lip."""
    pourer, receiver = build_vessel(CUP), build_vessel(GLASS)
    action = TRICKLE.with_values(max_angle=120 * DEG)
    motion, far = plan_motion(SCENE, action, pourer, receiver), course(5.0, action)
    flow = flow_course(motion, WATER, pourer, receiver)
    assert flow is not None
    tilts = motion.tilt(flow.time)
    slow = weber(WATER, flow.velocity, flow.film) < critical_weber(5.0, WATER.contact_angle)
    assert (slow & (tilts > 90 * DEG)).any()
    assert not far.dribbles[tilts > 90 * DEG].any()
    assert far.dribbles[slow & (tilts < 85 * DEG)].all()


def test_liquid_drips_off_the_lowest_point_of_the_cup() -> None:
    """At a tilt below 90° that is the edge of its underside, 104 mm from the lip along the wall."""
    found = course(2.0)
    assert found.length[found.dribbles] == pytest.approx(0.104, abs=0.002)
    assert not found.received.any()


def test_drops_above_the_receiver_are_received() -> None:
    """The edge of the cup's underside is 140 to 160 mm from the receiver's usual place."""
    there = course(2.0, receiver_at=(-0.15, 0.0, 0.0))
    assert there.received[there.dribbles].any()
    assert not course(2.0, receiver_at=(-0.15, 0.05, 0.0)).received.any()


def test_a_pour_that_is_simulated_with_adhesion_is_not_warned_of() -> None:
    cups = build_vessel(CUP), build_vessel(GLASS)
    warned, simulated = (regimes(SCENE, TRICKLE, *cups, spacing=1e-3, adhesion=adhesion) for adhesion in (0.0, 1.0))
    assert "dribbling" in {one.kind for one in warned.not_covered}
    assert {one.kind for one in warned.not_covered} - {one.kind for one in simulated.not_covered} == {"dribbling"}


def outline(vessel: Vessel) -> tuple[float, float]:
    wall = outer_wall(vessel)
    return float(wall[:, 0].max()), float(wall[0, 1])


def test_outer_wall_is_that_of_the_vessel() -> None:
    cup = build_vessel(CUP)
    radius, top = outline(cup)
    assert radius == pytest.approx(cup.outer_radius, abs=5e-4)
    assert top == pytest.approx(cup.rim_height, abs=5e-4)
    steps = np.hypot(*np.diff(outer_wall(cup), axis=0).T)
    assert steps.max() < 2e-3


def test_adhesion_changes_where_liquid_ends_and_nothing_else(simulator: PourSimulator) -> None:
    jet, wet = simulated(simulator, 0.0), simulated(simulator, 2.0)
    assert wet.dribbled > jet.dribbled == 0.0
    fate = {"received": 0.0, "spilled": 0.0, "in_flight": 0.0, "dribbled": 0.0, "curve_spilled": (), "cpu_s": 0.0}
    assert replace(wet, **fate) == replace(jet, **fate)


def test_dribbling_is_spilled_next_to_the_receiver(simulator: PourSimulator) -> None:
    jet, wet = simulated(simulator, 0.0), simulated(simulator, 2.0)
    assert jet.spilled < 0.01
    assert wet.dribbled == pytest.approx(course(2.0).share * jet.fractions.poured, abs=0.005)
    assert wet.spilled == pytest.approx(jet.spilled + wet.dribbled, abs=0.005)
    assert wet.retained == jet.retained
    assert wet.received + wet.spilled + wet.retained + wet.in_flight + wet.escaped == pytest.approx(1.0)
    assert wet.curve_spilled[-1] == pytest.approx(wet.spilled)
    assert list(wet.curve_spilled) == sorted(wet.curve_spilled)


@pytest.mark.slow
def test_dribbling_does_not_depend_on_the_number_of_particles(simulator: PourSimulator) -> None:
    coarse, fine = (simulated(simulator, 1.0, n) for n in (500, 2000))
    assert coarse.dribbled / coarse.fractions.poured == pytest.approx(fine.dribbled / fine.fractions.poured, abs=0.003)


def test_frames_show_liquid_on_the_wall(simulator: PourSimulator) -> None:
    parameters = SimulationParameters(particles=500, lip_adhesion=2.0)
    run = simulator.simulate(PourTask(SCENE, TRICKLE, parameters, 1, frame_rate=10.0))
    assert run.frames is not None
    dry = simulator.simulate(PourTask(SCENE, TRICKLE, SimulationParameters(particles=500), 1, frame_rate=10.0)).frames
    assert dry is not None
    behind = -0.08  # the lip is at -0.055 m
    in_air = [
        positions[(states == ParticleState.IN_FLIGHT) & (positions[:, 0] < behind)]
        for frames in (run.frames, dry)
        for positions, states in zip(frames.positions, frames.states, strict=True)
    ]
    half = len(in_air) // 2
    assert sum(map(len, in_air[:half])) > 20
    assert sum(map(len, in_air[half:])) == 0
    assert (run.frames.states[-1] == ParticleState.SPILLED).mean() == pytest.approx(run.outcome.spilled, abs=0.01)
