"""`scene`: nuisances of a bench: the simulator applies them as what they are: a receiver elsewhere, a slow clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_engine.action import DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.motion import PourMotion
from sim_engine.scene import PoseError, PourTask, SampledMotion
from sim_engine.simulator import InvalidSceneError, PourSimulator
from tests.sim_engine.test_simulator_pours import task

OFF = {"receiver_x": 0.004, "receiver_y": -0.002, "receiver_z": 0.003, "tilt_zero": 1.0 * DEG, "speed_factor": 1.04}
AS_ERROR = PoseError(x=0.004, y=-0.002, z=0.003, tilt=1.0 * DEG, speed_factor=1.04)


def test_defaults_change_no_bit(simulator: PourSimulator) -> None:
    plain = task(400)
    named = task(400, parameters={name: getattr(SimulationParameters(), name) for name in OFF})
    assert plain.placement == PoseError()
    assert isinstance(motion := simulator.prepare(plain), PourMotion)
    assert motion == simulator.prepare(replace(plain, pose_error=PoseError()))
    one, other = (simulator.simulate(t).outcome for t in (plain, named))
    assert replace(one, cpu_s=0.0) == replace(other, cpu_s=0.0)


def test_nuisances_of_theta_are_what_the_same_errors_of_a_pour_are(simulator: PourSimulator) -> None:
    as_theta, as_error = task(400, parameters=OFF), task(400, pose_error=AS_ERROR)
    assert as_theta.placement == as_error.placement == AS_ERROR
    one, other = (simulator.simulate(t).outcome for t in (as_theta, as_error))
    assert replace(one, cpu_s=0.0) == replace(other, cpu_s=0.0)
    assert one.curve_spilled != simulator.simulate(task(400)).outcome.curve_spilled


def test_a_bench_that_is_off_and_a_pour_that_is_off_add_up() -> None:
    both = task(parameters=OFF, pose_error=AS_ERROR).placement
    assert (both.x, both.z, both.tilt) == pytest.approx((0.008, 0.006, 2.0 * DEG))
    assert both.speed_factor == pytest.approx(1.04**2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("nuisance", "action"),
    [
        ({"receiver_x": 0.012}, {"x_offset": 0.107}),
        ({"receiver_z": -0.02}, {"height": 0.08}),
        ({"receiver_y": 0.01}, {"y_offset": -0.01}),
        ({"speed_factor": 1.2}, {"angular_velocity": 72 * DEG}),
    ],
)
def test_a_nuisance_acts_as_the_action_that_it_makes_of_another(
    simulator: PourSimulator, nuisance: dict[str, float], action: dict[str, float]
) -> None:
    # The same scene a little beside itself: particles are the same, rounding of coordinates is not.
    one = simulator.simulate(task(1000, parameters=nuisance)).outcome
    other = simulator.simulate(task(1000, **action)).outcome
    assert one.spilled == pytest.approx(other.spilled, abs=0.02)
    assert one.received + one.spilled + one.retained == pytest.approx(1.0, abs=0.01)


def test_a_receiver_that_stands_in_the_way_is_refused(simulator: PourSimulator) -> None:
    simulator.prepare(task(x_offset=0.095, height=0.03))
    with pytest.raises(InvalidSceneError, match="cups touch"):
        simulator.prepare(task(x_offset=0.095, height=0.03, parameters={"receiver_x": -0.03, "receiver_z": 0.03}))


def test_an_executed_motion_keeps_its_own_tilt_and_speed(simulator: PourSimulator) -> None:
    planned = simulator.prepare(task())
    times = np.arange(0.0, planned.duration, 0.01)
    read_back = SampledMotion(times, planned.sample(times))
    theta = SimulationParameters.from_values(OFF)
    placed = PourTask(task().scene, task().action, theta, 1, motion=read_back).placement
    assert placed == PoseError(x=0.004, y=-0.002, z=0.003)


def test_every_nuisance_declares_how_far_it_may_be_off() -> None:
    infos = SimulationParameters.nuisances()
    assert set(infos) == set(OFF)
    for name, info in infos.items():
        default = getattr(SimulationParameters(), name)
        assert info.lower <= default - 3 * info.tolerance, name
        assert default + 3 * info.tolerance <= info.upper, name
    assert not set(infos) & set(SimulationParameters().of_the_solver())
