"""The common parts of a controller's TCP connections, and the script port.

`Connection` can be silenced and closed, and may be privileged to send commands; `Connections` is the set of all of
them. `ScriptConnection` on port 30003 accepts programs and sends nothing. A real controller also streams its state
there.
"""

from __future__ import annotations

import asyncio
import socket

from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.program_uploads import Uploads
from actors.emulators.ur_controller.urscript.lexer import ScriptError, Splitter

MOST_UNSENT = 1_000_000
"""Unread bytes above which a client is disconnected."""


class Connections:
    """All connections of one controller.

    Args:
        controller: the controller that they serve.

    Attributes:
        uploads: programs that came over them.
    """

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self.uploads = Uploads(controller)
        self.open: set[Connection] = set()
        self._silent = False

    @property
    def silent(self) -> bool:
        """Whether nothing is read or sent; connections stay, and new ones are accepted."""
        return self._silent

    def silence(self, active: bool) -> None:
        """Stop reading and sending, or resume; input that arrived in between is read then."""
        self._silent = active
        for connection in list(self.open):
            connection.hold(active)

    def drop(self, *kinds: type[Connection]) -> None:
        """Disconnect all connections, or those of some kinds."""
        for connection in list(self.open):
            if not kinds or isinstance(connection, kinds):
                connection.drop()


class Connection(asyncio.Protocol):
    """One TCP connection.

    Args:
        connections: set to which it adds itself and from which it removes itself.
    """

    def __init__(self, connections: Connections) -> None:
        self.connections = connections
        self.controller = connections.controller
        self._transport: asyncio.Transport | None = None
        self._privileged = not self.controller.local
        self._switches = self.controller.switches
        self._held = False
        self._waits = False

    @property
    def privileged(self) -> bool:
        """Whether it may send commands: it was opened in remote control, and the mode was not switched since."""
        remote_control = self.controller.model.remote_control
        return not remote_control or (self._privileged and self._switches == self.controller.switches)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""
        assert isinstance(transport, asyncio.Transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._transport = transport
        self.connections.open.add(self)
        if self.connections.silent:
            self.hold(True)
        else:
            self.greet()

    def greet(self) -> None:
        """Send the first bytes of a connection; none by default."""

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self.connections.open.discard(self)
        self._transport = None

    def send(self, data: bytes) -> None:
        """Send bytes; a client with too many unread bytes is disconnected."""
        if self._transport is None or self._transport.is_closing() or self.connections.silent:
            return
        if self._transport.get_write_buffer_size() > MOST_UNSENT:
            self.drop()
        else:
            self._transport.write(data)

    def hold(self, active: bool) -> None:
        """Stop reading while the connection is silenced, or resume."""
        self._held = active
        self._read()

    def wait(self, active: bool) -> None:
        """Stop reading while earlier input is being processed, or resume."""
        self._waits = active
        self._read()

    def _read(self) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        if self._held or self._waits:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def finish(self) -> None:
        """Close after everything is sent."""
        if self._transport is not None:
            self._transport.close()

    def drop(self) -> None:
        """Disconnect with a reset."""
        if self._transport is not None:
            self._transport.abort()


PORT = 30003


class ScriptConnection(Connection):
    """One connection; its text is split into programs, and each is run."""

    def __init__(self, connections: Connections) -> None:
        super().__init__(connections)
        self._splitter = Splitter()

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        try:
            programs = self._splitter.feed(data.decode("utf-8", "replace"))
        except ScriptError as error:
            self.controller.tell("exception", error.text)
            self.drop()  # the boundaries of later programs are unknown
            return
        for program in programs:
            self.connections.uploads.put(program, self)

    def refuse(self) -> None:
        """Reject a program from a read-only connection."""
        self.controller.tell(
            "key", "a program was ignored: the connection is read-only, the robot was in local control"
        )
