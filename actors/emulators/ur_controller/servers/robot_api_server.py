"""The Robot API of PolyScope X: JSON over HTTP, on port 80, or 8000 if this machine does not permit port 80.

`answer` executes one request; `RobotApiConnection` is one client. The commands are those of the dashboard, of which it
offers a part.

Source: see `actors.arm.ur.robot_api`. Assumed: the texts of refusals; status 409 for a transition that is impossible;
that commands are executed at once and answered before their effect.
"""

from __future__ import annotations

import json
from typing import Any

from actors.arm.ur.robot_api import PORTS, ROOT
from actors.emulators.ur_controller.controller import Controller, RuntimeState
from actors.emulators.ur_controller.servers.connections import Connection, Connections

__all__ = ["PORTS", "RobotApiConnection", "answer"]

LONGEST_REQUEST = 10_000
_REASONS = {200: "OK", 403: "Forbidden", 404: "Not Found", 409: "Conflict", 422: "Unprocessable Entity"}


def answer(controller: Controller, method: str, path: str, body: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Status and JSON for a request.

    Args:
        controller: executes it.
        method: 'GET', 'PUT' or 'DELETE'.
        path: without `ROOT`.
        body: the JSON that was sent.
    """
    c = controller
    if method == "GET":
        return _read(c, path)
    if c.local:
        return 403, {"message": "Forbidden - Operation Not Allowed"}
    if method == "DELETE" and path in ("/popup/v1", "/popup/v1/safety"):
        if path.endswith("safety"):
            c.safety_popup = False
        else:
            c.popup = None
        return 200, {"message": "closed"}
    action = body.get("action")
    if (method, path) == ("PUT", "/program/v1/state"):
        actions = {"stop": lambda: _stopped(c), "pause": c.pause, "play": c.play, "resume": c.play}
        if action not in actions:
            return 422, {"message": f"unknown action {action!r}"}
        good = actions[str(action)]()
        return (200, {"message": "done"}) if good else (409, {"message": "Invalid state transition"})
    if (method, path) != ("PUT", "/robotstate/v1/state"):
        return 404, {"message": "not found"}
    refusal: str | None = None
    match action:
        case "POWER_ON":
            refusal = c.power_on()
        case "POWER_OFF":
            c.power_off()
        case "BRAKE_RELEASE":
            refusal = c.release_brakes()
        case "UNLOCK_PROTECTIVE_STOP":
            refusal = c.unlock_protective_stop()
        case "RESTART_SAFETY":
            c.restart_safety()
        case _:
            return 422, {"message": f"unknown action {action!r}"}
    return (200, {"message": "done"}) if refusal is None else (409, {"message": refusal})


def _stopped(controller: Controller) -> bool:
    running = controller.program is not None
    controller.stop()
    return running


def _read(c: Controller, path: str) -> tuple[int, dict[str, Any]]:
    program = {RuntimeState.PLAYING: "PLAYING", RuntimeState.RESUMING: "PLAYING", RuntimeState.PAUSED: "PAUSED"}
    emergency = c.safety.mode.name.endswith("EMERGENCY_STOP")
    answers: dict[str, dict[str, Any]] = {
        "/robotstate/v1/robotmode": {"mode": c.power.mode.name},
        "/robotstate/v1/safetymode": {"mode": "EMERGENCY_STOP" if emergency else c.safety.mode.name},
        "/program/v1/state": {"state": program.get(c.runtime, "STOPPED")},
        "/system/v1/controlmode": {"mode": "REMOTE" if c.remote else "LOCAL"},
        "/system/v1/operationalmode": {"mode": "AUTOMATIC"},
        "/system/v1/information": {"robotType": c.model.name, "serialNumber": c.model.serial},
        "/versions/v1": {"marketingVersion": "{}.{}.{}".format(*c.model.version)},
    }
    answer = answers.get(path)
    return (404, {"message": "not found"}) if answer is None else (200, answer | {"message": "ok"})


class RobotApiConnection(Connection):
    """One connection; each request is answered, and the connection closed."""

    def __init__(self, connections: Connections) -> None:
        super().__init__(connections)
        self._rest = b""

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        self._rest += data
        head, end, body = self._rest.partition(b"\r\n\r\n")
        if len(self._rest) > LONGEST_REQUEST:
            self.drop()
            return
        if not end:
            return
        first, *lines = head.decode("latin-1").split("\r\n")
        fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        length = fields.get("content-length", "0")
        if not length.isdigit() or len(body) < int(length):
            if not length.isdigit():
                self.drop()
            return
        self._answer(first.split(" "), body[: int(length)])

    def _answer(self, first: list[str], body: bytes) -> None:
        status, reply = 404, {"message": "not found"}
        if len(first) == 3 and first[1].startswith(ROOT):
            try:
                sent = json.loads(body or b"{}")
            except ValueError:
                sent = None
            if isinstance(sent, dict):
                status, reply = answer(self.controller, first[0], first[1].removeprefix(ROOT), sent)
            else:
                status, reply = 422, {"message": "not a JSON object"}
        data = json.dumps(reply).encode()
        head = f"HTTP/1.1 {status} {_REASONS[status]}\r\nContent-Type: application/json\r\nConnection: close\r\n"
        self.send(f"{head}Content-Length: {len(data)}\r\n\r\n".encode() + data)
        self.finish()
