"""`fault_injection`: what the unmodified client library sees when things go wrong: the traps that a driver has to
live with.
"""

from __future__ import annotations

import socket
import struct
import time
from base64 import b64decode
from collections.abc import Callable

import pytest

from actors.emulators.ur_controller import VirtualController, VirtualControllerError
from actors.emulators.ur_controller.control_clock import Host
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.fault_injection import ControllerFaults
from actors.emulators.ur_controller.robot import MODELS
from tests.actors.emulators.ur_controller.conftest import Client, observe
from tests.support.waiting import wait_for

pytestmark = pytest.mark.ur_rtde

Start = Callable[..., VirtualController]


def moving(controller: VirtualController, seconds: float, **arguments: float) -> Client:
    """A client in the middle of an asynchronous move, going to watch for so many seconds."""
    client = Client("during", controller.address, seconds=seconds, **arguments)
    client.wait_for("ready")
    return client


def listener_while_moving(controller: VirtualController, **arguments: float) -> Client:
    """A client that only listens, while a program that came over a socket moves the arm."""
    client = Client("listening", controller.address, **arguments)
    client.wait_for("ready")
    with socket.create_connection((controller.address, 30003), timeout=5) as connection:
        connection.sendall(b"movej([2.5, -1.57, 1.57, -1.57, -1.57, 0], a=1, v=0.5)\n")
        while controller.fault("state")["speeds"][0] < 0.4:
            time.sleep(0.01)
    return client


def arrives(controller: VirtualController) -> bool:
    """Whether the arm comes to the end of that move."""
    return wait_for(lambda: abs(controller.fault("state")["joints"][0] - 2.5) < 1e-9, "end of the move")


def is_open(address: str, port: int) -> bool:
    """Whether a port accepts connections."""
    try:
        socket.create_connection((address, port), timeout=5).close()
    except OSError:
        return False
    return True


# ---- stops


@pytest.mark.realtime
def test_a_protective_stop_in_a_move_and_the_way_back(fresh: Start) -> None:
    controller = fresh()
    client = Client("protective_stop", controller.address)
    client.wait_for("ready")
    controller.fault("protective_stop", joint=0, above=0.5)
    client.go_on()
    seen = client.result()
    assert seen["moveJ"] is False
    assert seen["protective"] is True
    assert 0.5 < seen["stopped at"] < 0.6
    # Questions meanwhile are answered by nonsense or errors, never by silence.
    assert seen["inverse"] == []
    assert seen["within limits"] is False
    assert seen["tcp"].startswith("RuntimeError")
    assert seen["safetymode"] == "Safetymode: PROTECTIVE_STOP"
    assert "Cannot unlock protective stop until 5s" in seen["too early"]
    assert seen["unlocked"] is True
    assert seen["stayed at"] == pytest.approx(seen["stopped at"], abs=1e-4)
    assert seen["program runs"] is True
    assert seen["moves again"] is True


@pytest.mark.slow
@pytest.mark.realtime
def test_an_emergency_stop_in_a_move_and_the_way_back(fresh: Start) -> None:
    controller = fresh(time_scale=8.0)
    client = Client("emergency_stop", controller.address)
    client.wait_for("ready")
    controller.fault("emergency_stop", joint=0, above=0.5)
    client.go_on()
    client.wait_for("stopped")
    controller.fault("release_emergency_stop")
    client.go_on()
    seen = client.result()
    assert seen["moveJ"] is False
    assert seen["emergency"] is True
    assert seen["off"] is True
    assert 0.5 < seen["stopped at"] < 0.6
    assert seen["running"] is True
    assert seen["program runs"] is True
    assert seen["moves again"] is True


@pytest.mark.slow
@pytest.mark.realtime
def test_after_a_protective_stop_the_library_says_for_ever_that_the_move_is_running(fresh: Start) -> None:
    controller = fresh()
    client = moving(controller, 0.5)
    controller.fault("protective_stop")
    client.go_on()
    seen = client.result()
    assert seen["async running"] is True
    assert seen["bits"] == 1 << 2 | 1 << 10
    assert seen["runtime"] == 4
    assert max(map(abs, seen["qd"])) < 1e-6


@pytest.mark.slow
@pytest.mark.realtime
def test_a_stop_can_be_asked_for_at_a_time(fresh: Start) -> None:
    controller = fresh()
    client = moving(controller, 1.0)
    began = controller.fault("state")["time"]
    controller.fault("protective_stop", after=0.5)
    ordered = controller.fault("state")["time"]
    client.go_on()
    client.result()
    state = controller.fault("state")
    history = controller.fault("history", since=began)
    still = next(
        t
        for t, q, following in zip(history["times"], history["joints"], history["joints"][1:], strict=False)
        if q == following
    )
    assert state["safety_mode"] == "PROTECTIVE_STOP"
    assert began + 0.5 < still < ordered + 1.0


@pytest.mark.slow
@pytest.mark.realtime
def test_a_safeguard_stop_holds_the_arm_until_it_is_released(fresh: Start) -> None:
    controller = fresh()
    client = moving(controller, 0.5)
    controller.fault("safeguard", active=True)
    client.go_on()
    seen = client.result()
    assert seen["bits"] == 1 << 4 | 1 << 10
    assert max(map(abs, seen["qd"])) < 1e-6
    controller.fault("safeguard", active=False)
    assert arrives(controller)


# ---- lines


@pytest.mark.slow
@pytest.mark.realtime
def test_a_silent_controller_is_noticed_after_two_and_a_half_seconds_and_values_go_stale(fresh: Start) -> None:
    controller = fresh()
    client = listener_while_moving(controller, anew=False)
    controller.fault("stall")
    client.go_on()
    seen = client.result()
    assert seen["lost after"] > 2.0
    assert seen["stale"][0] == seen["stale"][1] > 0.0
    # The arm went on meanwhile, and the library still tells where it was, without an error.
    assert controller.fault("state")["joints"][0] > seen["q"][0] + 0.3


@pytest.mark.slow
@pytest.mark.realtime
def test_a_controller_that_hangs_holds_the_arm_too(fresh: Start) -> None:
    controller = fresh()
    client = moving(controller, 0.0)
    controller.fault("stall", motion=False)
    before = controller.fault("state")
    for _ in range(50):  # it is asked again and again, and does not move
        after = controller.fault("state")
    assert before["speeds"][0] > 0.4
    assert (after["time"], after["joints"]) == (before["time"], before["joints"])
    controller.fault("clear")
    wait_for(lambda: controller.fault("state")["joints"][0] > after["joints"][0], "motion")
    client.go_on()
    client.result()


@pytest.mark.slow
@pytest.mark.realtime
def test_cut_connections_are_noticed_and_the_arm_finishes_its_move(fresh: Start) -> None:
    controller = fresh()
    client = listener_while_moving(controller)
    controller.fault("refuse")
    client.go_on()
    seen = client.result()
    assert seen["lost after"] < 2.0  # as long as it waits for a package that is late
    assert seen["stale"][0] == seen["stale"][1] > 0.0
    assert "Could not connect" in seen["reconnects"]
    assert arrives(controller)
    controller.fault("clear")
    assert observe("connect", controller.address)["control"] == "connected"


@pytest.mark.slow
@pytest.mark.realtime
def test_dropped_connections_can_be_made_anew_at_once(fresh: Start) -> None:
    controller = fresh()
    client = listener_while_moving(controller)
    controller.fault("drop")
    client.go_on()
    seen = client.result()
    assert seen["lost after"] < 2.0  # as long as it waits for a package that is late
    assert seen["reconnects"] is True
    assert seen["fresh"] > seen["stale"][0]


@pytest.mark.slow
@pytest.mark.realtime
def test_after_a_reboot_the_robot_is_off_and_has_forgotten_its_tool(fresh: Start) -> None:
    controller = fresh(time_scale=8.0)
    observe("questions", controller.address)
    assert controller.fault("state")["payload"] == 0.75
    controller.fault("reboot", seconds=0.4)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((controller.address, 30004), timeout=5)
    wait_for(lambda: is_open(controller.address, 29999), "dashboard after the reboot")
    assert observe("dashboards", controller.address)["robotmode"] == "Robotmode: POWER_OFF"
    assert controller.fault("state")["payload"] == 0.0


# ---- the panel


@pytest.mark.slow
@pytest.mark.realtime
def test_in_local_control_the_library_refuses_to_connect(fresh: Start) -> None:
    controller = fresh(local=True)
    seen = observe("connect", controller.address)
    assert seen["receive"] == "connected"
    assert "remote control" in seen["control"]
    controller.fault("remote", active=True)
    assert observe("connect", controller.address)["control"] == "connected"


@pytest.mark.slow
@pytest.mark.realtime
def test_switching_to_local_control_stops_the_program_and_the_arm(fresh: Start) -> None:
    controller = fresh()
    client = moving(controller, 0.5)
    controller.fault("remote", active=False)
    client.go_on()
    seen = client.result()
    assert seen["runtime"] == 1
    assert max(map(abs, seen["qd"])) < 1e-6
    assert seen["q"][0] < 2.4


@pytest.mark.slow
@pytest.mark.realtime
def test_the_speed_slider_slows_a_move_that_runs(fresh: Start) -> None:
    controller = fresh()
    client = moving(controller, 0.3)
    controller.fault("slider", fraction=0.2)
    client.go_on()
    assert client.result()["qd"][0] == pytest.approx(0.1, abs=0.005)


@pytest.mark.slow
@pytest.mark.realtime
def test_noise_on_joint_positions_is_seen_in_what_is_measured_only(fresh: Start) -> None:
    controller = fresh(time_scale=16.0)
    controller.fault("noise", sigma=0.01)
    client = moving(controller, 0.1)
    assert arrives(controller)
    client.go_on()
    seen = client.result()
    errors = [abs(q - joint) for q, joint in zip(seen["q"], controller.fault("state")["joints"], strict=True)]
    assert 1e-5 < max(errors) < 0.06


@pytest.mark.realtime
def test_a_wrong_checksum_is_told(fresh: Start) -> None:
    controller = fresh()
    true = controller.fault("state")["checksum"]
    controller.fault("checksum", value="DEADBEEF")
    assert controller.fault("state")["checksum"] == "DEADBEEF" != true
    controller.fault("checksum")
    assert controller.fault("state")["checksum"] == true


# ---- watchdogs


@pytest.mark.slow
@pytest.mark.realtime
def test_a_watchdog_that_is_kicked_lets_the_move_go_on(fresh: Start) -> None:
    seen = observe("watched", fresh().address, kick=True)
    assert seen["running"] is True
    assert seen["q"] > 0.9


@pytest.mark.realtime
def test_a_watchdog_that_is_not_kicked_stops_the_arm(fresh: Start) -> None:
    seen = observe("watched", fresh().address, kick=False)
    assert seen["running"] is False
    assert seen["q"] < 0.8


@pytest.mark.slow
@pytest.mark.realtime
def test_a_client_that_dies_leaves_the_watchdog_to_stop_the_arm(fresh: Start) -> None:
    controller = fresh(time_scale=1.0)
    client = Client("watched", controller.address, exits=True)
    client.wait_for("ready")
    assert client.end() == 0
    wait_for(lambda: controller.fault("state")["runtime_state"] == "STOPPED", "stop")
    wait_for(lambda: not any(controller.fault("state")["speeds"]), "rest")
    state = controller.fault("state")
    assert state["joints"][0] < 0.5


# ---- the port itself


@pytest.mark.realtime
def test_an_unknown_fault_is_told_with_those_there_are(shared: VirtualController) -> None:
    with pytest.raises(VirtualControllerError, match=r"no fault 'pizza'.*protective_stop"):
        shared.fault("pizza")


def test_the_motion_is_read_as_doubles_as_well_so_that_two_minutes_of_it_do_not_hold_up_the_clock() -> None:
    """Text of two minutes took so long on a busy machine that clients gave up their connections."""
    controller = Controller(MODELS["ur10e"], frequency=125.0)
    for _ in range(300):
        controller.tick()
    faults = ControllerFaults(Host(controller, "127.0.0.1"))
    history, samples = (faults.call({"fault": name, "since": 0.5}) for name in ("history", "samples"))
    moments = list(struct.iter_unpack("7d", b64decode(samples["samples"])))
    assert [t for t, *_ in moments] == history["times"]
    assert [q for _, *q in moments] == history["joints"]
    assert len(moments) > 100
    assert samples["now"] == history["now"]
