"""A serial port that may vanish and return: it reads lines and writes bytes, and every call has a deadline.

`Wire` is one open port, and `Counters` holds its statistics. The port is one of this machine, or `host:port` of a
serial server or a balance in the network (`TcpPort`). `look_at_port` returns the check of a serial port for
`decant robot check`. The meaning of the bytes belongs to the dialects.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import socket
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from actors.balance.balance_interface import LineSettingsError, NoConnectionError
from actors.balance.dialects.dialect import LineSettings
from actors.interfaces import DeviceCheck
from sim_engine.resources import require

if TYPE_CHECKING:
    from serial import Serial

try:
    from termios import error as _TermiosError  # noqa: N812
except ImportError:  # not on Windows, where it is not raised either
    _TermiosError = OSError  # type: ignore[misc, assignment]

Tap = Callable[[str, bytes], None]
"""Receives the bytes of a wire: direction 'out' (to the balance) or 'in', and the bytes."""

_TCP = re.compile(r"(?:\[(?P<v6>[0-9A-Fa-f:.%]+)\]|(?P<host>[A-Za-z0-9._-]+)):(?P<port>[0-9]{1,5})")
_CONNECT_TIME = 3.0
_WRITE_TIME = 2.0
_GLANCE = 0.02
"""Longest single wait for a character [s]; fixed, because pyserial reconfigures the whole port for another value."""


class PortLostError(NoConnectionError):
    """The port vanished while it was open."""


@dataclass
class Counters:
    """Statistics of a wire, for `doctor` and for error messages.

    Attributes:
        lines: valid lines.
        other: valid lines with another quantity than the weight, such as a tare.
        damaged: invalid lines.
        stale: unread lines that were discarded before a new query.
        unanswered: queries without a reply.
        lost: lost connections.
    """

    lines: int = 0
    other: int = 0
    damaged: int = 0
    stale: int = 0
    unanswered: int = 0
    lost: int = 0


class Wire:
    """One open port with fixed line settings. Not thread-safe.

    Args:
        port: device.
        line: baud rate and character format.
        handshake: 'none', 'software' or 'hardware'.
        counters: where to count.
        tap: receives all bytes.
        dtr, rts: whether these wires are on while the port is open.

    Raises:
        LineSettingsError: the port cannot be set to that line.
        NoConnectionError: the port cannot be opened; the text gives the reason and a remedy.
    """

    def __init__(
        self,
        port: str,
        line: LineSettings,
        handshake: str = "none",
        counters: Counters | None = None,
        tap: Tap | None = None,
        *,
        dtr: bool = True,
        rts: bool = True,
    ) -> None:
        self.port, self.line = port, line
        self.received = bytearray()
        """All bytes since the last `flush`, as they came."""
        self.counters = counters or Counters()
        self._tap = tap
        self._buffer = bytearray()
        self._serial = _open(port, line, handshake, dtr=dtr, rts=rts)

    def send(self, data: bytes) -> None:
        """Write bytes.

        Raises:
            PortLostError: the port vanished, or does not accept the bytes.
        """
        try:
            self._serial.write(data)  # no drain: it has no deadline if the other side pauses the line
        except OSError as error:  # pyserial's errors are OSErrors
            raise self._lost(error) from error
        if self._tap is not None:
            self._tap("out", data)

    def flush(self) -> None:
        """Discard unread bytes; complete lines are counted as stale."""
        while self._pull(only_waiting=True):
            pass
        self.counters.stale += self._buffer.count(b"\n")
        self._buffer.clear()
        self.received.clear()

    def line_until(self, moment: float) -> bytes | None:
        """Return the next line, without its end.

        Args:
            moment: deadline of `time.monotonic`.

        Returns:
            None if no complete line came by then.

        Raises:
            PortLostError: the port vanished.
        """
        while True:
            end = self._buffer.find(b"\n")
            if end >= 0:
                line = bytes(self._buffer[:end])
                del self._buffer[: end + 1]
                return line.rstrip(b"\r")  # also CR CR LF, as some printers and serial servers send
            ends = moment <= time.monotonic()  # then only with what has come: this process may be late
            if not self._pull(only_waiting=ends) and ends:
                return None

    @property
    def waiting(self) -> bool:
        """Whether bytes without a line end have been received."""
        return bool(self._buffer)

    def take(self) -> bytes:
        """Remove and return the received bytes that have no line end yet."""
        chunk = bytes(self._buffer)
        self._buffer.clear()
        return chunk

    def close(self) -> None:
        """Close the port; never fails."""
        for step in (self._serial.reset_output_buffer, self._serial.close):  # unsent bytes would delay the close
            with contextlib.suppress(OSError, _TermiosError):
                step()

    def _pull(self, *, only_waiting: bool = False) -> bool:
        """Read the received bytes, or wait briefly for a first character; return whether any came."""
        try:
            count = self._serial.in_waiting
            data = self._serial.read(count or 1) if count or not only_waiting else b""
        except OSError as error:
            raise self._lost(error) from error
        except TypeError as error:  # pyserial, if another thread closes the port during a read
            raise self._lost(OSError("closed")) from error
        if data and self._tap is not None:
            self._tap("in", data)
        self._buffer += data
        self.received += data
        return bool(data)

    def _lost(self, error: OSError) -> PortLostError:
        self.counters.lost += 1
        self.close()
        return PortLostError(f"{self.port}: the connection was lost ({error.strerror or error})")


def tcp_address(port: str) -> tuple[str, int] | None:
    """Host and port of `host:port` or `[IPv6]:port`; None for a port of this machine."""
    match = _TCP.fullmatch(port)
    return None if match is None else (match["v6"] or match["host"], int(match["port"]))


class TcpPort:
    """A TCP connection with the part of pyserial's interface that a wire uses.

    pyserial's own `socket://` reads single bytes, and its errors do not say what to check.

    Raises:
        NoConnectionError: no connection; the text gives the reason and a remedy.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._socket = socket.create_connection((host, port), timeout=_CONNECT_TIME)
        except socket.gaierror as error:
            raise NoConnectionError(
                f"{host}:{port}: no host has this name; check it, or give its IP address"
            ) from error
        except ConnectionRefusedError as error:
            raise NoConnectionError(
                f"{host}:{port}: the host is there, but nothing listens on port {port}. Check the port's number and "
                "the mode of the serial server (TCP server, raw), and that no other program has it open"
            ) from error
        except (OSError, OverflowError) as error:
            raise NoConnectionError(
                f"{host}:{port}: no answer from this address ({error}). Is the serial server switched on, is its "
                "network cable plugged in, is the address right and in this machine's network?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._socket.settimeout(_WRITE_TIME)

    @property
    def in_waiting(self) -> int:
        """Upper limit of the number of bytes that can be read now; 0 for none."""
        try:
            return 4096 if select.select([self._socket], [], [], 0.0)[0] else 0
        except ValueError:  # closed by another thread; `read` reports it
            return 1

    def read(self, size: int) -> bytes:
        """Return at most `size` bytes; none if none comes soon.

        Raises:
            OSError: the connection was closed.
        """
        try:
            if not select.select([self._socket], [], [], _GLANCE)[0]:
                return b""
            data = self._socket.recv(size)
        except ValueError:  # closed by another thread
            data = b""
        if not data:
            raise OSError("closed by the other side")
        return data

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._socket.sendall(data)

    def reset_output_buffer(self) -> None:
        """Do nothing: sent bytes are on their way."""

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def _open(port: str, line: LineSettings, handshake: str, *, dtr: bool, rts: bool) -> Serial | TcpPort:
    address = tcp_address(port)
    if address is not None:
        return TcpPort(*address)
    require("serial", f"balance at {port}")
    import serial

    try:
        opened = serial.Serial(
            None,  # not opened yet: DTR and RTS change when it opens
            line.baud,
            bytesize=line.bits,
            parity=line.parity,
            stopbits=line.stop,
            xonxoff=handshake == "software",
            rtscts=handshake == "hardware",
            timeout=_GLANCE,
            write_timeout=_WRITE_TIME,
            exclusive=True,
        )
        opened.dtr, opened.port = dtr, port
        if handshake != "hardware":  # then the handshake drives RTS
            opened.rts = rts
        opened.open()
        return opened
    except (_TermiosError, ValueError) as error:
        if isinstance(error, OSError):
            raise NoConnectionError(f"{port}: {_reason(port, error)}") from error
        raise LineSettingsError(f"{port}: can't be set to {line}") from error
    except OSError as error:  # pyserial's errors are OSErrors
        raise NoConnectionError(f"{port}: {_reason(port, error)}") from error


def _reason(port: str, error: OSError) -> str:
    """Return why a port cannot be opened, and a remedy."""
    number = error.errno
    if number == 2 or not Path(port).exists():
        present = ports()
        listed = f"there are {', '.join(present)}" if present else "no serial port of a balance is there"
        return f"there is no such port; {listed}. Is the cable plugged in and the balance switched on?"
    if number == 13:
        return "this user may not open it; add the user to the group that owns it (often 'dialout') and log in anew"
    if number in (11, 16) or "exclusively" in str(error):
        return "another program has it open; close that one (a terminal, another run)"
    return f"can't be opened: {error}"


def ports() -> list[str]:
    """Serial ports of this machine, by their persistent names if there are any."""
    by_id = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*"))
    if by_id:
        return by_id
    from serial.tools.list_ports import comports

    return sorted(port.device for port in comports())


def port_advice(port: str) -> str | None:
    """Return advice about an unstable port name; None if it is fine. 'ttyUSB0' may be another device after
    reconnection.

    Args:
        port: as in the settings.
    """
    path = Path(port)
    if not path.name.startswith(("ttyUSB", "ttyACM")) or path.parent != Path("/dev"):
        return None
    same = [link for link in Path("/dev/serial/by-id").glob("*") if link.resolve() == path]
    better = str(same[0]) if same else "its name under /dev/serial/by-id/"
    return f"it may be another device once something is plugged in anew; use {better}"


def look_at_port(name: str) -> DeviceCheck:
    """Check that a port of this machine exists, is a serial port, and may be opened; others are checked on connecting.

    Args:
        name: as in the laboratory's file.
    """
    if tcp_address(name) is not None:
        return DeviceCheck("balance port", "ok", f"{name}, over TCP")
    port = Path(name)
    if not port.exists():
        present = ports()
        listed = f"there are {', '.join(present)}" if present else "no serial port is there"
        return DeviceCheck("balance port", "fail", f"{port} isn't there", f"plug the cable in, switch it on; {listed}")
    if (other := _other_than_a_port(port)) is not None:
        return DeviceCheck("balance port", "fail", f"{port} is {other}", "name the serial port that the balance is on")
    if not os.access(port, os.R_OK | os.W_OK):
        todo = f"add the user to the group '{_group(port)}' and log in anew"
        return DeviceCheck("balance port", "fail", f"this user may not open {port}", todo)
    if (advice := port_advice(name)) is not None:
        return DeviceCheck("balance port", "warn", str(port), advice)
    return DeviceCheck("balance port", "ok", str(port))


def _group(port: Path) -> str:
    try:
        return port.group()
    except (KeyError, OSError):
        return "dialout"


def _other_than_a_port(port: Path) -> str | None:
    """Return what kind of file the port is, if it is not a serial port; None if it is one, or cannot be opened."""
    if port.is_dir():
        return "a folder"
    if not stat.S_ISCHR(port.stat().st_mode):
        return "a file"
    try:
        opened = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        return None if os.isatty(opened) else "a device, and not a serial port"
    finally:
        os.close(opened)
