"""The Robot API of PolyScope X, with the queries and answers of the dashboard, which PolyScope X does not have.

`RobotApi` has the interface of `actors.arm.ur.dashboard.Dashboard`; each query is one HTTP request (JSON).

Source: paths, actions and answers are those of the manufacturer's client library and of other public clients (Robot API
5.0, PolyScope X 10.14). Nothing was tried on PolyScope X. Unconfirmed: the texts of refusals, and whether `stop`
succeeds if no program runs; so it is not sent then.
"""

from __future__ import annotations

import http.client
import json
from typing import Any

PORTS = (80, 8000)
"""Of a robot; of the manufacturer's simulator, as its documentation maps it."""

ROOT = "/universal-robots/robot-api"

_READS = {
    "polyscopeversion": ("/versions/v1", "marketingVersion", "PolyScope X {}"),
    "get robot model": ("/system/v1/information", "robotType", "{}"),
    "get serial number": ("/system/v1/information", "serialNumber", "{}"),
    "is in remote control": ("/system/v1/controlmode", "mode", "{}"),
    "robotmode": ("/robotstate/v1/robotmode", "mode", "Robotmode: {}"),
    "safetystatus": ("/robotstate/v1/safetymode", "mode", "Safetystatus: {}"),
    "programstate": ("/program/v1/state", "state", "{}"),
}
"""Query → path, key of the answer, and the dashboard's text."""

_STATE = "/robotstate/v1/state"
_COMMANDS = {
    "power on": (_STATE, "POWER_ON", "Powering on"),
    "power off": (_STATE, "POWER_OFF", "Powering off"),
    "brake release": (_STATE, "BRAKE_RELEASE", "Brake releasing"),
    "unlock protective stop": (_STATE, "UNLOCK_PROTECTIVE_STOP", "Protective stop releasing"),
    "restart safety": (_STATE, "RESTART_SAFETY", "Restarting safety"),
    "stop": ("/program/v1/state", "stop", "Stopped"),
}
"""Command → path, action, and the dashboard's text."""

_POPUPS = {"close popup": "/popup/v1", "close safety popup": "/popup/v1/safety"}


class RobotApiError(Exception):
    """The Robot API cannot be reached, or refuses a command."""


class RobotApi:
    """The Robot API of one controller.

    Args:
        address: of the controller.
        timeout: for each response [s].

    Attributes:
        port: at which it answers.

    Raises:
        RobotApiError: no port answers as a Robot API does.
    """

    def __init__(self, address: str, timeout: float) -> None:
        self._address, self._timeout = address, timeout
        for port in PORTS:
            self.port = port
            try:
                status, answer = self._request("GET", "/robotstate/v1/robotmode")
            except RobotApiError:
                continue
            if status == 200 and "mode" in answer:
                return
        ports = " and ".join(map(str, PORTS))
        raise RobotApiError(f"no Robot API of PolyScope X at {address}, ports {ports}")

    def ask(self, line: str) -> str:
        """Answer a line of the dashboard.

        Raises:
            RobotApiError: there is no answer, or none to this line.
        """
        query = line.lower()
        if query in _READS:
            path, key, text = _READS[query]
            status, answer = self._request("GET", path)
            if status != 200 or key not in answer:
                shown = _shown(status, answer)
                raise RobotApiError(
                    f"Robot API: {path} was answered with {shown}; PolyScope X 10.14 or later is needed"
                )
            value = str(answer[key])
            return str(value == "REMOTE").lower() if query == "is in remote control" else text.format(value)
        if query in _POPUPS:
            self._request("DELETE", _POPUPS[query])  # there may be none, and older versions do not know the path
            return "closing popup"
        if query not in _COMMANDS:
            raise RobotApiError(f"Robot API: there is nothing like the dashboard's '{line}'")
        if query == "stop" and self.ask("programState").upper().startswith("STOPPED"):
            return "Stopped"
        path, action, text = _COMMANDS[query]
        status, answer = self._request("PUT", path, {"action": action})
        if status == 403:
            raise RobotApiError(f"Robot API: '{action}' is refused in local control; switch to remote control")
        return text if 200 <= status < 300 else _shown(status, answer)

    def _request(self, method: str, path: str, body: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """Status and JSON of an answer; an empty one if it has no JSON object."""
        connection = http.client.HTTPConnection(self._address, self.port, timeout=self._timeout)
        try:
            text = None if body is None else json.dumps(body)
            connection.request(method, ROOT + path, text, {"Content-Type": "application/json"})
            response = connection.getresponse()
            data = response.read()
        except (OSError, http.client.HTTPException) as error:
            raise RobotApiError(f"Robot API of {self._address}:{self.port}: {error}") from error
        finally:
            connection.close()
        try:
            answer = json.loads(data)
        except ValueError:
            answer = {}
        return response.status, answer if isinstance(answer, dict) else {}


def _shown(status: int, answer: dict[str, Any]) -> str:
    return str(answer.get("message") or f"status {status}")
