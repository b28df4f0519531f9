"""`controller`: power, stops, unlocking, pausing, watchdogs: what a controller does when something is not as it
should be.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from actors.emulators.ur_controller.controller import RuntimeState
from actors.emulators.ur_controller.robot import BOOT_TIME, BRAKE_TIME, HOME, MODELS, POWER_ON_TIME, RobotMode
from actors.emulators.ur_controller.rtde_fields import write
from actors.emulators.ur_controller.safety_system import SafetyMode
from actors.emulators.ur_controller.servers.dashboard_server import DashboardServer
from tests.actors.emulators.ur_controller.conftest import Bench

TARGET = [HOME[0] + 2.0, *HOME[1:]]
LONG_MOVE = f"movej({TARGET}, a=1.4, v=1.0)\nset_standard_digital_out(7, True)"


@pytest.fixture
def moving(bench: Bench) -> Bench:
    """In the middle of a move at full speed."""
    bench.start(LONG_MOVE)
    bench.tick(1.2)
    assert bench.speeds[-1, 0] == pytest.approx(1.0, rel=1e-3)
    return bench


def ask(bench: Bench, line: str) -> str:
    return DashboardServer(bench.controller).answer(line)


def standstill_after(bench: Bench, seconds: float = 5.0) -> float:
    """Time from now until the arm stands [s]."""
    began = len(bench.joints)
    bench.tick(seconds)
    still = np.flatnonzero(np.abs(bench.speeds[began - 1 :, 0]) < 1e-9)
    return float(still[0] * bench.controller.dt)


@pytest.mark.parametrize(
    ("stop", "mode"),
    [
        (lambda b: b.controller.protective_stop("test"), SafetyMode.PROTECTIVE_STOP),
        (lambda b: b.controller.emergency_stop(), SafetyMode.ROBOT_EMERGENCY_STOP),
        (lambda b: b.controller.emergency_stop(system=True), SafetyMode.SYSTEM_EMERGENCY_STOP),
        (lambda b: b.controller.set_safeguard(True), SafetyMode.SAFEGUARD_STOP),
        (lambda b: b.controller.safety_fault(), SafetyMode.FAULT),
    ],
    ids=["protective", "emergency", "system emergency", "safeguard", "fault"],
)
def test_a_safety_stop_brakes_the_arm_within_a_tenth_of_a_second(
    moving: Bench, stop: Callable[[Bench], None], mode: SafetyMode
) -> None:
    stop(moving)
    assert 0.05 < standstill_after(moving) < 0.15
    assert moving.controller.safety.mode is mode
    assert moving.controller.signals.digital_out == 0


def test_a_protective_stop_can_not_be_unlocked_for_five_seconds(moving: Bench) -> None:
    moving.controller.protective_stop("test")
    moving.tick(4.9)
    assert ask(moving, "unlock protective stop").startswith("Cannot unlock protective stop until 5s after occurrence")
    assert ask(moving, "safetystatus") == "Safetystatus: PROTECTIVE_STOP"
    moving.tick(0.2)
    assert ask(moving, "unlock protective stop") == "Protective stop releasing"
    assert ask(moving, "safetystatus") == "Safetystatus: NORMAL"


def test_after_unlocking_nothing_moves_by_itself(moving: Bench) -> None:
    moving.controller.protective_stop("test")
    moving.tick(6.0)
    ask(moving, "unlock protective stop")
    where = moving.robot.mover.q
    moving.tick(5.0)
    assert moving.robot.mover.q == where
    assert moving.controller.runtime is RuntimeState.PAUSED
    assert ask(moving, "programState") == "PAUSED test"


def test_play_after_unlocking_goes_on_with_the_move_where_it_was(moving: Bench) -> None:
    moving.controller.protective_stop("test")
    moving.tick(1.0)
    assert ask(moving, "play") == "Failed to execute: play"
    moving.tick(5.0)
    ask(moving, "unlock protective stop")
    assert ask(moving, "play") == "Starting program"
    moving.tick(5.0)
    assert moving.robot.mover.q == pytest.approx(TARGET)
    assert moving.controller.signals.digital_out == 1 << 7
    assert np.abs(np.diff(moving.speeds[:, 0])).max() < 11.0 * moving.controller.dt


def test_the_first_upload_after_a_protective_stop_only_ends_the_paused_program(moving: Bench) -> None:
    moving.controller.protective_stop("test")
    moving.tick(6.0)
    ask(moving, "unlock protective stop")
    moving.start("sleep(1)")
    assert moving.controller.runtime is RuntimeState.STOPPING
    moving.tick(0.1)
    moving.start("sleep(1)")
    assert moving.controller.runtime is RuntimeState.PLAYING


def test_a_program_sent_during_a_protective_stop_is_not_run(moving: Bench) -> None:
    moving.controller.protective_stop("test")
    moving.tick(1.0)
    moving.start(f"movej({list(HOME)})")
    moving.tick(10.0)
    assert moving.said("key")[-1] == "program test not started: the robot is not ready"


def test_an_emergency_stop_ends_in_power_off_and_takes_both_commands_to_recover(moving: Bench) -> None:
    moving.controller.emergency_stop()
    moving.tick(0.5)
    assert ask(moving, "robotmode") == "Robotmode: POWER_OFF"
    assert ask(moving, "safetystatus") == "Safetystatus: ROBOT_EMERGENCY_STOP"
    assert moving.controller.runtime is RuntimeState.STOPPED
    assert ask(moving, "power on").startswith("Failed")
    moving.controller.release_emergency_stop()
    moving.tick(10.0)
    assert ask(moving, "robotmode") == "Robotmode: POWER_OFF"
    assert ask(moving, "power on") == "Powering on"
    moving.tick(BOOT_TIME + POWER_ON_TIME + 0.1)
    assert ask(moving, "robotmode") == "Robotmode: IDLE"
    assert ask(moving, "brake release") == "Brake releasing"
    moving.tick(BRAKE_TIME + 0.1)
    assert ask(moving, "robotmode") == "Robotmode: RUNNING"
    where = moving.robot.mover.q
    moving.tick(5.0)
    assert moving.robot.mover.q == where


def test_brake_release_alone_switches_on_too(bench: Bench) -> None:
    ask(bench, "power off")
    modes = []
    ask(bench, "brake release")
    for _ in range(100):
        bench.tick(0.1)
        modes.append(bench.controller.power.mode)
    assert list(dict.fromkeys(modes)) == [RobotMode.BOOTING, RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.RUNNING]


def test_a_robot_that_is_not_running_runs_no_program(bench: Bench) -> None:
    ask(bench, "power off")
    assert bench.run(f"movej({TARGET})") == 0.0
    assert bench.robot.mover.q == HOME


def test_the_program_goes_on_by_itself_when_the_safeguard_is_released(moving: Bench) -> None:
    moving.controller.set_safeguard(True)
    moving.tick(3.0)
    assert moving.controller.runtime is RuntimeState.PAUSED
    moving.controller.set_safeguard(False)
    moving.tick(5.0)
    assert moving.robot.mover.q == pytest.approx(TARGET)


def test_a_fault_of_the_safety_system_needs_a_restart(moving: Bench) -> None:
    moving.controller.safety_fault()
    moving.tick(1.0)
    assert ask(moving, "safetystatus") == "Safetystatus: FAULT"
    assert ask(moving, "power on").startswith("Failed")
    assert ask(moving, "restart safety") == "Restarting safety"
    assert (ask(moving, "safetystatus"), ask(moving, "robotmode")) == ("Safetystatus: NORMAL", "Robotmode: POWER_OFF")


def test_pause_and_play(moving: Bench) -> None:
    assert ask(moving, "pause") == "Pausing program"
    moving.tick(2.0)
    where = moving.robot.mover.q
    moving.tick(2.0)
    assert moving.robot.mover.q == where
    assert ask(moving, "running") == "Program running: false"
    assert ask(moving, "play") == "Starting program"
    moving.tick(5.0)
    assert moving.robot.mover.q == pytest.approx(TARGET)


def test_stopping_the_program_stops_the_arm_softly(moving: Bench) -> None:
    assert ask(moving, "stop") == "Stopped"
    assert moving.controller.runtime is RuntimeState.STOPPING
    assert standstill_after(moving) == pytest.approx(1.0 / 5.0, abs=0.01)
    assert moving.controller.runtime is RuntimeState.STOPPED


def test_a_new_program_replaces_the_one_that_runs_without_a_jump(moving: Bench) -> None:
    moving.start(f"movej({list(HOME)}, a=1.4, v=1.0)")
    moving.tick(6.0)
    assert moving.robot.mover.q == pytest.approx(HOME)
    assert np.abs(np.diff(moving.speeds[:, 0])).max() <= 5.0 * moving.controller.dt + 1e-9


@pytest.mark.parametrize(("action", "state"), [("stop", RuntimeState.STOPPED), ("pause", RuntimeState.PAUSED)])
def test_a_watchdog_acts_when_its_input_is_not_written_often_enough(
    bench: Bench, action: str, state: RuntimeState
) -> None:
    bench.start(f'rtde_set_watchdog("input_int_register_0", 5, "{action}")\n{LONG_MOVE}')
    for _ in range(10):
        bench.tick(0.1)
        write(bench.controller, {"input_int_register_0": 0})
    assert bench.controller.playing
    bench.tick(0.18)
    assert bench.controller.playing
    bench.tick(0.3)
    assert bench.controller.runtime is state
    assert np.abs(bench.speeds[-1]).max() == 0.0


def test_a_watchdog_goes_by_wall_time_however_time_is_scaled() -> None:
    bench = Bench(time_scale=10.0)
    bench.start('rtde_set_watchdog("input_int_register_0", 5, "stop")\nsleep(100)')
    bench.tick(1.9)
    assert bench.controller.playing
    bench.tick(0.2)
    assert not bench.controller.playing


def test_tcp_and_payload_are_what_was_set_until_the_controller_is_rebooted(bench: Bench) -> None:
    bench.run("set_tcp(p[0, 0.01, 0.15, 0, 0, 0.5])\nset_payload(1.25, [0, 0, 0.05])")
    bench.run("popup(get_tcp_offset())")
    assert bench.said("popup") == ["p[0, 0.01, 0.15, 0, 0, 0.5]"]
    assert (bench.robot.payload, bench.robot.cog) == (1.25, (0.0, 0.0, 0.05))
    bench.controller.reboot()
    assert bench.robot.tcp == (0.0,) * 6
    assert bench.robot.payload == 0.0
    assert bench.controller.power.mode is RobotMode.POWER_OFF


@pytest.mark.parametrize("mass", ["13", "-1", '"heavy"'])
def test_an_impossible_payload_ends_the_program(bench: Bench, mass: str) -> None:
    bench.run(f"set_payload({mass})")
    assert len(bench.said("exception")) == 1


def test_the_checksum_changes_with_any_limit(bench: Bench) -> None:
    from actors.emulators.ur_controller.control_clock import Host
    from actors.emulators.ur_controller.fault_injection import ControllerFaults

    faults = ControllerFaults(Host(bench.controller, "127.0.0.1"))
    seen = {bench.controller.safety.checksum}
    for limits in (
        {"tool_speed": 1.4},
        {"joint_speeds": [1, 1, 1, 1, 1, 1]},
        {"joint_ranges": [[-3, 3]] * 6},
        {"planes": [{"normal": [0, 0, 1], "offset": 0.1}]},
    ):
        seen.add(faults.call({"fault": "limits", **limits})["checksum"])
    assert len(seen) == 5
    assert faults.call({"fault": "limits"})["checksum"] in seen


@pytest.mark.parametrize(
    "request_",
    [
        None,
        [],
        {},
        {"fault": "nosuch"},
        {"fault": 1},
        {"fault": "slider"},
        {"fault": "slider", "fraction": "fast"},
        {"fault": "slider", "fraction": float("nan")},
        {"fault": "protective_stop", "joint": 9, "above": 0},
        {"fault": "protective_stop", "joint": 1},
        {"fault": "protective_stop", "sometime": 1},
        {"fault": "limits", "joint_ranges": [[0, 1]]},
        {"fault": "limits", "planes": [{"normal": [0, 0, 0], "offset": 1}]},
        {"fault": "inputs", "digital": {"99": True}},
        {"fault": "inputs", "analog": [1, 2, 3]},
        {"fault": "history", "since": "yesterday"},
        {"fault": "checksum", "value": "pizza"},
        {"fault": "power", "mode": "more"},
    ],
)
def test_a_fault_that_makes_no_sense_is_refused_with_a_word_why(bench: Bench, request_: object) -> None:
    from actors.emulators.ur_controller.control_clock import Host
    from actors.emulators.ur_controller.fault_injection import ControllerFaults, FaultError

    with pytest.raises(FaultError, match=r".+"):
        ControllerFaults(Host(bench.controller, "127.0.0.1")).call(request_)
    bench.run(f"movej({TARGET})")
    assert bench.robot.mover.q == pytest.approx(TARGET)


def test_a_cb3_controller_knows_no_remote_control(bench: Bench) -> None:
    old = Bench(model=MODELS["ur10"], remote=False)
    assert not old.controller.local
    assert old.controller.frequency == 125
    bench.controller.set_remote(False)
    assert bench.controller.local


def test_the_arm_is_steady_only_a_moment_after_it_stands(bench: Bench) -> None:
    bench.run(f"movej({TARGET})")
    assert not bench.robot.steady
    bench.tick(0.3)
    assert bench.robot.steady


def test_executed_positions_are_remembered(bench: Bench) -> None:
    bench.run(f"movej({TARGET})")
    times = np.array([t for t, _ in bench.robot.history])
    joints = np.array([q[0] for _, q in bench.robot.history])
    assert np.diff(times) == pytest.approx(0.008)
    assert joints[-1] == pytest.approx(TARGET[0], abs=0.01)
    assert np.all(np.diff(joints) >= 0)
