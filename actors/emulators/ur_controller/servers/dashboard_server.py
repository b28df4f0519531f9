"""The dashboard on port 29999: one line per request, one line per reply.

`DashboardServer` answers the lines; `DashboardConnection` is one client.
"""

from __future__ import annotations

from collections.abc import Callable

from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.servers.connections import Connection, Connections

PORT = 29999

GREETING = "Connected: Universal Robots Dashboard Server"

REFUSAL = (
    "Command is not allowed due to safety reasons, "
    "please switch robot to Remote Control mode and reconnect to port 29999"
)

LONGEST_LINE = 10_000


class DashboardServer:
    """Answers lines. It uses no sockets.

    Args:
        controller: executes the commands.
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
            ("version", lambda _: "{}.{}.{}.{}".format(*c.model.version), False),
            ("get robot model", lambda _: c.model.name, False),
            ("get serial number", lambda _: c.model.serial, False),
            ("is in remote control", lambda _: str(c.remote).lower(), False),
            ("get operational mode", lambda _: "NONE", False),
            ("set operational mode", lambda a: f"Setting operational mode: {a}", False),
            ("clear operational mode", lambda _: "operational mode is no longer controlled by Dashboard Server", False),
            ("setUserRole", self._set_role, False),
            ("getUserRole", lambda _: self._role, False),
        ]

    def answer(self, line: str, privileged: bool = True) -> str:
        """Return the reply to a line.

        Args:
            line: as sent.
            privileged: whether it came over a connection that may send commands.
        """
        command = " ".join(line.split())
        for name, do, remote_only in self._commands:
            if command.lower() == name.lower() or command.lower().startswith(name.lower() + " "):
                if remote_only and not privileged:
                    return REFUSAL
                return do(command[len(name) + 1 :])
        return f"could not understand: '{command[:200]}'"

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


class DashboardConnection(Connection):
    """One connection.

    Args:
        connections: set to which it adds itself.
        dashboard: answers the lines.
    """

    def __init__(self, connections: Connections, dashboard: DashboardServer) -> None:
        super().__init__(connections)
        self._dashboard = dashboard
        self._rest = b""

    def greet(self) -> None:
        """See `Connection.greet`."""
        self.send(f"{GREETING}\n".encode())

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            self.drop()
            return
        for line in lines:
            text = line.decode("utf-8", "replace").strip()
            if not text:
                continue
            self.send(f"{self._dashboard.answer(text, self.privileged)}\n".encode())
            if text.lower() == "quit":
                self.finish()
                return
