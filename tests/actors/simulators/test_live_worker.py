"""`live_worker`: a live pour in a process of its own."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from actors.dosing.particle_liquid import dose_task
from actors.interfaces import LaboratoryError
from actors.simulators.live_worker import LivePourProcess, LocalLivePours
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.live_pour import LivePour
from sim_engine.motion import recorded_motion
from sim_engine.outcome import ParticleState
from sim_engine.scene import PoseError, PourTask, SampledMotion, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder

SCENE = Scene(
    "dose",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("bowl", inner_radius=0.06, inner_height=0.1),
    Liquid(mass=0.3),
)
ACTION = Action(angular_velocity=60 * DEG, x_offset=0.11, height=0.08, hold_time=0.0)
TASK = PourTask(SCENE, ACTION, SimulationParameters(particles=200), 3)


@pytest.fixture(scope="module")
def simulator() -> Iterator[PourSimulator]:
    started = PourSimulator()
    yield started
    started.close()


@pytest.fixture
def pours() -> Iterator[LivePourProcess]:
    started = LivePourProcess()
    yield started
    started.close()


def motion(simulator: PourSimulator) -> SampledMotion:
    times, vessels = np.arange(0.0, 1.0, 0.02), (simulator.vessel(SCENE.pourer), simulator.vessel(SCENE.receiver))
    return recorded_motion(SCENE, ACTION, *vessels, times, np.minimum(80.0 * times / 0.4, 80.0) * DEG)


def test_a_pour_in_another_process_is_bit_for_bit_that_of_this_one(
    pours: LivePourProcess, simulator: PourSimulator
) -> None:
    path = motion(simulator)
    here = LivePour(simulator, TASK, path.poses[0])
    pours.begin(TASK, path.poses[0])
    for poses in (slice(1, 20), slice(20, None)):
        state = pours.advance(path.times[poses], path.poses[poses])
        assert state == here.advance(path.times[poses], path.poses[poses])
    assert state.in_pourer < 0.3
    for there, expected in zip(pours.particles(), here.particles(), strict=True):
        np.testing.assert_array_equal(there, expected)
    assert ParticleState.IN_FLIGHT in pours.particles()[1]


@pytest.mark.slow
def test_after_the_process_was_killed_the_next_pour_has_a_new_one(
    pours: LivePourProcess, simulator: PourSimulator
) -> None:
    path = motion(simulator)
    pours.ready(TASK)
    assert pours._child is not None
    os.kill(pours._child.pid, signal.SIGKILL)
    pours.ready(TASK)
    pours.begin(TASK, path.poses[0])
    os.kill(pours._child.pid, signal.SIGKILL)
    with pytest.raises(LaboratoryError, match="simulates the liquid of doses has died"):
        pours.advance(path.times[1:], path.poses[1:])
    with pytest.raises(LaboratoryError, match="has ended"):
        pours.advance(path.times[1:], path.poses[1:])
    pours.begin(TASK, path.poses[0])
    assert pours.advance(path.times[1:], path.poses[1:]).in_pourer < 0.3


def test_the_end_of_the_process_is_reported_with_its_last_messages(pours: LivePourProcess) -> None:
    with pytest.raises(LaboratoryError, match=r"has died: .*AttributeError: .*scene"):
        pours.begin("no task", np.zeros(7))  # type: ignore[arg-type]


@pytest.mark.slow
def test_an_impossible_pour_is_refused_and_the_process_goes_on(pours: LivePourProcess) -> None:
    clings = SimulationParameters(particles=200, lip_adhesion=1.0)
    pose = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(LaboratoryError, match="set lip_adhesion to 0"):
        pours.begin(replace(TASK, parameters=clings), pose)
    with pytest.raises(LaboratoryError, match="holds"):
        pours.begin(replace(TASK, scene=replace(SCENE, liquid=Liquid(mass=0.9))), pose)
    pours.begin(TASK, pose)
    assert pours.advance(np.array([0.1]), pose).in_pourer == 0.3


@pytest.mark.parametrize(
    ("displacement", "shares"), [(0.0, 2), (1e-3, 1)], ids=["in the plane: mirrored", "1 mm aside: whole"]
)
def test_a_dose_is_simulated_by_half_where_its_receiver_stands_in_the_plane_of_the_tilt(
    simulator: PourSimulator, displacement: float, shares: int
) -> None:
    task = dose_task(SCENE, ACTION, 0.3, SimulationParameters(particles=2000), PoseError(y=displacement), seed=1)
    pours, pose = LocalLivePours(simulator), motion(simulator).poses[0]
    pours.begin(task, pose + np.array([0.0, 7e-6, 0.0, 0.0, 0.0, 0.0, 0.0]))
    positions, _ = pours.particles()
    assert len(positions) == 2000
    image = positions[: 2000 // shares] * np.array([1.0, -1.0, 1.0], np.float32)
    assert np.array_equal(positions[-2000 // shares :], image) is (shares == 2)
