"""Real-time data exchange (port 30004): packages and field types.

A package is `uint16 size, uint8 type, payload`, big-endian; the size includes these three bytes.

Source: the manufacturer's RTDE guide, and recordings of real clients.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from typing import Any

REQUEST_PROTOCOL_VERSION = ord("V")
GET_URCONTROL_VERSION = ord("v")
TEXT_MESSAGE = ord("M")
DATA_PACKAGE = ord("U")
SETUP_OUTPUTS = ord("O")
SETUP_INPUTS = ord("I")
START = ord("S")
PAUSE = ord("P")

PORT = 30004

CLOSED = (
    "closed the connection: the controller is booting or shutting down, was just switched between local and remote "
    "control, or does not admit this computer (PolyScope 5.10 or later: Settings, Security, Services, and inbound "
    "access under General). Wait a minute and try again; if it repeats, restart the controller"
)
"""What it means if a port of the controller accepts a connection and closes it, as part of a message; with the remedy.

Source: reports to the manufacturer's drivers. The dashboard of a restarted robot closes the first connection, and those
from before a switch to remote control (Universal_Robots_ROS_Driver #262, #258); services are enabled one by one
(Universal_Robots_ROS2_Driver #1224).
"""

HEADER = struct.Struct(">HB")

FORMATS: dict[str, tuple[str, int]] = {
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("3d", 3),
    "VECTOR6D": ("6d", 6),
    "VECTOR6INT32": ("6i", 6),
    "VECTOR6UINT32": ("6I", 6),
}
"""Struct format and number of values by RTDE type."""


class PackageError(Exception):
    """Bytes that are no valid package; the rest of the stream cannot be read."""


def package(kind: int, payload: bytes) -> bytes:
    """One package."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class PackageReader:
    """Splits a stream into packages."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Add bytes; yield each complete package's type and payload.

        Raises:
            PackageError: the size is invalid.
        """
        rest = self._rest
        rest += data
        while len(rest) >= HEADER.size:
            size, kind = HEADER.unpack_from(rest)
            if size < HEADER.size:
                raise PackageError(f"a package of {size} bytes")
            if len(rest) < size:
                return
            payload = bytes(rest[HEADER.size : size])
            del rest[:size]
            yield kind, payload


class Requests:
    """Requests and responses on one connection; `OSError` if it is lost."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._packages = PackageReader()
        self._waiting: list[tuple[int, bytes]] = []

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """Send a request. Returns the response of the same type."""
        self._connection.sendall(package(kind, payload))
        while True:
            got, answer = self.next()
            if got == kind:
                return answer

    def next(self) -> tuple[int, bytes]:
        """Type and payload of the next package."""
        while not self._waiting:
            data = self._connection.recv(65536)
            if not data:
                raise OSError(f"it {CLOSED}")
            self._waiting.extend(self._packages.feed(data))
        return self._waiting.pop(0)


def names(payload: bytes) -> list[str]:
    """Field names, separated by commas; some clients add a comma after the last one."""
    return [name.strip() for name in payload.decode("ascii", "replace").strip(",\0 \n").split(",") if name.strip()]


class Outputs:
    """Values that a controller sends at a rate over one connection.

    Args:
        requests: of the connection; protocol 2 is requested.
        fields: wanted; those that this controller lacks are left out, since it refuses a recipe that names one.
        rate: of packages [Hz].

    Attributes:
        fields: those that it sends.

    Raises:
        OSError: the connection is lost, or the controller refuses.
    """

    def __init__(self, requests: Requests, fields: Sequence[str], rate: float) -> None:
        self._requests = requests
        if requests.ask(REQUEST_PROTOCOL_VERSION, b"\0\2") != b"\1":
            raise OSError("it doesn't know protocol 2")
        kinds: dict[str, str] = {}
        while len(kinds) < len(fields):
            answer = requests.ask(SETUP_OUTPUTS, struct.pack(">d", rate) + ",".join(fields).encode("ascii"))
            kinds = {field: kind for field, kind in zip(fields, names(answer[1:]), strict=False) if kind in FORMATS}
            if not kinds:
                raise OSError(f"it knows none of {', '.join(fields)}")
            if len(kinds) < len(fields):
                fields, kinds = tuple(kinds), {}
        self.fields = tuple(kinds)
        self._counts = {field: FORMATS[kind][1] for field, kind in kinds.items()}
        self._layout = struct.Struct(">B" + "".join(FORMATS[kind][0] for kind in kinds.values()))
        if requests.ask(START) != b"\1":
            raise OSError("it doesn't begin to send")

    def next(self) -> bytes:
        """Wait for the next package; returns its payload, for `values`.

        Raises:
            OSError: the connection is lost.
            PackageError: it sends something else.
        """
        while True:
            kind, payload = self._requests.next()
            if kind == DATA_PACKAGE:
                if len(payload) != self._layout.size:
                    raise PackageError(f"a data package of {len(payload)} instead of {self._layout.size} bytes")
                return payload

    def values(self, payload: bytes) -> dict[str, tuple[Any, ...]]:
        """The values of a package, by field."""
        numbers = iter(self._layout.unpack(payload)[1:])
        return {field: tuple(next(numbers) for _ in range(count)) for field, count in self._counts.items()}
