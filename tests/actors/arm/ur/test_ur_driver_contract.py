"""`ur_driver`: the UR driver, its client library and a controller at the other end do what every arm has to do."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmLostError
from actors.arm.planned_pour import ExecutedPath, PourPath
from actors.arm.planning.kinematics import pourer_motion
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur.ur_driver import UrArm
from actors.contract_tests.arm_contract import ArmBench, ArmContract
from actors.emulators.ur_controller import VirtualController
from actors.emulators.ur_controller.robot import MODELS, calibrated
from actors.runtime.bench_clock import SharedClock
from sim_engine.action import DEG
from tests.actors.arm.ur.test_executed_motion import ACTION, motion, vessels
from tests.support.loopback import free_address
from tests.support.planning_cell import cell_of


def bench_of(cls: type[UrArm], model: str = "ur10e", *, polyscope_x: bool = False) -> Iterator[ArmBench]:
    """An arm and its controller, whose true joints are the witness. The robot is calibrated, as a real one is. The
    clock waits for its driver, as on a virtual bench.
    """
    true = cell_of(model, warning_time=0.0, time_scale=5.0, calibration=calibrated(MODELS[model]).calibration)
    options = {"calibrated": True, "polyscope_x": polyscope_x, "joints": true.home.angles}
    with contextlib.ExitStack() as stack:
        clock = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "clock"
        SharedClock.create(clock)
        options["clock"] = str(clock)
        controller = VirtualController.start(free_address(), true.model, true.time_scale, 125.0, **options)
        stack.enter_context(controller)

        def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            kept = controller.fault("history", since=max(since + 1e-6, 0.0))
            times, joints = np.array(kept["times"]), np.array(kept["joints"]).reshape(-1, 6)
            if len(times) < 2:
                return np.zeros(0), np.zeros((0, 7))
            return times, pourer_motion(joints, times, true).poses

        arm = cls(true.with_values(address=controller.address, calibration=None, clock=str(clock)))
        spec = true.fitted_to(arm.connect())
        path = plan_path(motion(ACTION.with_values(angular_velocity=25 * DEG)), spec, *vessels())
        yield ArmBench(
            arm,
            path,
            spec.time_scale,
            jog=("z", 0.005, 0.05),
            trip=lambda: controller.fault("protective_stop"),
            true_poses=true_poses,
            tool_speed=true.limits.tool_speed,
            tilt_speed=true.limits.tilt_speed,
            disturb=lambda: controller.fault("lag", seconds=0.8),
            cut=lambda: controller.fault("refuse"),
            restore=lambda: controller.fault("clear"),
            lost_within=60.0,
        )
        arm.close()


@pytest.mark.slow
class TestUrArm(ArmContract):
    @pytest.fixture(params=MODELS)
    def bench(self, request: pytest.FixtureRequest) -> Iterator[ArmBench]:
        yield from bench_of(UrArm, request.param)


@pytest.mark.slow
class TestUrArmWithPolyscopeX(ArmContract):
    @pytest.fixture
    def bench(self) -> Iterator[ArmBench]:
        yield from bench_of(UrArm, "ur20", polyscope_x=True)


class ReportsThePlan(UrArm):
    """Reports the poses that it was commanded."""

    def execute(self, path: PourPath) -> ExecutedPath:
        done = super().execute(path)
        planned = pourer_motion(path.pour.at(done.times), done.times, self._spec).poses
        return replace(done, poses=planned)


class WaitsForTheController(UrArm):
    """Tries again until the controller answers, or its test is over."""

    closed = False

    def close(self) -> None:
        self.closed = True
        super().close()

    def execute(self, path: PourPath) -> ExecutedPath:
        while True:
            try:
                return super().execute(path)
            except ArmLostError:
                if self.closed:
                    raise
                time.sleep(0.1)
                self.release()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cls", "found_by", "message"),
    [
        (ReportsThePlan, "test_the_poses_it_reports_are_measured", "report measured poses, not commanded"),
        (
            WaitsForTheController,
            "test_a_connection_lost_during_a_pour_is_an_error_and_the_arm_stands",
            "still waits 3 s after the connection was cut",
        ),
    ],
)
def test_a_driver_that_does_not_do_what_it_reports_is_found(cls: type[UrArm], found_by: str, message: str) -> None:
    with contextlib.contextmanager(bench_of)(cls) as bench, pytest.raises(AssertionError, match=message):
        getattr(ArmContract(), found_by)(replace(bench, lost_within=3.0))
