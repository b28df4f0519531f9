"""RTDE on port 30004: several clients at once, each with its recipes and its rate.

`RtdeServer` holds the readable fields and the owners of inputs; `RtdeConnection` is one client. Fields and recipes are
in `rtde_fields`.
"""

from __future__ import annotations

import struct

from actors.arm.ur import rtde
from actors.arm.ur.rtde import PackageError, PackageReader
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.rtde_fields import (
    INPUT_KINDS,
    InputRecipe,
    OutputRecipe,
    output_fields,
    text_message,
    write,
)
from actors.emulators.ur_controller.servers.connections import Connection, Connections

PORT = 30004

SLOWEST = 0.1
"""Lowest rate of outputs [Hz]; a lower requested rate is raised to it."""

LONGEST_NAMES = 2048
"""Longest list of field names [bytes], according to the guide; longer lists are truncated."""


class RtdeServer:
    """All RTDE clients of one controller.

    Args:
        controller: source and target of the values.
        connections: all connections, including the RTDE clients.
    """

    def __init__(self, controller: Controller, connections: Connections) -> None:
        self.controller = controller
        self.connections = connections
        self.fields = output_fields(controller)
        self.owners: dict[str, RtdeConnection] = {}

    def publish(self, clock: float) -> None:
        """Send every client the values that are due.

        Args:
            clock: reference for the rates [s]: wall time if time is scaled up, otherwise controller time.
        """
        if self.connections.silent:
            return
        for connection in list(self.connections.open):
            if isinstance(connection, RtdeConnection):
                connection.publish(clock)


class RtdeConnection(Connection):
    """One client.

    Args:
        server: its server.
    """

    def __init__(self, server: RtdeServer) -> None:
        super().__init__(server.connections)
        self._server = server
        self._packages = PackageReader()
        self._protocol = 1
        self._outputs: OutputRecipe | None = None
        self._recipes = 0
        self._inputs: dict[int, InputRecipe] = {}
        self._interval = 0.0
        self._due = 0.0
        self._started = False

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        super().connection_lost(exc)
        for name in [name for name, owner in self._server.owners.items() if owner is self]:
            del self._server.owners[name]

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        try:
            for kind, payload in self._packages.feed(data):
                self._handle(kind, payload)
        except PackageError:
            self.drop()

    # ---- protocol

    def _send(self, kind: int, payload: bytes) -> None:
        self.send(rtde.package(kind, payload))

    def _handle(self, kind: int, payload: bytes) -> None:
        match kind:
            case rtde.REQUEST_PROTOCOL_VERSION:
                supported = len(payload) == 2 and payload[0] == 0 and payload[1] in (1, 2)
                if supported:
                    self._protocol = payload[1]
                self._send(kind, bytes([supported]))
            case rtde.GET_URCONTROL_VERSION:
                self._send(kind, struct.pack(">4I", *self.controller.model.version))
            case rtde.SETUP_OUTPUTS:
                self._setup_outputs(payload)
            case rtde.SETUP_INPUTS:
                self._setup_inputs(payload)
            case rtde.START:
                self._started = self._outputs is not None
                self._due = 0.0
                self._send(kind, bytes([self._started]))
            case rtde.PAUSE:
                self._started = False
                self._send(kind, b"\1")
            case rtde.DATA_PACKAGE:
                self._data(payload)
            case rtde.TEXT_MESSAGE:
                pass
            case _:
                self._report_error(f"unknown package type {kind}")

    def _report_error(self, text: str) -> None:
        # Not before the start: during its setup, a client takes the next message for its reply.
        if self._started:
            self.send(text_message(self._protocol, text, "RTDE", 1))

    def _setup_outputs(self, payload: bytes) -> None:
        highest = self.controller.frequency
        frequency = highest
        if self._protocol == 2:
            if len(payload) < 8:
                self._send(rtde.SETUP_OUTPUTS, b"\0")
                return
            (frequency,) = struct.unpack_from(">d", payload)
            payload = payload[8:]
        if not SLOWEST <= frequency <= highest:  # also for NaN
            frequency = SLOWEST if frequency < SLOWEST else highest
        names = rtde.names(payload[:LONGEST_NAMES])
        kinds = [self._server.fields[n].kind if n in self._server.fields else "NOT_FOUND" for n in names]
        complete = bool(names) and "NOT_FOUND" not in kinds
        number = 1 if self._protocol == 2 else 0
        if complete:
            self._outputs = OutputRecipe(number, [self._server.fields[n] for n in names])
            self._interval = 1.0 / frequency
        head = bytes([number if complete else 0]) if self._protocol == 2 else b""
        self._send(rtde.SETUP_OUTPUTS, head + ",".join(kinds).encode())

    def _setup_inputs(self, payload: bytes) -> None:
        names, owners = rtde.names(payload[:LONGEST_NAMES]), self._server.owners
        kinds = []
        for name in names:
            if name not in INPUT_KINDS:
                kinds.append("NOT_FOUND")
            elif owners.get(name, self) is not self:
                kinds.append("IN_USE")
            else:
                kinds.append(INPUT_KINDS[name])
        complete = bool(names) and not {"NOT_FOUND", "IN_USE"} & set(kinds) and self._recipes < 255
        if complete:
            self._recipes += 1
            self._inputs[self._recipes] = InputRecipe(names, kinds)
            owners.update(dict.fromkeys(names, self))
        self._send(rtde.SETUP_INPUTS, bytes([self._recipes if complete else 0]) + ",".join(kinds).encode())

    def _data(self, payload: bytes) -> None:
        recipe = self._inputs.get(payload[0]) if payload else None
        values = recipe.read(payload[1:]) if recipe is not None else None
        if values is None:
            self._report_error("a data package that fits no recipe is ignored")
            return
        write(self.controller, values)

    def publish(self, clock: float) -> None:
        """Send the current values if they are due."""
        if not self._started or self._outputs is None or clock < self._due - 1e-9:
            return
        late = clock > self._due + self._interval
        self._due = (clock if late else self._due) + self._interval
        self.send(self._outputs.package())
