"""The primary interface: programs go there, and the robot's state and its complaints come from there.

A package is `int32 size, uint8 type, …`, big-endian; a robot state (16) consists of sub-packages of the same shape.

Source: the manufacturer's page on primary and secondary interfaces; the safety data's first four bytes are the
checksum, as was said in the manufacturer's forum.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections import deque

PORT = 30001
PATIENCE = 2.0
"""Longest wait for the first robot state [s]."""

_LONGEST = 1_000_000
_STATE, _MESSAGE = 16, 20
_CARTESIAN, _CONFIGURATION, _SAFETY = 4, 6, 10
_ERROR, _KEY, _EXCEPTION = 6, 7, 10
_HEAD = struct.Struct(">iB")


class PrimaryError(Exception):
    """It can't be reached, or says nothing that can be understood."""


def split(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Whole packages in a row, as type and body, and what is left.

    Raises:
        PrimaryError: a size that can't be.
    """
    found, place = [], 0
    while len(data) - place >= _HEAD.size:
        size, kind = _HEAD.unpack_from(data, place)
        if not _HEAD.size <= size <= _LONGEST:
            raise PrimaryError(f"a package of {size} bytes")
        if len(data) - place < size:
            break
        found.append((kind, data[place + _HEAD.size : place + size]))
        place += size
    return found, data[place:]


class Primary:
    """One connection, read by a thread until it is closed.

    Args:
        address: of the controller.

    Attributes:
        checksum: of the safety configuration, eight hexadecimal digits; '' if it is not told.
        tool: TCP in the flange's frame.
        ranges, speeds: limits of the joints [rad], [rad/s]; empty where they aren't told.
        complaints: the last things it said about programs.
        broken: it said that a program can't be read, or can't go on.

    Raises:
        PrimaryError: it can't be reached, or sends no state.
    """

    def __init__(self, address: str) -> None:
        self.checksum = ""
        self.tool: tuple[float, ...] = ()
        self.ranges: tuple[tuple[float, float], ...] = ()
        self.speeds: tuple[float, ...] = ()
        self.complaints: deque[str] = deque(maxlen=8)
        self.broken = False
        self._rest = b""
        try:
            self._socket = socket.create_connection((address, PORT), timeout=PATIENCE)
            end = time.monotonic() + PATIENCE
            while self.tool == ():
                if time.monotonic() > end:
                    raise PrimaryError(f"{address}:{PORT} sends no robot state")
                self._take(self._socket.recv(65536))
            self._socket.settimeout(None)
        except OSError as error:
            raise PrimaryError(f"{address}:{PORT}: {error}") from error
        threading.Thread(target=self._read, name="primary", daemon=True).start()

    def upload(self, program: str) -> None:
        """Send a program.

        Raises:
            PrimaryError: the connection is gone.
        """
        try:
            self._socket.sendall(program.encode())
        except OSError as error:
            raise PrimaryError(f"the program can't be sent: {error}") from error

    def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _read(self) -> None:
        with contextlib.suppress(OSError, PrimaryError):
            while data := self._socket.recv(65536):
                self._take(data, whole=False)

    def _take(self, data: bytes, *, whole: bool = True) -> None:
        if not data:
            raise PrimaryError("hung up")
        packages, self._rest = split(self._rest + data)
        for kind, body in packages:
            if kind == _STATE and whole:
                self._state(body)
            elif kind == _MESSAGE:
                self._message(body)

    def _state(self, body: bytes) -> None:
        parts = dict(split(body)[0])
        if len(parts.get(_SAFETY, b"")) >= 4:
            self.checksum = f"{int.from_bytes(parts[_SAFETY][:4], 'big'):08X}"
        if len(parts.get(_CARTESIAN, b"")) >= 96:
            self.tool = struct.unpack_from(">6d", parts[_CARTESIAN], 48)
        if len(parts.get(_CONFIGURATION, b"")) >= 24 * 8:
            numbers = struct.unpack_from(">24d", parts[_CONFIGURATION])
            self.ranges = tuple(zip(numbers[0:12:2], numbers[1:12:2], strict=True))
            self.speeds = numbers[12:24:2]

    def _message(self, body: bytes) -> None:
        if len(body) < 10:
            return
        kind, rest = body[9], body[10:]
        if kind == _EXCEPTION and len(rest) >= 8:
            self.broken = True
            line = int.from_bytes(rest[:4], "big", signed=True)
            self.complaints.append(f"line {line}: {rest[8:].decode('utf-8', 'replace')}")
        elif kind == _KEY and len(rest) >= 9:
            self.complaints.append(rest[9 + rest[8] :].decode("utf-8", "replace"))
        elif kind == _ERROR and len(rest) >= 20:
            code = int.from_bytes(rest[:4], "big", signed=True)
            self.complaints.append(f"C{code}: {rest[20:].decode('utf-8', 'replace')}")
