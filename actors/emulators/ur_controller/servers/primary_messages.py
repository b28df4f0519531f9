"""Packages of the primary and secondary interfaces (ports 30001, 30002): robot states and messages.

A package is `int32 size, uint8 type, …`, big-endian, the size including itself. A robot state (type 16) consists of
sub-packages of the same structure; it is sent ten times per second. `PrimaryState` holds its values, and `robot_state`
encodes it. `ControllerMessage` is a message to the user and to the clients of the primary interface.

Source: the manufacturer's page on primary and secondary interfaces (software 5.10). Fields marked "used internally" are
sent as zeros. The first four bytes of the safety data are the checksum, according to the manufacturer's forum.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from actors.arm.ur.robot_models import Calibration

ROBOT_STATE = 16
ROBOT_MESSAGE = 20

MODE_DATA, JOINT_DATA, TOOL_DATA, MASTERBOARD_DATA, CARTESIAN_INFO = 0, 1, 2, 3, 4
KINEMATICS_INFO, CONFIGURATION_DATA, ADDITIONAL_INFO, SAFETY_DATA = 5, 6, 8, 10

TEXT, POPUP, SAFETY_MODE, ERROR_CODE, VERSION, KEY, RUNTIME_EXCEPTION = 0, 2, 5, 6, 3, 7, 10

ACCELERATION = 40.0
"""Largest acceleration of every joint [rad/s²]. The manufacturer publishes none; this one is plausible."""

_SIZE = struct.Struct(">iB")


def package(kind: int, *parts: bytes) -> bytes:
    """Encode a package or sub-package."""
    body = b"".join(parts)
    return _SIZE.pack(_SIZE.size + len(body), kind) + body


def split(data: bytes) -> list[tuple[int, bytes]]:
    """Split consecutive packages into types and bodies.

    Raises:
        ValueError: the sizes are inconsistent.
    """
    messages, place = [], 0
    while place < len(data):
        if len(data) - place < _SIZE.size:
            raise ValueError(f"{len(data) - place} bytes left over")
        size, kind = _SIZE.unpack_from(data, place)
        if size < _SIZE.size or place + size > len(data):
            raise ValueError(f"a package of {size} bytes where {len(data) - place} are left")
        messages.append((kind, data[place + _SIZE.size : place + size]))
        place += size
    return messages


# More than 20 fields: the fields of UR's message.
@dataclass(frozen=True)
class PrimaryState:
    """The values of a robot state, in SI units.

    Attributes:
        time: of the controller [s].
        powered, emergency, protective, running, paused: flags.
        robot_mode, safety_mode, joint_mode: as numbers.
        slider, scaling: 0 … 1.
        q, target_q, qd, currents: of the six joints.
        pose, tcp: of the tool centre point in the base's, and in the flange's frame.
        digital_in, digital_out: bits.
        analog_in, analog_out: two each.
        analog_voltage: whether each analogue output is in volt.
        checksum: of the safety configuration, 32 bits.
    """

    time: float
    powered: bool
    emergency: bool
    protective: bool
    running: bool
    paused: bool
    robot_mode: int
    safety_mode: int
    joint_mode: int
    slider: float
    scaling: float
    q: Sequence[float]
    target_q: Sequence[float]
    qd: Sequence[float]
    currents: Sequence[float]
    pose: Sequence[float]
    tcp: Sequence[float]
    digital_in: int
    digital_out: int
    analog_in: Sequence[float]
    analog_out: Sequence[float]
    analog_voltage: Sequence[bool]
    checksum: int


def robot_state(s: PrimaryState, *packages: bytes) -> bytes:
    """Encode a robot state, with further sub-packages after the usual ones."""
    joints = b"".join(
        struct.pack(">3d4fB", q, target, qd, current, 48.0 if s.powered else 0.0, 32.0, 32.0, s.joint_mode)
        for q, target, qd, current in zip(s.q, s.target_q, s.qd, s.currents, strict=True)
    )
    flags = (True, True, s.powered, s.emergency, s.protective, s.running, s.paused)
    masterboard = struct.pack(
        ">iiBB2dBB2d4fBBBIBB",
        *(s.digital_in & 0x3FFFF, s.digital_out & 0x3FFFF, 1, 1, *s.analog_in),
        *(*(int(v) for v in s.analog_voltage), *s.analog_out),
        *(35.0, 48.0, 0.6, 0.0, s.safety_mode, s.safety_mode == 2, 0, 0, 0, 0),
    )
    return package(
        ROBOT_STATE,
        package(
            MODE_DATA,
            struct.pack(">Q7?BB3dB", int(1e6 * s.time), *flags, s.robot_mode & 0xFF, 0, s.slider, s.scaling, 1.0, 0),
        ),
        package(JOINT_DATA, joints),
        package(TOOL_DATA, struct.pack(">BB2dfBffB", 0, 0, 0.0, 0.0, 48.0, 0, 0.0, 33.0, s.joint_mode)),
        package(MASTERBOARD_DATA, masterboard),
        package(CARTESIAN_INFO, struct.pack(">12d", *s.pose, *s.tcp)),
        package(ADDITIONAL_INFO, bytes(4)),
        package(SAFETY_DATA, struct.pack(">I", s.checksum), bytes(34)),
        *packages,
    )


def kinematics_info(dh: Calibration) -> bytes:
    """Encode the Denavit–Hartenberg parameters; a robot without calibration sends checksums of all ones."""
    rows = (struct.pack(">4d", *row) for row in zip(dh.theta, dh.a, dh.d, dh.alpha, strict=True))
    checksums = (zlib.crc32(row) if dh.checksum else 0xFFFFFFFF for row in rows)
    numbers = (*dh.theta, *dh.a, *dh.d, *dh.alpha)
    return package(KINEMATICS_INFO, struct.pack(">6I24dI", *checksums, *numbers, 0))


def configuration_data(
    ranges: Sequence[tuple[float, float]],
    speeds: Sequence[float],
    a: Sequence[float],
    d: Sequence[float],
    alpha: Sequence[float],
    robot_type: tuple[int, int],
) -> bytes:
    """Encode limits, defaults and lengths."""
    limits = [angle for pair in ranges for angle in pair]
    motion = [value for speed in speeds for value in (speed, ACCELERATION)]
    defaults = (1.05, 1.4, 0.25, 1.2, 0.3)
    numbers = struct.pack(">53d", *limits, *motion, *defaults, *a, *d, *alpha, *((0.0,) * 6))
    return package(CONFIGURATION_DATA, numbers, struct.pack(">4i", 1, 1, *robot_type))


def _message(time: float, kind: int, *parts: bytes) -> bytes:
    return package(ROBOT_MESSAGE, struct.pack(">QbB", int(1e6 * time), -2, kind), *parts)


def _short(text: str) -> bytes:
    data = text.encode()[:255]
    return bytes([len(data)]) + data


def version_message(time: float, version: tuple[int, int, int, int]) -> bytes:
    """Encode the version message, the first message to a client."""
    major, minor, bugfix, build = version
    numbers = struct.pack(">BBii", major, minor, bugfix, build)
    return _message(time, VERSION, _short("URControl"), numbers, b"01-01-2022, 00:00:00")


def text_message(time: float, text: str) -> bytes:
    """Encode a program's text message."""
    return _message(time, TEXT, text.encode())


def key_message(time: float, title: str, text: str) -> bytes:
    """Encode a message of the controller about programs."""
    return _message(time, KEY, struct.pack(">ii", 0, 0), _short(title), text.encode())


def error_message(time: float, code: int, text: str) -> bytes:
    """Encode an error with its code, e.g. C210 for a program sent to a read-only connection."""
    return _message(time, ERROR_CODE, struct.pack(">iiiII", code, 0, 2, 0, 0), text.encode())


def exception_message(time: float, line: int, text: str) -> bytes:
    """Encode a program's error: it cannot be parsed or cannot continue."""
    return _message(time, RUNTIME_EXCEPTION, struct.pack(">ii", line, 0), text.encode())


def safety_message(time: float, mode: int) -> bytes:
    """Encode a change of the safety mode."""
    return _message(time, SAFETY_MODE, struct.pack(">iiBII", 0, 0, mode, 0, 0))


def popup_message(time: float, text: str) -> bytes:
    """Encode a message that the operator has to close."""
    return _message(time, POPUP, struct.pack(">I4B", 0, 0, 0, 0, 0), _short("Popup"), text.encode())


@dataclass(frozen=True)
class ControllerMessage:
    """One message.

    Attributes:
        kind: 'text' (from a program), 'key' (from the controller), 'exception' (a program cannot continue), 'safety',
            'error' (with a code), 'popup'.
        text: its text.
        line: of the program, for an exception; code, for an error.
        time: of the controller [s].
    """

    kind: str
    text: str
    line: int = 0
    time: float = 0.0


Listener = Callable[[ControllerMessage], None]
