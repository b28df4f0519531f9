"""The dashboard on port 29999: one line asks, one line answers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from actors.virtual_ur.controller import Controller

PORT = 29999

GREETING = "Connected: Universal Robots Dashboard Server"

LONGEST_LINE = 10_000


class Dashboard:
    """Answers lines. Knows no sockets.

    Args:
        controller: asked and told.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._role = "none"
        c = controller
        self._commands: list[tuple[str, Callable[[str], str], bool]] = [
            ("play", lambda _: "Starting program" if c.play() else "Failed to execute: play", True),
            ("stop", self._stop, True),
            ("pause", lambda _: "Pausing program" if c.pause() else "Failed to execute: pause", True),
            ("quit", lambda _: "Disconnected", False),
            ("shutdown", self._shutdown, True),
            ("running", lambda _: f"Program running: {str(c.playing).lower()}", False),
            ("robotmode", lambda _: f"Robotmode: {c.power.mode.name}", False),
            ("safetymode", lambda _: f"Safetymode: {c.safety.mode.name}", False),
            ("safetystatus", lambda _: f"Safetystatus: {c.safety.mode.name}", False),
            ("programState", self._program_state, False),
            ("get loaded program", lambda _: "No program loaded", False),
            ("load installation", lambda a: f"Failed to load installation: {a}", True),
            ("load", lambda a: f"File not found: {a}", True),
            ("isProgramSaved", lambda _: "true unnamed", False),
            ("popup", self._popup, False),
            ("close popup", self._close_popup, False),
            ("close safety popup", self._close_safety_popup, False),
            ("addToLog", self._log, False),
            ("unlock protective stop", self._unlock, True),
            ("power on", self._power_on, True),
            ("power off", self._power_off, True),
            ("brake release", self._release, True),
            ("restart safety", self._restart_safety, True),
            ("PolyscopeVersion", self._version, False),
            ("version", self._version, False),
            ("get robot model", lambda _: c.model.name, False),
            ("get serial number", lambda _: c.model.serial, False),
            ("is in remote control", lambda _: str(c.remote).lower(), False),
            ("get operational mode", lambda _: "NONE", False),
            ("set operational mode", lambda a: f"Setting operational mode: {a}", False),
            ("clear operational mode", lambda _: "No longer controlling the operational mode", False),
            ("setUserRole", self._set_role, False),
            ("getUserRole", lambda _: self._role, False),
        ]

    def answer(self, line: str) -> str:
        """What a line is answered with."""
        asked = " ".join(line.split())
        for name, do, remote_only in self._commands:
            if asked.lower() == name.lower() or asked.lower().startswith(name.lower() + " "):
                if remote_only and self._controller.model.remote_control and not self._controller.remote:
                    return "Command is not allowed due to safety reasons"
                return do(asked[len(name) + 1 :])
        return f"could not understand: '{asked[:200]}'"

    def _stop(self, _: str) -> str:
        self._controller.stop()
        return "Stopped"

    def _shutdown(self, _: str) -> str:
        self._controller.power_off()
        return "Shutting down"

    def _program_state(self, _: str) -> str:
        c = self._controller
        state = "STOPPED" if c.program is None else "PLAYING" if c.playing else "PAUSED"
        return f"{state} {c.program.name if c.program is not None else ''}".rstrip()

    def _popup(self, text: str) -> str:
        self._controller.popup = text
        return "showing popup"

    def _close_popup(self, _: str) -> str:
        self._controller.popup = None
        return "closing popup"

    def _close_safety_popup(self, _: str) -> str:
        self._controller.safety_popup = False
        return "closing safety popup"

    def _log(self, text: str) -> str:
        self._controller.tell("key", text)
        return "Added log message"

    def _unlock(self, _: str) -> str:
        refusal = self._controller.unlock_protective_stop()
        return refusal or "Protective stop releasing"

    def _power_on(self, _: str) -> str:
        return self._controller.power_on() or "Powering on"

    def _power_off(self, _: str) -> str:
        self._controller.power_off()
        return "Powering off"

    def _release(self, _: str) -> str:
        return self._controller.release_brakes() or "Brake releasing"

    def _restart_safety(self, _: str) -> str:
        self._controller.restart_safety()
        return "Restarting safety"

    def _version(self, _: str) -> str:
        return "URSoftware {}.{}.{}.{} (Jan 01 2022)".format(*self._controller.model.version)

    def _set_role(self, role: str) -> str:
        if role not in ("programmer", "operator", "none", "locked", "restricted"):
            return f"Failed setting user role: {role[:50]}"
        self._role = role
        return f"Setting user role: {role}"


class DashboardClient(asyncio.Protocol):
    """One connection.

    Args:
        dashboard: answers.
        clients: all connections of this kind; it adds and removes itself.
        silent: whether nothing is to be answered now.
    """

    def __init__(self, dashboard: Dashboard, clients: set[DashboardClient], silent: Callable[[], bool]) -> None:
        self._dashboard, self._clients, self._silent = dashboard, clients, silent
        self._rest = b""
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._clients.add(self)
        if not self._silent():
            transport.write(f"{GREETING}\n".encode())

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self._clients.discard(self)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        if self._silent() or self._transport is None:
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            self.drop()
            return
        for line in lines:
            text = line.decode("utf-8", "replace").strip()
            if not text:
                continue
            self._transport.write(f"{self._dashboard.answer(text)}\n".encode())
            if text.lower() == "quit":
                self._transport.close()
                return

    def drop(self) -> None:
        """Cut the connection off."""
        if self._transport is not None:
            self._transport.abort()
