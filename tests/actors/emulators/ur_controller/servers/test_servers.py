"""`servers`: bytes: frames however they are cut, recipes and their owners, nonsense, and packages of the primary
port.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from actors.arm.ur import rtde
from actors.arm.ur.primary_interface import robot_state
from actors.emulators.ur_controller.commands import commands_of
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.robot import MODELS
from actors.emulators.ur_controller.servers import primary_messages as primary
from actors.emulators.ur_controller.servers.connections import MOST_UNSENT, Connection, Connections, ScriptConnection
from actors.emulators.ur_controller.servers.dashboard_server import DashboardConnection, DashboardServer
from actors.emulators.ur_controller.servers.primary_server import PrimaryConnection, PrimaryServer
from actors.emulators.ur_controller.servers.rtde_server import RtdeConnection, RtdeServer
from tests.support.hypothesis_examples import examples
from tests.support.waiting import wait_for


class _Socket:
    def setsockopt(self, *_: Any) -> None:
        pass


class Wire(asyncio.Transport):
    """The other end of a connection, without a socket."""

    def __init__(self, connection: Connection) -> None:
        super().__init__()
        self.got = bytearray()
        self.cut = False
        self._connection = connection
        connection.connection_made(self)

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return _Socket()

    def write(self, data: Any) -> None:
        self.got += data

    def get_write_buffer_size(self) -> int:
        return 0

    def is_closing(self) -> bool:
        return self.cut

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass

    def abort(self) -> None:
        self.cut = True
        self._connection.connection_lost(None)

    close = abort

    def say(self, data: bytes) -> None:
        if not self.cut:
            self._connection.data_received(data)
            uploads = self._connection.connections.uploads
            uploads.work(1.0)  # as the host does at its next wake-up
            wait_for(lambda: not uploads.translating, "translation of a long program")
            uploads.work(1.0)

    def take(self) -> bytes:
        data = bytes(self.got)
        self.got.clear()
        return data


class Rtde(Wire):
    """An RTDE client."""

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Send a frame; returns the payload of the one answer."""
        self.take()
        self.say(rtde.package(ord(kind), payload))
        answers = list(rtde.PackageReader().feed(self.take()))
        assert [k for k, _ in answers] == [ord(kind)]
        return answers[0][1]


@pytest.fixture
def server() -> RtdeServer:
    controller = Controller(MODELS["ur10e"])
    return RtdeServer(controller, Connections(controller))


def client(server: RtdeServer) -> Rtde:
    rtde_client = Rtde(RtdeConnection(server))
    assert rtde_client.ask("V", b"\0\2") == b"\1"
    return rtde_client


def test_versions(server: RtdeServer) -> None:
    one = client(server)
    assert struct.unpack(">4I", one.ask("v"))[:2] == (5, 12)
    assert one.ask("V", b"\0\3") == b"\0"
    assert one.ask("V", b"") == b"\0"


def test_outputs_come_at_the_rate_asked_for_with_the_types_promised(server: RtdeServer) -> None:
    one = client(server)
    names = b"timestamp,actual_q,robot_mode,runtime_state,actual_digital_output_bits,payload_cog,"
    types = one.ask("O", struct.pack(">d", 100.0) + names)
    assert types == b"\1DOUBLE,VECTOR6D,INT32,UINT32,UINT64,VECTOR3D"
    assert one.ask("S") == b"\1"
    server.controller.signals.digital_out = 5
    for _ in range(500):
        server.controller.tick()
        server.publish(server.controller.now)
    frames = list(rtde.PackageReader().feed(one.take()))
    assert len(frames) in (100, 101)
    kind, payload = frames[-1]
    assert (kind, payload[0]) == (rtde.DATA_PACKAGE, 1)
    values = struct.unpack(">d6diIQ3d", payload[1:])
    assert values[0] == pytest.approx(1.0, abs=0.01)
    assert values[1:7] == pytest.approx(server.controller.robot.q)
    assert values[7:10] == (7, 1, 5)
    assert one.ask("P") == b"\1"
    server.publish(99.0)
    assert one.take() == b""


def test_an_unknown_field_is_not_found_and_leaves_nothing_set_up(server: RtdeServer) -> None:
    one = client(server)
    assert one.ask("O", struct.pack(">d", 100.0) + b"timestamp,wisdom") == b"\0DOUBLE,NOT_FOUND"
    assert one.ask("S") == b"\0"
    assert one.ask("I", b"input_int_register_0,wisdom") == b"\0INT32,NOT_FOUND"


def test_inputs_belong_to_one_client_until_it_leaves(server: RtdeServer) -> None:
    one, other = client(server), client(server)
    assert one.ask("I", b"input_int_register_0,input_double_register_0") == b"\1INT32,DOUBLE"
    assert one.ask("I", b"input_int_register_0") == b"\2INT32"
    assert other.ask("I", b"input_int_register_0,input_int_register_1") == b"\0IN_USE,INT32"
    one.abort()
    assert other.ask("I", b"input_int_register_0,input_int_register_1") == b"\1INT32,INT32"


def test_inputs_reach_registers_signals_and_the_slider(server: RtdeServer) -> None:
    one, controller = client(server), server.controller
    one.ask("I", b"input_int_register_3,input_double_register_47,speed_slider_mask,speed_slider_fraction")
    one.ask("I", b"configurable_digital_output_mask,configurable_digital_output")
    one.ask("I", b"standard_analog_output_mask,standard_analog_output_type,standard_analog_output_1")
    one.say(rtde.package(rtde.DATA_PACKAGE, b"\1" + struct.pack(">idId", -5, 2.5, 1, 0.25)))
    one.say(rtde.package(rtde.DATA_PACKAGE, b"\2\x06\x02"))
    one.say(rtde.package(rtde.DATA_PACKAGE, b"\3\x02\x02" + struct.pack(">d", 0.5)))
    assert (controller.registers.input_int[3], controller.registers.input_double[47]) == (-5, 2.5)
    assert controller.robot.mover.slider == 0.25
    assert controller.signals.digital_out == 2 << 8
    assert controller.signals.analog_reading(1) == 5.0


@pytest.mark.parametrize("payload", [b"", b"\1", b"\1\0\0\0", b"\1" + bytes(13), b"\7" + bytes(12)])
def test_a_package_that_fits_no_recipe_changes_nothing(server: RtdeServer, payload: bytes) -> None:
    one = client(server)
    one.ask("I", b"input_int_register_0,input_double_register_0")
    server.controller.registers.input_int[0] = 77
    one.say(rtde.package(rtde.DATA_PACKAGE, payload))
    assert server.controller.registers.input_int[0] == 77
    assert one.take() == b""  # a client in its setup takes whatever comes for its answer


@pytest.mark.parametrize("fraction", [float("nan"), float("inf"), -0.5, 1.5])
def test_a_speed_slider_beyond_its_ends_stays_where_it_is(server: RtdeServer, fraction: float) -> None:
    one = client(server)
    one.ask("I", b"speed_slider_mask,speed_slider_fraction")
    one.say(rtde.package(rtde.DATA_PACKAGE, b"\1" + struct.pack(">Id", 1, fraction)))
    assert server.controller.robot.mover.slider == 1.0


RECORD_RECIPE = {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
    "actual_robot_voltage actual_robot_current joint_position_deviation_ratio",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
    "joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
    "joint_temperatures actual_joint_voltage",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "INT32": "robot_mode safety_mode",
    "VECTOR6INT32": "joint_mode",
    "VECTOR3D": "actual_tool_accelerometer",
    "UINT32": "runtime_state",
}
"""The recipe that the manufacturer's client records with, by type."""

READ = {
    "DOUBLE": "standard_analog_input0 standard_analog_input1 standard_analog_output0 standard_analog_output1 payload",
    "VECTOR6D": "payload_inertia",
    "VECTOR3D": "elbow_position elbow_velocity payload_cog",
    "UINT32": "robot_status_bits safety_status_bits output_bit_registers0_to_31 output_bit_registers32_to_63",
}
"""What else `ur-rtde` reads of both generations of controllers, registers left out."""

SINCE_E_SERIES = {"VECTOR6D": "ft_raw_wrench tcp_offset"}

LATER = (
    "collision_detection_ratio time_scale_source actual_current_as_torque actual_robot_energy_consumed "
    "actual_robot_braking_energy_dissipated wrench_calc_from_currents target_gravity target_base_acceleration "
    "actual_TCP_acceleration target_TCP_acceleration target_execution_time actual_qdd euromap67_input_bits tool_mode"
)
"""Documented for later software, or read by no client here."""


def kinds_of(controller: Controller, names: list[str]) -> list[str]:
    """The types that a controller gives for names; two requests, as one may have no more than 2048 bytes."""
    answers = []
    for part in (names[::2], names[1::2]):
        one = client(RtdeServer(controller, Connections(controller)))
        answers.append(one.ask("O", struct.pack(">d", 125.0) + ",".join(part).encode())[1:].decode().split(","))
    return [answers[i % 2][i // 2] for i in range(len(names))]


@pytest.mark.parametrize("model", [MODELS["ur10"], MODELS["ur10e"]], ids=["CB3", "e-Series"])
@pytest.mark.parametrize("table", [RECORD_RECIPE, READ, SINCE_E_SERIES], ids=["record", "both", "e-Series"])
def test_outputs_that_clients_read_have_the_documented_types(model: Any, table: dict[str, str]) -> None:
    wanted = {name: kind for kind, names in table.items() for name in names.split()}
    if table is SINCE_E_SERIES and not model.e_series:
        wanted = dict.fromkeys(wanted, "NOT_FOUND")
    assert dict(zip(wanted, kinds_of(Controller(model), list(wanted)), strict=True)) == wanted


@pytest.mark.parametrize("model", [MODELS["ur10"], MODELS["ur10e"]], ids=["CB3", "e-Series"])
def test_registers_have_their_types_and_later_outputs_are_not_found(model: Any) -> None:
    registers = {
        f"{side}_{kind}_register_{i}": type_
        for side in ("input", "output")
        for kind, type_, numbers in (
            ("int", "INT32", range(48)),
            ("double", "DOUBLE", range(48)),
            ("bit", "BOOL", range(64, 128)),
        )
        for i in numbers
    }
    controller = Controller(model)
    for start in range(0, len(registers), 80):
        names = list(registers)[start : start + 80]
        assert kinds_of(controller, names) == [registers[name] for name in names]
    assert set(kinds_of(controller, LATER.split())) == {"NOT_FOUND"}


def test_outputs_follow_what_the_arm_does() -> None:
    controller = Controller(MODELS["ur10e"])
    fields = RtdeServer(controller, Connections(controller)).fields
    assert fields["joint_position_deviation_ratio"].read() == 0.0
    controller.upload(
        "def f():\n  q = get_actual_joint_positions()\n  q[1] = q[1] + 0.8\n  movej(q)\n  sleep(9)\nend\n"
    )
    for _ in range(200):
        controller.tick()
    before = fields["elbow_position"].read()
    controller.tick()
    after, speed = fields["elbow_position"].read(), fields["elbow_velocity"].read()
    assert [(b - a) * 500 for a, b in zip(before, after, strict=True)] == pytest.approx(speed, abs=2e-3)
    assert max(map(abs, speed)) > 0.1
    assert 0.0 < fields["joint_position_deviation_ratio"].read() < 1.0
    for _ in range(1500):
        controller.tick()
    assert controller.playing
    assert fields["joint_position_deviation_ratio"].read() == 0.0


def test_every_field_can_be_sent_in_its_type(server: RtdeServer) -> None:
    names = list(server.fields)
    for start in range(0, len(names), 40):
        one = client(server)
        types = one.ask("O", struct.pack(">d", 500.0) + ",".join(names[start : start + 40]).encode())
        assert b"NOT_FOUND" not in types
        one.ask("S")
        server.publish(1000.0 + start)
        ((kind, payload),) = rtde.PackageReader().feed(one.take())
        assert kind == rtde.DATA_PACKAGE
        formats = "".join(rtde.FORMATS[t][0] for t in types[1:].decode().split(","))
        assert len(payload) == 1 + struct.calcsize(">" + formats)
        one.abort()


def test_a_client_that_never_reads_is_cut_off_before_packages_fill_memory(
    server: RtdeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = client(server)
    one.ask("O", struct.pack(">d", 500.0) + b"timestamp,actual_q")
    one.ask("S")
    monkeypatch.setattr(one, "get_write_buffer_size", lambda: len(one.got))
    for k in range(MOST_UNSENT // 50):
        server.publish(1.0 + 0.01 * k)
    assert one.cut
    assert len(one.got) <= MOST_UNSENT + 100
    assert server.connections.open == set()


@given(cuts=st.lists(st.integers(0, 60), max_size=8))
def test_frames_arrive_whole_however_the_stream_is_cut(cuts: list[int]) -> None:
    sent = [(ord("V"), b"\0\2"), (ord("O"), b"x" * 20), (ord("S"), b""), (ord("U"), b"\1" + bytes(12))]
    stream = b"".join(rtde.package(k, p) for k, p in sent)
    frames, got, place = rtde.PackageReader(), [], 0
    for cut in [*sorted(cuts), len(stream)]:
        got += frames.feed(stream[place:cut])
        place = max(place, cut)
    assert got == sent


@pytest.mark.parametrize("size", [0, 1, 2])
def test_a_frame_shorter_than_its_own_head_cuts_the_connection(server: RtdeServer, size: int) -> None:
    one = client(server)
    one.say(struct.pack(">HB", size, ord("V")) + bytes(10))
    assert one.cut


def _rtde(controller: Controller) -> Connection:
    return RtdeConnection(RtdeServer(controller, Connections(controller)))


def _dashboard(controller: Controller) -> Connection:
    return DashboardConnection(Connections(controller), DashboardServer(controller))


def _script(controller: Controller) -> Connection:
    return ScriptConnection(Connections(controller))


def _primary(controller: Controller) -> Connection:
    return PrimaryConnection(PrimaryServer(controller, Connections(controller)), messages=True, writable=True)


KINDS: dict[str, Callable[[Controller], Connection]] = {
    "rtde": _rtde,
    "dashboard": _dashboard,
    "script": _script,
    "primary": _primary,
}

known = st.sampled_from(
    [
        rtde.package(ord("V"), b"\0\2"),
        rtde.package(ord("v"), b""),
        rtde.package(ord("O"), struct.pack(">d", 500.0) + b"timestamp,actual_q"),
        rtde.package(ord("O"), struct.pack(">d", float("nan")) + b"timestamp"),
        rtde.package(ord("I"), b"input_int_register_0,speed_slider_mask,speed_slider_fraction"),
        rtde.package(ord("U"), b"\1" + bytes(16)),
        rtde.package(ord("S"), b""),
        rtde.package(ord("P"), b""),
        b"robotmode\n",
        b"play\n",
        b"stop\n",
        b"power off\n",
        b"unlock protective stop\n",
        b"popup \xff\xfe\n",
        b"def f():\n movej([0,0,0,0,0,0])\nend\n",
        b"end\n",
        b'popup("',
        b"\0\0",
        b"\xff\xff\xff\xff",
    ]
)
anything = st.lists(st.one_of(known, st.binary(max_size=40)), max_size=12)


@pytest.mark.parametrize("kind", list(KINDS))
@settings(max_examples=examples(80), deadline=None)
@given(pieces=anything)
def test_no_bytes_whatever_disturb_a_controller(kind: str, pieces: list[bytes]) -> None:
    controller = Controller(MODELS["ur10e"])
    wire = Wire(KINDS[kind](controller))
    for piece in pieces:
        wire.say(piece)
        controller.tick()
    for _ in range(3):
        controller.tick()
    server = RtdeServer(controller, Connections(controller))
    assert client(server).ask("v")


_values = st.sampled_from(
    (
        *("0", "1", "-1", "3.5", "1e308", "1e999", "0xFFFFFFFF", "0x" + "F" * 40, "9" * 30, "True", "'s'", '"é"', "[]"),
        *("[0, -1, 1, 0, 0, 0]", "[1e300, 1, 1, 1, 1, 1]", "p[0.5, 0.2, 0.3, 0, 3, 0]", "p[1]", "[[1]]"),
        *("x", "y", "a", "t"),
    )
)
_commands = st.sampled_from(["f", "a", "t", "run t", *sorted(commands_of(Controller(MODELS["ur10e"])))])


def _larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    operators = st.sampled_from(["+", "-", "*", "/", "%", "<", "==", "!=", "and"])
    return st.one_of(
        st.builds("({} {} {})".format, inner, operators, inner),
        st.builds("{}[{}]".format, inner, inner),
        st.builds("[{}, {}]".format, inner, inner),
        st.builds("{}({})".format, _commands, st.lists(inner, max_size=4).map(", ".join)),
        st.builds("{}({}, {}={})".format, _commands, inner, st.sampled_from("avtr"), inner),
    )


_expressions = st.recursive(_values, _larger, max_leaves=5)
_simple = st.one_of(
    _expressions,
    st.builds("{} {}".format, st.sampled_from(["x =", "global y =", "local x =", "kill", "return"]), _expressions),
    st.builds("x[{}] = {}".format, _expressions, _expressions),
    st.sampled_from(
        ["sync()", "halt", "break", "continue", "enter_critical", "exit_critical", "x = run t()", "end", ")"]
    ),
)
_parameters = st.sampled_from(["", "", "x", "x, y=1", "x, x", "x=f()", "x=movej([0])", "1", "x"])
_ends = st.sampled_from(["end", "end", "end", "end", "", "end end", '"'])


def _nested(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    block = st.lists(inner, max_size=4).map("\n".join)
    names = st.sampled_from(["f", "a", "t", "movej", "if"])
    return st.one_of(
        st.builds("if {}:\n{}\nelse:\n{}\n{}".format, _expressions, block, block, _ends),
        st.builds("while {}:\n{}\n{}".format, _expressions, block, _ends),
        st.builds("def {}({}):\n{}\n{}".format, names, _parameters, block, _ends),
        st.builds("thread {}({}):\n{}\n{}".format, st.just("t"), _parameters, block, _ends),
    )


_blocks = st.lists(st.recursive(_simple, _nested, max_leaves=8), max_size=5).map("\n".join)
_programs = st.one_of(
    _blocks,
    st.builds("{} a({}):\n{}\n{}".format, st.sampled_from(["def", "sec"]), _parameters, _blocks, _ends),
    st.text(max_size=60),
)


def reported(wire: Wire) -> list[str]:
    """Texts of the errors that a primary client has got."""
    return [
        body[18:].decode()
        for kind, body in primary.split(wire.take())
        if kind == primary.ROBOT_MESSAGE and body[9] == primary.RUNTIME_EXCEPTION
    ]


@pytest.mark.slow
@settings(max_examples=examples(600), deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(texts=st.lists(_programs, min_size=1, max_size=3))
def test_no_program_whatever_ends_the_controller_or_keeps_the_next_from_running(texts: list[str]) -> None:
    controller = Controller(MODELS["ur10e"], frequency=125)
    connections = Connections(controller)
    port = PrimaryServer(controller, connections)
    for text in texts:
        wire = Wire(PrimaryConnection(port, messages=True, writable=True))
        wire.say(text.encode() + b"\n")
        for _ in range(5):
            controller.tick()
            wire.say(b"")
        wire.abort()
    listener = Wire(PrimaryConnection(port, messages=True, writable=True))
    listener.take()
    controller.stop()
    if controller.power.running and controller.safety.may_move:
        listener.say(b"def after():\n  write_output_integer_register(3, 77)\n  x = 1 / 0\nend\n")
        controller.tick()
        assert controller.registers.output_int[3] == 77
        assert "division by zero" in reported(listener)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("def a(x):\n textmsg(1)\nend\n", "compile error: program 'a' must not have parameters"),
        ("def a(x=1):\n textmsg(1)\nend\n", "compile error: program 'a' must not have parameters"),
        ("sec a(x, y):\n textmsg(1)\nend\n", "compile error: program 'a' must not have parameters"),
        ("def a(x=norm(5)):\n textmsg(1)\nend\n", "compile error: program 'a' must not have parameters"),
        ("def a(:\nend\n", "compile error: ':' means nothing here"),
        ("def a()\n textmsg(1)\nend\n", "compile error: expected ':', found 'textmsg'"),
        ("def a():\n def b(x):\n  return c\n end\n b()\nend\n", "wrong use of a value or function"),
        ("def a():\n if True:\nend\nend end\n", "compile error: 'end' without a block"),
        ("def a():\n x = 1e999\nend\n", "compile error: a number that is too large"),
        ("def a():\n x = 0x" + "F" * 5000 + "\nend\n", "compile error: a number with too many digits"),
        ("\0\1\2\n", "compile error: '\\x00' means nothing here"),
    ],
)
def test_a_program_that_can_not_be_run_is_reported_on_the_port_it_came_by(text: str, says: str) -> None:
    controller = Controller(MODELS["ur10e"])
    wire = Wire(_primary(controller))
    wire.take()
    wire.say(text.encode())
    controller.tick()
    errors = reported(wire)
    assert any(error.startswith(says) for error in errors), errors
    assert not controller.playing


def test_a_defect_of_the_translator_is_reported_and_the_controller_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise KeyError("a defect")

    server = Wire(_primary(controller := Controller(MODELS["ur10e"])))
    server.take()
    with monkeypatch.context() as patch:
        patch.setattr("actors.emulators.ur_controller.controller.translate", broken)
        server.say(b"sleep(1)\n")
    assert reported(server) == ["compile error: internal error of the controller: 'a defect'"]
    assert "KeyError" in capsys.readouterr().err
    server.say(b"sleep(1)\n")
    assert controller.playing


def test_a_line_without_an_end_is_not_kept_for_ever() -> None:
    wire = Wire(_dashboard(Controller(MODELS["ur10e"])))
    for _ in range(20):
        wire.say(b"x" * 1000)
    assert wire.cut


def test_the_primary_port_says_its_version_and_then_its_state() -> None:
    controller = Controller(MODELS["ur10e"])
    wire = Wire(_primary(controller))
    packages = primary.split(wire.take())
    assert [kind for kind, _ in packages] == [primary.ROBOT_MESSAGE, primary.ROBOT_STATE]
    version = packages[0][1]
    assert version[9] == primary.VERSION
    assert b"URControl" in version
    parts = dict(primary.split(packages[1][1]))
    assert set(parts) >= {
        primary.MODE_DATA,
        primary.JOINT_DATA,
        primary.TOOL_DATA,
        primary.MASTERBOARD_DATA,
        primary.CARTESIAN_INFO,
        primary.KINEMATICS_INFO,
        primary.CONFIGURATION_DATA,
        primary.SAFETY_DATA,
    }
    # Sizes with their five bytes of head, as the manufacturer's page gives them.
    sizes = {kind: len(body) + 5 for kind, body in parts.items()}
    assert sizes[primary.MODE_DATA] == 47
    assert sizes[primary.JOINT_DATA] == 251
    assert sizes[primary.TOOL_DATA] == 37
    assert sizes[primary.CARTESIAN_INFO] == 101
    first = struct.unpack_from(">3d", parts[primary.JOINT_DATA])
    assert first[0] == pytest.approx(controller.robot.q[0])
    assert struct.unpack(">12d", parts[primary.CARTESIAN_INFO])[:6] == pytest.approx(controller.robot.pose)


def test_the_safety_checksum_can_be_read_where_a_real_controller_gives_it() -> None:
    controller = Controller(MODELS["ur10e"])

    def told() -> str:
        body = dict(primary.split(Wire(_primary(controller)).take()))[primary.ROBOT_STATE]
        return robot_state(dict(primary.split(body))).checksum

    assert told() == controller.safety.configuration.checksum
    controller.safety.reported_checksum = "DEADBEEF"
    assert told() == "DEADBEEF"


def test_primary_clients_are_told_what_programs_say_and_why_they_end() -> None:
    controller = Controller(MODELS["ur10e"])
    connections = Connections(controller)
    server = PrimaryServer(controller, connections)
    first = Wire(PrimaryConnection(server, messages=True, writable=True))
    second = Wire(PrimaryConnection(server, messages=False, writable=True))
    first.take(), second.take()
    controller.upload('def f():\n textmsg("hello ", 1)\n x = 1 / 0\nend\n')
    controller.tick()
    messages = [(body[9], body[10:]) for kind, body in primary.split(first.take()) if kind == primary.ROBOT_MESSAGE]
    assert (primary.TEXT, b"hello 1") in messages
    ((line, _, text),) = [(*struct.unpack_from(">ii", b), b[8:]) for k, b in messages if k == primary.RUNTIME_EXCEPTION]
    assert (line, text) == (3, b"division by zero")
    assert second.take() == b""
    server.publish(1.0)
    assert [kind for kind, _ in primary.split(second.take())] == [primary.ROBOT_STATE]


def test_a_connection_made_in_local_control_may_only_read_even_after_the_switch_to_remote() -> None:
    controller = Controller(MODELS["ur10e"], remote=False)
    connections = Connections(controller)
    dashboard = DashboardServer(controller)
    old, script = Wire(DashboardConnection(connections, dashboard)), Wire(ScriptConnection(connections))
    port = Wire(PrimaryConnection(PrimaryServer(controller, connections), messages=True, writable=True))
    controller.set_remote(True)
    for wire in (old, script, port):
        wire.take()
    old.say(b"power off\nrobotmode\n")
    refusal, mode, _ = old.take().decode().split("\n")
    assert refusal.startswith("Command is not allowed due to safety reasons")
    assert mode == "Robotmode: RUNNING"
    for wire in (script, port):
        wire.say(b"sleep(1)\n")
        controller.tick()
        assert not controller.playing
    errors = [body[10:] for _, body in primary.split(port.take()) if body[9] == primary.ERROR_CODE]
    assert [struct.unpack_from(">i", e)[0] for e in errors] == [210]
    new = Wire(ScriptConnection(connections))
    new.say(b"sleep(1)\n")
    controller.tick()
    assert controller.playing


def test_programs_are_read_by_the_primary_port_too() -> None:
    controller = Controller(MODELS["ur10"])
    wire = Wire(_primary(controller))
    wire.say(b"set_standard_digital_out(2, True)\n")
    controller.tick()
    assert controller.signals.digital_out == 4
