"""`robot_comparison`: what a robot reports about itself is compared with its settings, and its calibration is
planned with.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from actors.arm.arm_interface import ArmRefusedError
from actors.arm.planning.kinematics import pourer_motion
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur.primary_interface import RobotState, robot_state, split
from actors.arm.ur.robot_comparison import robot_checks, robot_problems
from actors.arm.ur.robot_models import MODELS, model_named, same_robot
from actors.arm.ur.ur_driver import UrArm
from actors.arm.ur_settings import UrArmSettings
from actors.emulators.ur_controller import VirtualController
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.robot import MODELS as CONTROLLED
from actors.emulators.ur_controller.robot import calibrated
from actors.emulators.ur_controller.servers.connections import Connections
from actors.emulators.ur_controller.servers.primary_server import PrimaryServer
from sim_engine.collision import rotations
from tests.support.loopback import free_address
from tests.support.planning_cell import cell_of, motion, turned, vessel


def first_state(model: str) -> RobotState:
    """The first state of a calibrated robot of a model."""
    controller = Controller(calibrated(CONTROLLED[model]))
    controller.robot.set_tcp((0.01, -0.02, 0.17, 0.1, 0.2, -0.3))
    packages, _ = split(PrimaryServer(controller, Connections(controller)).first())
    (body,) = (body for kind, body in packages if kind == 16)
    return robot_state(dict(split(body)[0]))


def compared(state: RobotState, model: str = "ur10e", **changes: Any) -> list[str]:
    software, name = CONTROLLED[model].version, CONTROLLED[model].name
    return robot_problems(cell_of(model, **changes), name, software, state, rests=True)


@pytest.mark.parametrize("model", MODELS)
def test_every_model_tells_its_type_limits_and_calibration(model: str) -> None:
    state, nominal = first_state(model), MODELS[model]
    assert state.kind == nominal.kind
    assert state.joint_speeds == pytest.approx(nominal.joint_speed)
    assert state.joint_accelerations == (40.0,) * 6
    assert state.lengths == pytest.approx((*nominal.a, *nominal.d))
    own = calibrated(CONTROLLED[model]).calibration
    assert own is not None
    assert state.calibration == replace(own, checksum=state.calibration.checksum if state.calibration else "")
    assert cell_of(model).expected(virtual=True).calibration == own  # with which pours are checked before
    assert compared(state, model) == []


def test_a_robot_with_nearly_parallel_axes_is_calibrated_by_hundreds_of_metres() -> None:
    own = first_state("ur10e").calibration
    assert own is not None
    assert own.d[1] > 400.0
    assert own.d[2] < -400.0


def test_a_simulator_is_nominal() -> None:
    controller = Controller(CONTROLLED["ur5e"])
    packages, _ = split(PrimaryServer(controller, Connections(controller)).first())
    (body,) = (body for kind, body in packages if kind == 16)
    assert robot_state(dict(split(body)[0])).calibration is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"kind": 7}, r"is a UR10E of type 7 .* set up as UR10E, type 2: is this the right controller"),
        ({"lengths": (0.0, -0.7, *first_state("ur10e").lengths[2:])}, r"a link that differs by 87.3 mm from a UR10E's"),
        (
            {"joint_speeds": (2.0, 2.0, 2.0, 3.2, 3.2, 3.2)},
            r"limits joint 1 \(base\) to 115 deg/s; the file allows 120",
        ),
        ({"joint_accelerations": (40.0, 5.0, 40.0, 40.0, 40.0, 40.0)}, r"limits a joint to 286 deg/s².*lower 'appr"),
        ({"joint_ranges": ((-0.1, 0.1),) * 6}, r"does not allow joint 1 \(base\) of 'home': correct 'home'"),
        ({"calibration": None}, r"tool [2-9].* mm and 0\.\d+ deg from where .* switch the controller off and on"),
    ],
)
def test_a_difference_is_one_error_with_its_cure(changes: dict[str, Any], said: str) -> None:
    (problem,) = compared(replace(first_state("ur10e"), **changes))
    assert re.search(said, problem), problem


def test_a_moving_arm_is_not_compared_with_where_it_was() -> None:
    state = replace(first_state("ur10e"), calibration=None)
    checks = robot_checks(cell_of("ur10e"), "UR10", (5, 12, 6), state, rests=False)
    assert [check.name for check in checks if check.state == "fail"] == []


def test_controllers_name_models_without_the_series() -> None:
    assert model_named("UR10", (3, 15)) == "ur10"
    assert model_named("UR10", (5, 12)) == "ur10e"
    assert model_named("UR5e", (5, 12)) == "ur5e"
    assert model_named("UR20", (5, 17)) == "ur20"
    assert model_named("UR8L", (5, 17)) == "ur8long"
    assert model_named("UR4", (5, 17)) == "ur4"
    assert same_robot("ur5e", "ur7e")
    assert not same_robot("ur5e", "ur5")


# ---- planning


def off(spec: UrArmSettings, true: UrArmSettings) -> tuple[float, float]:
    """Largest distance and angle of a pour from what was asked for, on the true robot [m], [deg]."""
    made = motion()
    path = plan_path(made, spec, vessel("beaker"), vessel("tumbler"))
    poses = pourer_motion(path.pour.joints, path.pour.times, true).poses
    wanted = made.sample(path.pour.times)
    away = np.linalg.norm(poses[:, :3] - wanted[:, :3], axis=-1)
    return float(away.max()), math.degrees(turned(rotations(poses), rotations(wanted)).max())


@pytest.mark.parametrize("model", ["ur3e", "ur10", "ur10e", "ur20"])
def test_pours_go_where_they_are_planned_only_with_the_calibration(model: str) -> None:
    spec = cell_of(model)
    true = spec.with_values(calibration=first_state(model).calibration)
    away, angle = off(true, true)
    assert away < 1e-7
    assert angle < 1e-4
    away, angle = off(spec, true)
    assert away > 1e-3
    assert angle > 0.3


def test_clearances_of_a_calibrated_robot_include_what_remains() -> None:
    spec = cell_of("ur10e")
    true = spec.with_values(calibration=first_state("ur10e").calibration)
    nominal, own = (plan_path(motion(), s, vessel("beaker"), vessel("tumbler")).report.clearance for s in (spec, true))
    assert 0.5e-3 < nominal - own < 1.5e-3


@pytest.fixture(scope="module")
def robot() -> Iterator[VirtualController]:
    spec = cell_of("ur10e")
    with VirtualController.start(
        free_address(), "ur10e", 10.0, 125.0, calibrated=True, joints=spec.home.angles
    ) as controller:
        yield controller


def test_a_driver_refuses_a_pour_that_was_planned_for_another_robot(robot: VirtualController) -> None:
    spec = cell_of("ur10e", address=robot.address, time_scale=10.0, warning_time=0.0)
    arm = UrArm(spec)
    try:
        facts = arm.connect()
        assert len(facts.calibration) == 8
        path = plan_path(motion(), spec, vessel("beaker"), vessel("tumbler"))
        arm.release()
        with pytest.raises(ArmRefusedError, match=f"nominal lengths, this one has calibration {facts.calibration}"):
            arm.move_to_start(path)
        fitted = spec.fitted_to(facts)
        arm.release()
        arm.move_to_start(plan_path(motion(), fitted, vessel("beaker"), vessel("tumbler")))
        assert arm.facts().calibration == facts.calibration
    finally:
        arm.close()
