"""Program upload on port 30003: text in, nothing out. A real controller also streams its state here."""

from __future__ import annotations

from actors.virtual_ur.servers.connections import Connection, Connections
from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.lexer import Splitter

PORT = 30003


class ScriptConnection(Connection):
    """One connection; its text is cut into programs, and each is run."""

    def __init__(self, connections: Connections) -> None:
        super().__init__(connections)
        self._splitter = Splitter()

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        try:
            programs = self._splitter.feed(data.decode("utf-8", "replace"))
        except ScriptError as error:
            self.controller.tell("exception", error.text)
            self.drop()  # what follows can't be distinguished from programs
            return
        for program in programs:
            self.connections.uploads.put(program, self)

    def refuse(self) -> None:
        """A program came over a connection that may only read."""
        self.controller.tell(
            "key", "a program was ignored: the connection is read-only, the robot was in local control"
        )
