"""The UR driver, its client library and a controller at the other end do what every arm has to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from actors.arm.path.plan import plan_path
from actors.arm.ur.driver import UrArm
from actors.contracts.arm import ArmBench, ArmContract
from actors.virtual_ur import VirtualController
from sim_engine.action import DEG

from .conftest import next_address
from .test_planned import ACTION, SPEC, motion, vessels


class TestUrArm(ArmContract):
    @pytest.fixture
    def bench(self) -> Iterator[ArmBench]:
        path = plan_path(motion(ACTION.with_values(angular_velocity=25 * DEG)), SPEC, *vessels())
        with VirtualController.start(
            next_address(), SPEC.model, SPEC.time_scale, 125.0, joints=SPEC.home
        ) as controller:
            arm = UrArm(replace(SPEC, address=controller.address))
            yield ArmBench(
                arm,
                path,
                SPEC.time_scale,
                jog=("z", 0.005, 0.05),
                trip=lambda: controller.fault("protective_stop"),
            )
            arm.close()
