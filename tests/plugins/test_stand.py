"""The example's arm does what every arm has to do."""

from __future__ import annotations

import pytest

from actors.contracts.arm import ArmBench, ArmContract
from actors.protocols import InvalidActionError
from sim_engine.action import DEG, Action
from sim_engine.liquid import Liquid
from sim_engine.task import Scene
from sim_engine.vessel.spec import cylinder
from tests.plugins.decant_example.arm import Stand, StandSpec

SCENE = Scene(
    name="tumbler",
    pourer=cylinder("beaker", inner_radius=0.035, inner_height=0.1),
    receiver=cylinder("tumbler", inner_radius=0.04, inner_height=0.1),
    liquid=Liquid(mass=0.2),
)
ACTION = Action(angular_velocity=60 * DEG, x_offset=0.09, height=0.05, max_angle=100 * DEG, hold_time=0.5)


class TestStand(ArmContract):
    @pytest.fixture
    def bench(self):
        spec = StandSpec(time_scale=2.0)
        arm = Stand(spec)
        yield ArmBench(arm, spec.plan(SCENE, ACTION), 2.0, jog=("z", 0.005, 0.05))
        arm.close()


def test_a_pour_too_fast_for_the_motor_is_refused_with_the_key_that_allows_it():
    with pytest.raises(InvalidActionError, match=r"30 deg/s \(arm.fastest\), 90 deg/s are asked for"):
        StandSpec(fastest=30 * DEG).plan(SCENE, ACTION)
