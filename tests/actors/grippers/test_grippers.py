"""`grippers`: shipped grippers against emulators over loopback sockets, and what their protocols make of every kind
of bytes.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from actors.emulators.gripper_emulators import OnRobotEmulator, RobotiqEmulator
from actors.emulators.ur_controller.controller_process import VirtualController
from actors.grippers.digital_gripper import DigitalGripper, DigitalSettings
from actors.grippers.gripper_interface import GripLimits, GripperError, GripperState
from actors.grippers.onrobot_gripper import OnRobotGripper, OnRobotSettings
from actors.grippers.robotiq_gripper import RobotiqGripper, RobotiqSettings, parse_reply
from decant.plugins.testing import GripperContract, GripperRig

FAST = 20.0
"""Gripper seconds per second of the clock."""


def robotiq(model: str = "2F-85") -> RobotiqEmulator:
    return RobotiqEmulator(RobotiqSettings(model=model, time_scale=FAST))


def onrobot(model: str = "RG2") -> OnRobotEmulator:
    return OnRobotEmulator(OnRobotSettings(model=model, time_scale=FAST))


def rig(emulator: RobotiqEmulator | OnRobotEmulator, width: float) -> Iterator[GripperRig]:
    cls, arguments = emulator.gripper.driver()
    driver = cls(*arguments)
    yield GripperRig(
        driver, emulator.gripper, emulator.put, width, emulator.close, lambda: emulator.fault("power", 0.0)
    )
    driver.close()
    emulator.close()


class TestRobotiq(GripperContract):
    @pytest.fixture(params=[("2F-85", 0.06), ("2F-140", 0.1), ("Hand-E", 0.03)], ids=lambda one: one[0])
    def bench(self, request: pytest.FixtureRequest) -> Iterator[GripperRig]:
        model, width = request.param
        yield from rig(robotiq(model), width)


class TestOnRobot(GripperContract):
    @pytest.fixture(params=[("RG2", 0.06), pytest.param(("RG6", 0.08), marks=pytest.mark.slow), ("2FG7", 0.055)])
    def bench(self, request: pytest.FixtureRequest) -> Iterator[GripperRig]:
        model, width = request.param
        yield from rig(onrobot(model), width)


# ---- Robotiq


@pytest.mark.parametrize(
    ("data", "name", "value"),
    [
        (b"POS 3\n", "POS", 3),  # ur_rtde splits several replies at line feeds; airo-mono cuts the last character
        (b"STA 3\n", "STA", 3),  # airo-mono's test of an active gripper
        (b"OBJ 2\r\n", "OBJ", 2),
        (b"POS ?\n", "POS", None),  # ur_rtde: during an emergency stop a question mark instead of a value
    ],
)
def test_replies_as_public_clients_read_them(data: bytes, name: str, value: int | None) -> None:
    assert parse_reply(data, name) == value


REPLIES = st.binary(max_size=30) | st.from_regex(rb"(POS|OBJ|STA) [?0-9-]{1,6}\n?")


@given(REPLIES, st.sampled_from(["POS", "OBJ", "STA"]))
@example(b"ack", "POS")
@example(b"POS 3", "OBJ")  # the late reply of another request
@example(b"POS\n", "POS")
@example(b"POS 3\nOBJ 0\n", "POS")
def test_whatever_else_comes_is_an_error_and_never_a_value(data: bytes, name: str) -> None:
    found: list[int | None] = []
    with contextlib.suppress(GripperError):
        found.append(parse_reply(data, name))
    for value in found:  # only what was sent, under the name that was requested
        word, text = data.split()
        assert word == name.encode()
        assert text == b"?" if value is None else int(text) == value


@given(st.floats(0.0, 0.085), st.integers(0, 255))
def test_widths_and_positions_belong_together(width: float, position: int) -> None:
    settings = RobotiqSettings(model="2F-85")
    assert settings.width_at(settings.position_at(width)) == pytest.approx(width, abs=2e-4)  # half of 0.37 mm
    assert 0.0 <= settings.width_at(position) <= 0.085


class Line:
    """A server that answers with given pieces, whatever it is asked."""

    def __init__(self, *pieces: bytes) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._pieces = pieces
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        connection, _ = self._server.accept()
        with connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.recv(100)
            for piece in self._pieces:
                connection.sendall(piece)
            while connection.recv(100):
                pass


def driver_of(line: Line) -> RobotiqGripper:
    return RobotiqGripper(RobotiqSettings(model="2F-85", address="127.0.0.1", port=line.port), timeout=0.3)


def test_a_reply_in_pieces_is_read_to_its_end() -> None:
    driver = driver_of(Line(b"\nPO", b"S 2", b"30\n"))  # the first line feed is that of an 'ack' before
    assert driver.get("POS") == 230
    driver.close()


@pytest.mark.parametrize("pieces", [(b"POS 23",), ()])
def test_half_a_reply_is_an_error_and_no_value(pieces: tuple[bytes, ...]) -> None:
    driver = driver_of(Line(*pieces))
    with pytest.raises(GripperError, match=r"no answer to 'GET POS' within 0\.3 s"):
        driver.get("POS")


def test_a_port_of_something_else_is_named() -> None:
    driver = driver_of(Line(b"Connected: Universal Robots Dashboard Server\n"))
    with pytest.raises(GripperError, match="is this the port of the gripper's URCap"):
        driver.get("POS")


@pytest.fixture
def two_finger() -> Iterator[tuple[RobotiqGripper, RobotiqEmulator]]:
    emulator = robotiq()
    driver = RobotiqGripper(emulator.gripper)
    driver.open(0.08)
    emulator.put(0.06)
    yield driver, emulator
    driver.close()
    emulator.close()


LIMITS = GripLimits("beaker", 0.06, 3e-3)


def test_a_crooked_grasp_is_told_by_its_width(two_finger: tuple[RobotiqGripper, RobotiqEmulator]) -> None:
    driver, emulator = two_finger
    emulator.fault("crooked")
    text = LIMITS.problem(driver.grip(0.05, 60.0))
    assert "the fingers stand at 6" in text
    assert "60.0 ± 3.0 mm" in text


def test_a_second_client_that_opens_the_gripper_is_seen(
    two_finger: tuple[RobotiqGripper, RobotiqEmulator],
) -> None:
    driver, emulator = two_finger
    assert LIMITS.problem(driver.grip(0.05, 60.0)) == ""
    with socket.create_connection((emulator.gripper.address, emulator.gripper.port)) as other:
        other.sendall(b"SET POS 0 GTO 1\n")
        assert other.recv(10) == b"ack"
    assert "another client commands it" in LIMITS.problem(driver.state())


def test_a_low_force_is_no_grasp(two_finger: tuple[RobotiqGripper, RobotiqEmulator]) -> None:
    driver, emulator = two_finger
    emulator.fault("weak")
    assert "its force was set to" in LIMITS.problem(driver.grip(0.05, 100.0))


def test_a_gripper_that_is_not_activated_moves_only_when_it_is_prepared(
    two_finger: tuple[RobotiqGripper, RobotiqEmulator],
) -> None:
    driver, emulator = two_finger
    emulator.fault("not_activated")
    assert "not activated" in driver.state().problem
    with pytest.raises(GripperError, match="is not activated"):
        driver.grip(0.05, 60.0)
    emulator.put(None)
    driver.prepare()
    assert driver.state().problem == ""


def test_after_a_power_cut_a_grasp_is_none_though_the_brake_may_hold(
    two_finger: tuple[RobotiqGripper, RobotiqEmulator],
) -> None:
    driver, emulator = two_finger
    driver.grip(0.05, 60.0)
    emulator.fault("power", 0.0)
    with pytest.raises(GripperError, match="cannot be read"):
        driver.state()
    emulator.fault("power", 1.0)
    assert "not activated" in LIMITS.problem(driver.state())


def test_a_slow_answer_is_not_taken_for_that_of_a_later_request(
    two_finger: tuple[RobotiqGripper, RobotiqEmulator],
) -> None:
    _, emulator = two_finger
    driver = RobotiqGripper(emulator.gripper, timeout=0.2)
    driver.get("POS")
    emulator.fault("slow", 0.4)
    with pytest.raises(GripperError, match="no answer"):
        driver.get("POS")
    emulator.fault("slow", 0.0)
    assert driver.get("STA") == 3
    driver.close()


def test_a_misspelt_request_is_acknowledged_by_nobody() -> None:
    emulator = robotiq()
    assert emulator.answer("SET POS 100 GTO1") == b""
    assert emulator.answer("SET POS 100 SPE 255 FOR 0 GTO 1") == b"ack"
    emulator.close()


# ---- OnRobot


def test_whole_numbers_are_refused_by_the_server_and_never_sent_by_the_driver() -> None:
    emulator = onrobot()
    at = f"http://{emulator.gripper.address}:{emulator.gripper.port}"
    with xmlrpc.client.ServerProxy(f"{at}/") as proxy, pytest.raises(xmlrpc.client.Fault, match="expected double"):
        proxy.rg_grip(0, 60, 20)
    with xmlrpc.client.ServerProxy(f"{at}/RPC2") as proxy, pytest.raises(xmlrpc.client.ProtocolError, match="404"):
        proxy.rg_get_width(0)
    driver = OnRobotGripper(emulator.gripper)
    assert driver.open(0.06).width == pytest.approx(0.06, abs=1e-4)  # 60 mm is a whole number
    driver.close()
    emulator.close()


CAPTURED = b"""<?xml version="1.0" encoding="UTF-8"?>
<methodResponse><params><param><value><%s>%s</%s></value></param></params></methodResponse>"""
"""The form of the replies that RyanPaulMcKenna's onRobot keeps of a controller with RG2 and 2FG7."""


@pytest.mark.parametrize(("kind", "value"), [(b"double", b"100.8000030517578"), (b"double", b"45"), (b"i4", b"45")])
def test_widths_of_a_recorded_controller_are_read(kind: bytes, value: bytes) -> None:
    (found,), _ = xmlrpc.client.loads(CAPTURED % (kind, value, kind))
    driver = OnRobotGripper(OnRobotSettings(model="RG2", address="127.0.0.1"))
    driver.call = lambda method, *arguments: found  # type: ignore[method-assign]
    assert driver._number("get_width") == float(value)


def _page(data: bytes) -> Iterator[int]:
    """A port that answers every request with this body."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                connection.recv(65536)
                head = b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nConnection: close\r\nContent-Length: %d\r\n\r\n"
                connection.sendall(head % len(data) + data)

    threading.Thread(target=serve, daemon=True).start()
    yield server.getsockname()[1]
    server.close()


@pytest.mark.parametrize(
    "body",
    [
        b"<html><body>Welcome</body></html>",
        b"",
        b"\xff\xfe",
        CAPTURED % (b"string", b"?", b"string"),
        CAPTURED % (b"boolean", b"1", b"boolean"),
        b"<methodResponse><params><param><value><double>1e",
    ],
)
def test_an_answer_that_is_no_width_is_one_error(body: bytes) -> None:
    for port in _page(body):
        driver = OnRobotGripper(OnRobotSettings(model="RG2", address="127.0.0.1", port=port), timeout=1.0)
        with pytest.raises(GripperError, match=r"RG2 at 127\.0\.0\.1"):
            driver.state()
        driver.close()


def test_a_2fg7_opens_as_far_as_its_fingers_are_mounted() -> None:
    emulator = onrobot("2FG7")
    driver = OnRobotGripper(emulator.gripper)
    with pytest.raises(GripperError, match=r"opens to 71.0 mm, and 72.0 mm are needed"):
        driver.open(0.072)
    emulator.fault("weak")
    driver.open(0.07)
    emulator.put(0.055)
    with pytest.raises(GripperError, match="it grips with 16 N instead of 80 N"):
        driver.grip(0.045, 80.0)
    driver.close()
    emulator.close()


def test_a_pressed_safety_switch_and_a_missing_gripper_are_said() -> None:
    emulator = onrobot()
    driver = OnRobotGripper(emulator.gripper)
    emulator.fault("safety")
    assert "safety switches" in driver.state().problem
    other = OnRobotGripper(emulator.gripper.with_values(index=1))
    with pytest.raises(GripperError, match="no RG2 is connected at index 1"):
        other.connect()
    driver.close()
    emulator.close()


# ---- digital outputs


@pytest.fixture(scope="module")
def controller() -> Iterator[VirtualController]:
    with VirtualController.start("127.0.55.2") as found:
        yield found


def digital(controller: VirtualController, **changes: object) -> DigitalGripper:
    values = {"close": "standard 2", "travel": 0.05, "opening": 0.1, "address": controller.address}
    return DigitalGripper(DigitalSettings(**{**values, **changes}))


def test_outputs_are_switched_without_ending_a_program(controller: VirtualController) -> None:
    driver = digital(controller, open="tool 1", held="not standard 5", opened="configurable 1")
    assert "gripper on digital outputs" in driver.connect()
    state = driver.grip(0.05, 50.0)
    assert state.detected is True  # the input is low
    controller.fault("inputs", digital={"5": True})
    assert "holds nothing" in LIMITS.problem(driver.state())
    with pytest.raises(GripperError, match="'configurable 1' does not confirm open fingers"):
        driver.open(0.1)
    controller.fault("inputs", digital={"9": True})
    assert driver.open(0.1).detected is False


def test_without_a_confirming_input_nothing_is_known(controller: VirtualController) -> None:
    driver = digital(controller)
    assert driver.grip(0.05, 50.0).detected is None
    driver.open(0.1)


def test_in_local_control_the_outputs_are_not_set(controller: VirtualController) -> None:
    driver = DigitalGripper(digital(controller)._settings, timeout=1.0)
    controller.fault("remote", active=False)
    try:
        with pytest.raises(GripperError, match="is the controller in remote control"):
            driver.grip(0.05, 50.0)
    finally:
        controller.fault("remote", active=True)


def test_limits_without_a_measured_width_need_the_detected_object() -> None:
    assert LIMITS.problem(GripperState(float("nan"), False, True)) == ""
    assert LIMITS.problem(GripperState(float("nan"), False, None)) == ""
    assert "holds nothing" in LIMITS.problem(GripperState(float("nan"), False, False))
