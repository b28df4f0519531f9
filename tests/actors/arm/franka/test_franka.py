"""`franka`: the driver of a Franka against franky-sim, a robot and a client library that others wrote.

It needs the extra 'franka-sim', which is not in the tests' lock.
"""

from __future__ import annotations

import dataclasses
import math
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

pytest.importorskip("pinocchio")
pytest.importorskip("franky")
pytest.importorskip("franky_sim")

import franky

from actors.arm.arm_interface import ArmLostError, ArmRefusedError
from actors.arm.franka.franka_arm import FrankaRobot, FrankaSettings
from actors.arm.joint_driver import VelocityArm, speeds_along
from actors.arm.planned_pour import PourPath
from actors.arm.planning.motion_segments import leans
from actors.arm_geometry import RobotCell
from actors.contract_tests.arm_contract import ArmBench, ArmContract
from actors.contract_tests.contract_calls import Call
from actors.device_kinds import FrankaKind
from actors.emulators.franka.franka_emulator import FrankaEmulator
from actors.runtime.bench_clock import SharedClock
from actors.runtime.child_process import child_environment
from sim_engine.action import DEG
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from tests.support.planning_cell import ACTION, vessel
from tests.support.waiting import PATIENCE

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

LABORATORY = yaml.safe_load(Path("configs/laboratories/franka.yaml").read_text(encoding="utf-8"))
CELL = RobotCell.model_validate(LABORATORY["cell"])
SETTINGS = FrankaSettings.model_validate(
    {**LABORATORY["arm"], "cell": CELL, "warning_time": "0.2 s", "approach_speed": "90 deg/s"}
).in_laboratory(CELL, 1.0)
SCENE = Scene("s", vessel("beaker").spec, vessel("tumbler").spec, Liquid(name="water", mass=0.2))


def planned(speed: float) -> PourPath:
    """A pour at this speed [rad/s]."""
    action = dataclasses.replace(ACTION, height=0.11, angular_velocity=speed, return_velocity=speed)
    return FrankaKind(SETTINGS).plan(SCENE, action)


@pytest.fixture(scope="module")
def path() -> PourPath:
    return planned(60.0 * DEG)


@pytest.fixture
def emulator() -> Iterator[FrankaEmulator]:
    emulator = FrankaEmulator(SETTINGS)
    yield emulator
    emulator.close()


@pytest.fixture
def arm(emulator: FrankaEmulator) -> Iterator[VelocityArm]:
    arm = VelocityArm(emulator.arm, FrankaRobot)
    yield arm
    arm.close()


def tilts(emulator: FrankaEmulator, since: float = -math.inf) -> NDArray[np.float64]:
    """Tilts of the pourer that the simulator had [rad]."""
    joints = emulator.history(since).joints
    return leans(np.array(joints), SETTINGS) if joints else np.zeros(0)


def until(condition: Callable[[], bool], otherwise: str) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, otherwise
        time.sleep(0.02)


class TestFranka(ArmContract):
    @pytest.fixture
    def bench(self, path: PourPath, emulator: FrankaEmulator, arm: VelocityArm) -> ArmBench:
        kind = FrankaKind(SETTINGS)

        def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            history = emulator.history(since)
            joints = np.array(history.joints).reshape(-1, 7)
            return np.array(history.times), kind.figure().pourer(joints) if len(joints) else np.zeros((0, 7))

        return ArmBench(
            arm,
            path,
            jog=("joint 6", math.radians(2.0), math.radians(20.0)),
            trip=lambda: emulator.fault("trip", {}),
            true_poses=true_poses,
            tool_speed=2.0,
            tilt_speed=math.radians(180.0),
            cut=lambda: emulator.fault("unplug", {}),
            restore=lambda: emulator.fault("plug", {}),
            lost_within=PATIENCE,
            stops_within=PATIENCE,
        )


@pytest.mark.parametrize("speed", [20.0, 60.0, 120.0])
def test_the_executed_tilt_is_the_planned_one(speed: float, arm: VelocityArm) -> None:
    path = planned(speed * DEG)
    arm.connect()
    arm.release()
    arm.move_to_start(path)
    executed = arm.execute(path)
    tilt = leans(executed.joints, SETTINGS)
    lags = np.linspace(-0.02, 0.02, 41)
    errors = [
        np.sqrt(np.mean((np.interp(executed.times - lag, path.pour.times, path.tilts) - tilt) ** 2)) for lag in lags
    ]
    assert min(errors) < 0.3 * DEG


DRIVER = """
import pickle, sys
from actors.arm.franka.franka_arm import FrankaRobot
from actors.arm.joint_driver import VelocityArm
spec, path = pickle.load(sys.stdin.buffer)
arm = VelocityArm(spec, FrankaRobot)
arm.connect()
arm.release()
arm.move_to_start(path)
print("pours", flush=True)
arm.execute(path)
"""


def test_a_program_that_is_killed_leaves_an_upright_cup(path: PourPath, emulator: FrankaEmulator) -> None:
    import pickle

    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=child_environment()
    )
    try:
        assert driver.stdin is not None
        assert driver.stdout is not None
        driver.stdin.write(pickle.dumps((emulator.arm, path)))
        driver.stdin.close()
        assert driver.stdout.readline() == b"pours\n"
        until(lambda: bool(tilts(emulator)[-1] > 60.0 * DEG), "it does not pour")
        killed = emulator.history(math.inf).now
    finally:
        driver.kill()
        driver.wait()
    until(lambda: bool(tilts(emulator)[-1] < 1.0 * DEG), "the cup stays tilted")
    seen = emulator.history(killed)
    late = np.array(seen.times)[leans(np.array(seen.joints), SETTINGS) > 1.0 * DEG].max() - killed
    assert late < 1.0  # of the robot's clock, which waits for its client


def test_a_driver_that_is_silent_has_its_cup_brought_upright(path: PourPath, emulator: FrankaEmulator) -> None:
    robot = FrankaRobot(emulator.arm)
    robot.connect()
    robot.pours(path)
    ways = [path.approach, path.pour]
    for way in ways:
        begun = before = robot.read().time
        while (reading := robot.read()).time < begun + min(way.duration, path.approach.duration + 0.2):
            now = reading.time - begun
            robot.turn(speeds_along(way, now, reading.time - before, reading.joints), 0.15)
            before = reading.time
            time.sleep(0.01)
    assert tilts(emulator)[-1] > 20.0 * DEG
    until(lambda: bool(tilts(emulator)[-1] < 1.0 * DEG), "the cup stays tilted")
    reading = robot.read()
    assert (reading.kind, reading.problem) == ("watchdog", "the driver was silent, and the cup was brought upright")
    robot.close()


def test_a_simulator_that_is_killed_is_an_error(path: PourPath, emulator: FrankaEmulator, arm: VelocityArm) -> None:
    arm.connect()
    arm.release()
    arm.move_to_start(path)
    pouring = Call(arm.execute, path)
    until(lambda: arm.state().tilt > 20.0 * DEG, "it does not pour")
    emulator.fault("kill", {})
    error = pouring.ended()
    assert isinstance(error, ArmLostError)


def test_a_reflex_is_recovered_from_by_a_persons_word_only(
    path: PourPath, emulator: FrankaEmulator, arm: VelocityArm
) -> None:
    arm.connect()
    emulator.fault("trip", {})
    assert "a reflex has stopped it" in arm.connect().problem
    arm.release()
    with pytest.raises(ArmRefusedError, match=r"a reflex has stopped it .*: look for what it touched"):
        arm.move_to_start(path)
    assert "a reflex" in arm.facts().problem
    arm.release()
    assert arm.recover() == "recovered from its errors"
    assert arm.facts().problem == ""


PATIENT_ROBOT = """
from actors.emulators.franka import franka_process
franka_process.SILENCE = 240.0
franka_process.main()
"""


def test_a_client_is_not_lost_while_the_clock_of_the_bench_or_the_simulator_stands(tmp_path: Path) -> None:
    """The liquid is computed for seconds, or a busy host gives the simulator no time; libfranka waits for a second."""
    SharedClock.create(tmp_path / "clock")
    clock, address = SharedClock(tmp_path / "clock"), f"127.77.{random.randint(0, 254)}.{random.randint(1, 254)}"
    joints = "--joints=" + ",".join(map(repr, SETTINGS.home_joints))
    command = [sys.executable, "-c", PATIENT_ROBOT, "--address", address, "--clock", str(tmp_path / "clock"), joints]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=child_environment()) as process:
        assert process.stdout is not None
        assert b"ready" in process.stdout.readline()
        robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
        robot.move(franky.JointVelocityMotion([0.0] * 6 + [0.02]), asynchronous=True)
        until(lambda: float(robot.state.dq[6]) > 0.01, "it does not move")
        clock.promise("liquid", 0.0)
        stood = robot.state.time.to_sec()
        time.sleep(3.0)  # three times libfranka's limit
        assert robot.state.time.to_sec() < stood + 0.1
        clock.withdraw("liquid")
        until(lambda: robot.state.time.to_sec() > stood + 0.2, "it does not go on")
        process.send_signal(signal.SIGSTOP)
        time.sleep(3.0)  # likewise
        process.send_signal(signal.SIGCONT)
        until(lambda: robot.state.time.to_sec() > stood + 0.4, "it does not go on after the simulator stood")
        assert robot.is_in_control
        robot.stop()
        process.stdin.close()  # type: ignore[union-attr]


# ---- what does not fit


def test_nobody_at_the_address(emulator: FrankaEmulator) -> None:
    arm = VelocityArm(emulator.arm.with_values(address="127.255.255.1"), FrankaRobot)
    with pytest.raises(
        ArmLostError, match=r"robot at 127\.255\.255\.1 .*: check that FCI is active in Desk, .* in control\."
    ):
        arm.connect()
    arm.close()


def test_another_client_in_control(emulator: FrankaEmulator, arm: VelocityArm, monkeypatch: pytest.MonkeyPatch) -> None:
    arm.connect()
    monkeypatch.setattr("actors.arm.franka.franka_arm.OPEN_TIME", 0.5)
    second = VelocityArm(emulator.arm, FrankaRobot)
    with pytest.raises(ArmLostError, match=r"check that no other client is in control\. The"):
        second.connect()
    second.close()
    assert arm.facts().problem == ""


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"model": "panda"}, "is a 'fr3'; arm.model is 'panda'"),
        ({"tool": {"z": "150 mm", "rz": "-45 deg"}}, "the end effector in Desk differs from 'tool' by 47 mm and 0 deg"),
        ({"tool": {"z": "103.4 mm"}}, "differs from 'tool' by 0 mm and 45 deg"),
        ({"payload": "0.5 kg"}, "the end effector in Desk has 0.73 kg, more than 'payload'"),
    ],
)
def test_a_robot_that_is_not_the_one_of_the_file(
    changes: dict[str, object], text: str, emulator: FrankaEmulator
) -> None:
    changed = FrankaSettings.model_validate({**LABORATORY["arm"], **changes, "cell": CELL})
    spec = emulator.arm.with_values(**{name: getattr(changed, name) for name in changes})
    arm = VelocityArm(spec, FrankaRobot)
    with pytest.raises(ArmRefusedError, match=text):
        arm.connect()
    arm.close()
