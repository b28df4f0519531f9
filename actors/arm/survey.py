"""What a UR controller says of itself when nobody steers it: read over plain sockets, one port at a time.

Nothing here can move the arm or change a setting: questions on the dashboard, the robot's state from the primary port,
values over RTDE. It works in states in which a driver can't connect, which is when people want to know why.
"""

from __future__ import annotations

import itertools
import socket
import statistics
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from actors.arm.spec import Joints
from actors.protocols import LaboratoryError
from actors.virtual_ur.wire import primary, rtde

DASHBOARD, PRIMARY, SCRIPTS, RTDE = 29999, 30001, 30003, 30004
PORTS: dict[int, str] = {
    DASHBOARD: "dashboard",
    PRIMARY: "primary interface",
    SCRIPTS: "programs",
    RTDE: "real-time data exchange",
}
"""Ports that Decant uses, with their names."""

QUESTIONS = (
    "PolyscopeVersion",
    "get robot model",
    "get serial number",
    "is in remote control",
    "robotmode",
    "safetystatus",
    "programState",
)
"""Asked on the dashboard; none of them does anything."""

ROUND_TRIPS = 20
_JOINT, _JOINTS = struct.Struct(">3d4fB"), 6


class SurveyError(LaboratoryError):
    """A port says nothing, or nothing that can be understood."""


@dataclass(frozen=True)
class RobotState:
    """What the primary port tells.

    Attributes:
        joints: [rad].
        pose: of the TCP in the base's frame, x y z [m] and rotation vector [rad].
        tool: TCP in the flange's frame, likewise.
        checksum: of the safety configuration; None if the controller tells none.
        joint_ranges: lowest and highest position of each joint [rad]; empty if it doesn't tell.
        joint_speeds: fastest speed of each joint [rad/s]; empty if it doesn't tell.
    """

    joints: Joints
    pose: tuple[float, ...]
    tool: tuple[float, ...]
    checksum: str | None
    joint_ranges: tuple[tuple[float, float], ...] = ()
    joint_speeds: tuple[float, ...] = ()


@dataclass(frozen=True)
class Exchange:
    """What RTDE tells, and how well the network carries it.

    Attributes:
        version: of the controller's software.
        payload: [kg], None if it doesn't tell.
        payload_centre: in the flange's frame [m], None if it doesn't tell.
        round_trip: median time from question to answer [s].
        slowest: longest of them [s].
        rate: packages received per second, of `wanted` [Hz].
        gap: longest time between two packages [s].
    """

    version: tuple[int, ...]
    payload: float | None
    payload_centre: tuple[float, ...] | None
    round_trip: float
    slowest: float
    rate: float
    gap: float
    wanted: float
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


def port_problem(address: str, port: int, patience: float = 2.0) -> str | None:
    """Why a port can't be reached; None if it is open."""
    try:
        with socket.create_connection((address, port), timeout=patience):
            return None
    except ConnectionRefusedError:
        return "refused"
    except TimeoutError:
        return "no answer"
    except OSError as error:
        return error.strerror or str(error)


def ask_dashboard(address: str, questions: Sequence[str] = QUESTIONS, patience: float = 3.0) -> dict[str, str]:
    """Answers of the dashboard, by question.

    Raises:
        SurveyError: it doesn't answer.
    """
    try:
        with socket.create_connection((address, DASHBOARD), timeout=patience) as connection:
            lines = connection.makefile("rb")
            lines.readline()  # its greeting
            answers = {}
            for question in questions:
                connection.sendall(question.encode("ascii") + b"\n")
                line = lines.readline()
                if not line:
                    raise SurveyError(f"the dashboard at {address} hung up at '{question}'")
                answers[question] = line.decode("utf-8", "replace").strip()
            return answers
    except OSError as error:
        raise SurveyError(f"the dashboard at {address} doesn't answer: {error}") from error


def read_state(address: str, patience: float = 3.0) -> RobotState:
    """The robot's state, once all its parts have come.

    Args:
        address: of the controller.
        patience: longest wait [s]; the checksum and the limits, which may be missing, are waited for half of it.

    Raises:
        SurveyError: no state came, or one that can't be read.
    """
    begin, parts, rest = time.monotonic(), dict[int, bytes](), b""
    needed, welcome = {primary.JOINT_DATA, primary.CARTESIAN_INFO}, {primary.SAFETY_DATA, primary.CONFIGURATION_DATA}
    try:
        with socket.create_connection((address, PRIMARY), timeout=patience) as connection:
            while not (needed | welcome) <= parts.keys():
                spent = time.monotonic() - begin
                if spent > patience or (needed <= parts.keys() and spent > patience / 2.0):
                    break
                connection.settimeout(patience)
                data = connection.recv(65536)
                if not data:
                    break
                rest += data
                rest = _take_states(rest, parts)
    except (OSError, ValueError, struct.error) as error:
        raise SurveyError(f"the primary port at {address} can't be read: {error}") from error
    if not needed <= parts.keys():
        raise SurveyError(f"the primary port at {address} sent no robot state within {patience:g} s")
    return _state(parts)


def _take_states(data: bytes, parts: dict[int, bytes]) -> bytes:
    """Keep the parts of whole robot states; what is left over is returned."""
    while len(data) >= 5:
        size = int.from_bytes(data[:4], "big")
        if not 5 <= size <= 1_000_000:
            raise ValueError(f"a package of {size} bytes")
        if len(data) < size:
            break
        if data[4] == primary.ROBOT_STATE:
            parts |= dict(primary.split(data[5:size]))
        data = data[size:]
    return data


def _state(parts: Mapping[int, bytes]) -> RobotState:
    joints = [_JOINT.unpack_from(parts[primary.JOINT_DATA], _JOINT.size * i)[0] for i in range(_JOINTS)]
    cartesian = struct.unpack_from(">12d", parts[primary.CARTESIAN_INFO])
    safety = parts.get(primary.SAFETY_DATA, b"")
    limits = parts.get(primary.CONFIGURATION_DATA, b"")
    numbers = struct.unpack_from(">24d", limits) if len(limits) >= 24 * 8 else ()
    return RobotState(
        joints=(joints[0], joints[1], joints[2], joints[3], joints[4], joints[5]),
        pose=cartesian[:6],
        tool=cartesian[6:],
        checksum=f"{int.from_bytes(safety[:4], 'big'):08X}" if len(safety) >= 4 else None,
        joint_ranges=tuple(zip(numbers[0:12:2], numbers[1:12:2], strict=True)),
        joint_speeds=tuple(numbers[12:24:2]),
    )


def read_exchange(address: str, rate: float = 125.0, seconds: float = 1.0, patience: float = 3.0) -> Exchange:
    """Values over RTDE, round trips, and how evenly packages arrive.

    Args:
        address: of the controller.
        rate: packages asked for [Hz].
        seconds: for how long they are counted.
        patience: longest wait for an answer [s].

    Raises:
        SurveyError: it doesn't answer, or not in a way that can be understood.
    """
    try:
        with socket.create_connection((address, RTDE), timeout=patience) as connection:
            return _exchange(_Rtde(connection), rate, seconds)
    except (OSError, struct.error, rtde.FramingError) as error:
        raise SurveyError(f"RTDE at {address} doesn't answer as it should: {error}") from error


class _Rtde:
    """Questions and answers on one connection."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._frames = rtde.Frames()
        self._waiting: list[tuple[int, bytes]] = []

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        self._connection.sendall(rtde.frame(kind, payload))
        while True:
            got, answer = self.next()
            if got == kind:
                return answer

    def next(self) -> tuple[int, bytes]:
        while not self._waiting:
            data = self._connection.recv(65536)
            if not data:
                raise OSError("it hung up")
            self._waiting.extend(self._frames.feed(data))
        return self._waiting.pop(0)


def _exchange(talk: _Rtde, rate: float, seconds: float) -> Exchange:
    if talk.ask(rtde.REQUEST_PROTOCOL_VERSION, struct.pack(">H", 2)) != b"\x01":
        raise OSError("it doesn't know protocol 2")
    trips = []
    version: tuple[int, ...] = ()
    for _ in range(ROUND_TRIPS):
        asked = time.monotonic()
        version = struct.unpack(">4I", talk.ask(rtde.GET_URCONTROL_VERSION)[:16])
        trips.append(time.monotonic() - asked)
    names = ("timestamp", "payload", "payload_cog")
    known = _known(talk, names, rate)
    if talk.ask(rtde.START) != b"\x01":
        raise OSError("it doesn't begin to send")
    layout = struct.Struct(">B" + "".join(rtde.FORMATS[kind][0] for kind in known.values()))
    arrivals, package, begin = [], b"", time.monotonic()
    while time.monotonic() - begin < seconds:
        kind, payload = talk.next()
        if kind == rtde.DATA_PACKAGE:
            arrivals.append(time.monotonic())
            package = payload
    if len(arrivals) < 2:
        raise OSError("it sends no packages")
    values, place = {}, 1
    numbers = layout.unpack(package)
    for name, kind_name in known.items():
        count = rtde.FORMATS[kind_name][1]
        values[name] = tuple(numbers[place : place + count])
        place += count
    payload_mass = values.get("payload")
    return Exchange(
        version=version,
        payload=None if payload_mass is None else payload_mass[0],
        payload_centre=values.get("payload_cog"),
        round_trip=statistics.median(trips),
        slowest=max(trips),
        rate=(len(arrivals) - 1) / (arrivals[-1] - arrivals[0]),
        gap=max(b - a for a, b in itertools.pairwise(arrivals)),
        wanted=rate,
        values=values,
    )


def _known(talk: _Rtde, names: Sequence[str], rate: float) -> dict[str, str]:
    """Of the values asked for, those that this controller has, with their types; they are sent from now on."""
    while True:
        answer = talk.ask(rtde.SETUP_OUTPUTS, struct.pack(">d", rate) + ",".join(names).encode("ascii"))
        kinds = rtde.names(answer[1:])
        found = {name: kind for name, kind in zip(names, kinds, strict=False) if kind in rtde.FORMATS}
        if len(found) == len(names):
            return found
        if not found:
            raise OSError(f"it knows none of {', '.join(names)}")
        names = tuple(found)
