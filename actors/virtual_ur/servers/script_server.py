"""Program upload: text in, nothing out. On port 30003, and on the primary and secondary ports too."""

from __future__ import annotations

import asyncio

from actors.virtual_ur.controller import Controller
from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.lexer import Splitter

PORT = 30003


class ScriptClient(asyncio.Protocol):
    """One connection; its text is cut into programs, and each is run.

    Args:
        controller: runs them.
        clients: all connections of this kind; it adds and removes itself.
    """

    def __init__(self, controller: Controller, clients: set[ScriptClient]) -> None:
        self._controller = controller
        self._clients = clients
        self._splitter = Splitter()
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._clients.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self._clients.discard(self)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        try:
            programs = self._splitter.feed(data.decode("utf-8", "replace"))
        except ScriptError as error:
            self._controller.tell("exception", error.text)
            return
        for program in programs:
            self._controller.receive_program(program)

    def drop(self) -> None:
        """Cut the connection off."""
        if self.transport is not None:
            self.transport.abort()
