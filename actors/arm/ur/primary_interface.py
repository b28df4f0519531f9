"""The primary interface: it receives programs, and sends the robot's state and messages about errors.

A package is `int32 size, uint8 type, …`, big-endian; a robot state (16) consists of sub-packages of the same format.

Source: the manufacturer's page on primary and secondary interfaces. That the checksum is the first four bytes of the
safety data is stated in the manufacturer's forum.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from actors.arm.ur.robot_models import Calibration
from actors.arm.ur.rtde import CLOSED

PORT = 30001
STATE_TIMEOUT = 2.0
"""Longest wait for the first robot state [s]."""

_LONGEST = 1_000_000
STATE, _MESSAGE = 16, 20
JOINTS, MASTERBOARD, CARTESIAN, KINEMATICS, CONFIGURATION, SAFETY = 1, 3, 4, 5, 6, 10
"""Parts of a robot state."""
_ERROR, _KEY, _EXCEPTION = 6, 7, 10
_HEAD = struct.Struct(">iB")
_JOINT = struct.Struct(">3d4fB")
_CONFIGURATION, _KINEMATICS = struct.Struct(">53d4i"), struct.Struct(">6I24d")


CAUSES = {
    153: "a joint deviates from its commanded position",
    157: "collision detected by a joint",
    158: "collision detected by a joint",
    159: "a joint deviates from its commanded position",
}
"""Meaning of frequent error codes of protective stops, whose messages have no text. Source: the manufacturer's list of
error codes; second-hand, not seen on a robot."""


class PrimaryError(Exception):
    """The primary interface cannot be reached, or its data cannot be understood."""


def split(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Split data into whole packages, as type and body, and the remaining bytes.

    Raises:
        PrimaryError: a package has an invalid size.
    """
    packages, place = [], 0
    while len(data) - place >= _HEAD.size:
        size, kind = _HEAD.unpack_from(data, place)
        if not _HEAD.size <= size <= _LONGEST:
            raise PrimaryError(f"a package of {size} bytes")
        if len(data) - place < size:
            break
        packages.append((kind, data[place + _HEAD.size : place + size]))
        place += size
    return packages, data[place:]


@dataclass(frozen=True)
class RobotState:
    """Contents of a robot state; empty if a part has not arrived.

    Attributes:
        joints: [rad].
        pose: of the TCP in the base's frame, x y z [m] and rotation vector [rad].
        tool: TCP in the flange's frame, likewise.
        checksum: of the safety configuration, eight hexadecimal digits.
        joint_ranges: lowest and highest position of each joint [rad].
        joint_speeds, joint_accelerations: largest ones of each joint [rad/s], [rad/s²].
        kind: type of robot, see `RobotModel.kind`; None if it is not reported.
        lengths: nominal Denavit–Hartenberg lengths: six along x, six along z [m].
        calibration: of this robot; None if it is nominal, as a simulator's is, or not reported.
    """

    joints: tuple[float, ...] = ()
    pose: tuple[float, ...] = ()
    tool: tuple[float, ...] = ()
    checksum: str = ""
    joint_ranges: tuple[tuple[float, float], ...] = ()
    joint_speeds: tuple[float, ...] = ()
    joint_accelerations: tuple[float, ...] = ()
    kind: int | None = None
    lengths: tuple[float, ...] = ()
    calibration: Calibration | None = None


def robot_state(parts: Mapping[int, bytes]) -> RobotState:
    """Read the parts of a robot state, by type."""
    joints, cartesian = parts.get(JOINTS, b""), parts.get(CARTESIAN, b"")
    safety, limits = parts.get(SAFETY, b""), parts.get(CONFIGURATION, b"")
    known = len(limits) >= _CONFIGURATION.size
    numbers = _CONFIGURATION.unpack_from(limits) if known else ()
    places = struct.unpack_from(">12d", cartesian) if len(cartesian) >= 12 * 8 else ()
    return RobotState(
        joints=tuple(_JOINT.unpack_from(joints, _JOINT.size * i)[0] for i in range(len(joints) // _JOINT.size)),
        pose=places[:6],
        tool=places[6:],
        checksum=f"{int.from_bytes(safety[:4], 'big'):08X}" if len(safety) >= 4 else "",
        joint_ranges=tuple(zip(numbers[0:12:2], numbers[1:12:2], strict=True)),
        joint_speeds=tuple(numbers[12:24:2]),
        joint_accelerations=tuple(numbers[13:24:2]),
        kind=numbers[55] if known else None,
        lengths=tuple(numbers[29:41]),
        calibration=_calibration(parts.get(KINEMATICS, b"")),
    )


def _calibration(data: bytes) -> Calibration | None:
    """Source: the manufacturer's client library. Simulators send checksums of all ones."""
    if len(data) < _KINEMATICS.size or data[:24] == b"\xff" * 24:
        return None
    values = _KINEMATICS.unpack_from(data)[6:]
    theta, a, d, alpha = (values[6 * k : 6 * k + 6] for k in range(4))
    return Calibration(theta, a, d, alpha, f"{zlib.crc32(data[: _KINEMATICS.size]):08X}")


def read_state(address: str, timeout: float = 3.0) -> RobotState:
    """The robot's state; see `read_parts`."""
    return robot_state(read_parts(address, timeout))


def read_parts(address: str, timeout: float = 3.0) -> dict[int, bytes]:
    """The parts of the robot's state by type, once all have arrived.

    Args:
        address: of the controller.
        timeout: longest wait [s]; at most half of it is spent on parts that may be missing.

    Raises:
        PrimaryError: no state arrived, or it cannot be read.
    """
    begin, pending, parts = time.monotonic(), b"", dict[int, bytes]()
    needed, welcome = {JOINTS, CARTESIAN}, {SAFETY, CONFIGURATION, KINEMATICS}
    try:
        with socket.create_connection((address, PORT), timeout=timeout) as connection:
            while not (needed | welcome) <= parts.keys():
                spent = time.monotonic() - begin
                if spent > timeout or (needed <= parts.keys() and spent > timeout / 2.0):
                    break
                data = connection.recv(65536)
                if not data:
                    break
                packages, pending = split(pending + data)
                for kind, body in packages:
                    if kind == STATE:
                        parts |= dict(split(body)[0])
    except (OSError, PrimaryError) as error:
        raise PrimaryError(f"the primary port at {address} can't be read: {error}") from error
    if not needed <= parts.keys():
        raise PrimaryError(f"the primary port at {address} sent no robot state within {timeout:g} s")
    return parts


READ_BY_THEN = 0.3
"""Time for which a connection stays open after its command [s]; the controller sends states meanwhile."""


def send_command(address: str, command: str, timeout: float = STATE_TIMEOUT) -> None:
    """Send a command of the primary interface, such as 'stop program', over a connection of its own.

    There is no reply, and a connection in local control ignores it without a word.

    Args:
        address: of the controller.
        command: without the end of line.
        timeout: for the connection [s].

    Raises:
        PrimaryError: the port cannot be reached.

    Source: the manufacturer's client library, for PolyScope X. Unconfirmed on a robot.
    """
    try:
        with socket.create_connection((address, PORT), timeout=timeout) as connection:
            connection.recv(1)  # the controller has accepted the connection
            connection.sendall(command.encode() + b"\n")
            end = time.monotonic() + READ_BY_THEN
            while time.monotonic() < end and connection.recv(65536):  # a connection that closes at once may be ignored
                pass
    except OSError as error:
        raise PrimaryError(f"{address}:{PORT}: {error}") from error


class Primary:
    """One connection, read by a thread until it is closed.

    Args:
        address: of the controller.
        timeout: for its first state [s].

    Attributes:
        complaints: its latest messages about programs.
        causes: its latest error codes, as for a protective stop, with their meaning.
        broken: it reported that a program cannot be read, or cannot continue.

    Raises:
        PrimaryError: it cannot be reached, or sends no state.
    """

    def __init__(self, address: str, timeout: float = STATE_TIMEOUT) -> None:
        self.complaints: deque[str] = deque(maxlen=8)
        self.causes: deque[str] = deque(maxlen=4)
        self.broken = False
        self._rest = b""
        try:
            self._socket = socket.create_connection((address, PORT), timeout=timeout)
            end = time.monotonic() + timeout
            while not self._take(self._socket.recv(65536)):
                if time.monotonic() > end:
                    raise PrimaryError("it sends no robot state")
            self._socket.settimeout(None)
        except (OSError, PrimaryError) as error:
            raise PrimaryError(f"the primary interface at {address}:{PORT}: {error}") from error
        threading.Thread(target=self._read, name="primary", daemon=True).start()

    def upload(self, program: str) -> None:
        """Send a program.

        Raises:
            PrimaryError: the connection is lost.
        """
        try:
            self._socket.sendall(program.encode())
        except OSError as error:
            raise PrimaryError(f"the program can't be sent: {error}") from error

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _read(self) -> None:
        with contextlib.suppress(OSError, PrimaryError):
            while data := self._socket.recv(65536):
                self._take(data)

    def _take(self, data: bytes) -> bool:
        """Store the contents of messages; returns whether a robot state was among them."""
        if not data:
            raise PrimaryError(f"it {CLOSED}")
        packages, self._rest = split(self._rest + data)
        for kind, body in packages:
            if kind == _MESSAGE:
                self._message(body)
        return any(kind == STATE for kind, _ in packages)

    def _message(self, body: bytes) -> None:
        if len(body) < 10:
            return
        kind, content = body[9], body[10:]
        if kind == _EXCEPTION and len(content) >= 8:
            self.broken = True
            line = int.from_bytes(content[:4], "big", signed=True)
            self.complaints.append(f"line {line}: {content[8:].decode('utf-8', 'replace')}")
        elif kind == _KEY and len(content) >= 9:
            self.complaints.append(content[9 + content[8] :].decode("utf-8", "replace"))
        elif kind == _ERROR and len(content) >= 20:
            code, argument = struct.unpack_from(">2i", content)
            text = content[20:].decode("utf-8", "replace").strip("\0 ") or CAUSES.get(
                code, "see the log on the pendant"
            )
            self.causes.append(f"C{code}A{argument} ({text})")
            self.complaints.append(self.causes[-1])
