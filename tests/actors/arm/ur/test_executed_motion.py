"""`executed_motion`: pours as the planner makes them, executed: what comes back can be simulated in place of what
was planned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from actors.arm.arm_interface import ArmStoppedError
from actors.arm.planning.kinematics import pourer_motion
from actors.arm.planning.motion_segments import leans
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur.ur_driver import UrArm
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import ArmLimits, Box, JointAngles, Point, Pose, RobotCell
from actors.emulators.ur_controller import VirtualController
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.motion import PourMotion, plan_motion
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import Vessel, build_vessel
from tests.actors.arm.ur.conftest import Call, Rig
from tests.support.loopback import free_address

SPEC = UrArmSettings(
    model="ur10e",
    limits=ArmLimits(
        box=Box(low=Point.of(0.2, -0.7, 0.0), high=Point.of(1.1, 0.5, 1.0)),
        joint_speed=170 * DEG,
        tilt_speed=155 * DEG,
        clearance=3e-3,
    ),
    cell=RobotCell(receiver=Point.of(0.75, 0.0, 0.06), direction=90 * DEG),
    home=JointAngles.of(-14 * DEG, -91 * DEG, -115 * DEG, -154 * DEG, -104 * DEG, 0.0),
    tool=Pose(z=0.17),
    grip=Pose(y=-0.06, rx=-90 * DEG),
    payload=0.9,
    warning_time=0.0,
    time_scale=5.0,
)
ACTION = Action(
    angular_velocity=60 * DEG,
    x_offset=0.098,
    height=0.1,
    max_angle=100 * DEG,
    angular_acceleration=600 * DEG,
    hold_time=0.5,
    return_velocity=90 * DEG,
)


@cache
def vessels() -> tuple[Vessel, Vessel]:
    cup = cylinder("cup", inner_radius=0.040, inner_height=0.100)
    return build_vessel(cup), build_vessel(cylinder("receiver", inner_radius=0.045, inner_height=0.090))


def motion(action: Action) -> PourMotion:
    pourer, receiver = vessels()
    return plan_motion(Scene("s", pourer.spec, receiver.spec, Liquid(mass=0.2)), action, pourer, receiver)


@pytest.fixture
def planned() -> Callable[..., Rig]:
    made: list[Rig] = []

    def make(action: Action) -> Rig:
        path = plan_path(motion(action), SPEC, *vessels())
        controller = VirtualController.start(free_address(), "ur10e", SPEC.time_scale, 125.0, joints=SPEC.home.angles)
        made.append(Rig(controller, UrArm(SPEC.with_values(address=controller.address)), path))
        made[-1].arm.connect()
        return made[-1]

    yield make
    for rig in made:
        rig.arm.close()
        rig.controller.close()


@pytest.mark.realtime
def test_what_was_executed_is_the_planned_pour_seen_through_the_encoders(planned: Callable[..., Rig]) -> None:
    rig = planned(ACTION)
    rig.to_start()
    executed = rig.arm.execute(rig.path)
    rig.arm.retreat(rig.path)
    assert rig.joints == pytest.approx(SPEC.home.angles, abs=1e-3)
    poured = pourer_motion(executed.joints, executed.times, SPEC)
    asked = pourer_motion(rig.path.pour.joints, rig.path.pour.times, SPEC)
    late = asked.sample(executed.times - executed.tracking["lag"])
    apart = np.linalg.norm(poured.poses[:, :3] - late[:, :3], axis=1)
    assert len(apart) > 20
    assert apart.max() < 2e-3
    assert executed.tracking["max_angle"] < 0.5 * DEG


@pytest.mark.slow
@pytest.mark.realtime
def test_a_pour_without_a_return_is_brought_upright_on_the_way_home_even_after_a_stop(
    planned: Callable[..., Rig],
) -> None:
    rig = planned(replace(ACTION, return_velocity=None))
    rig.to_start()
    rig.arm.execute(rig.path)
    tilt = float(leans(rig.joints[None], SPEC)[0])
    assert tilt > 90 * DEG
    assert rig.arm.state().tilt == pytest.approx(tilt, abs=1 * DEG)
    retreating = Call(rig.arm.retreat, rig.path)
    rig.await_that(lambda: float(leans(rig.joints[None], SPEC)[0]) < tilt - 10 * DEG, "some un-tilting")
    rig.arm.stop()
    with pytest.raises(ArmStoppedError) as caught:
        retreating.result()
    assert caught.value.phase == "retreat"
    assert caught.value.tilt == pytest.approx(float(leans(rig.joints[None], SPEC)[0]), abs=1 * DEG)
    began = rig.now
    rig.arm.release()
    rig.arm.retreat(rig.path)
    tilts = leans(rig.history(began)[1], SPEC)
    assert tilts.max() < caught.value.tilt + 1 * DEG
    assert rig.joints == pytest.approx(SPEC.home.angles, abs=1e-3)
