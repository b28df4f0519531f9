"""The dashboard interface over a plain socket. It can also stop a program when the other interfaces do not respond.

PolyScope X has no dashboard: `Dashboard` then uses its Robot API, with the same queries and answers.
"""

from __future__ import annotations

import socket

from actors.arm.ur.primary_interface import PrimaryError, send_command
from actors.arm.ur.robot_api import RobotApi, RobotApiError
from actors.arm.ur.rtde import CLOSED

PORT = 29999
REPLY_TIMEOUT = 1.5
"""Longest wait for a connection or a response [s]."""


class DashboardError(Exception):
    """The dashboard cannot be reached, or refuses a command."""


class Dashboard:
    """One connection; a context manager.

    Open a new one for each purpose: a connection from before a switch between local and remote control does not work.

    Args:
        address: of the controller.
        timeout: for each response [s].

    Raises:
        DashboardError: the dashboard cannot be reached.
    """

    def __init__(self, address: str, timeout: float = REPLY_TIMEOUT) -> None:
        self._api: RobotApi | None = None
        self._address, self._timeout = address, timeout
        try:
            self._socket = socket.create_connection((address, PORT), timeout=timeout)
            self._lines = self._socket.makefile("rb")
            self._read("its greeting")
        except ConnectionRefusedError as error:
            try:
                self._api = RobotApi(address, timeout)
            except RobotApiError as also:
                raise DashboardError(f"dashboard of {address}:{PORT}: {error}; {also}") from error
        except OSError as error:
            raise DashboardError(f"dashboard of {address}:{PORT}: {error}") from error

    @property
    def port(self) -> int:
        """At which it answers: the dashboard's, or the Robot API's."""
        return PORT if self._api is None else self._api.port

    def ask(self, line: str) -> str:
        """Send a line. Returns the response.

        Raises:
            DashboardError: there is none.
        """
        try:
            if self._api is not None:
                return self._api.ask(line)
            self._socket.sendall(line.encode() + b"\n")
        except RobotApiError as error:
            raise DashboardError(str(error)) from error
        except OSError as error:
            raise DashboardError(f"the dashboard at {self._address}:{PORT} {CLOSED} ({error})") from error
        return self._read(f"its answer to '{line}'")

    def _read(self, what: str) -> str:
        """The next line.

        Args:
            what: is read, for messages.
        """
        where = f"the dashboard at {self._address}:{PORT}"
        try:
            answer = self._lines.readline()
        except TimeoutError:
            raise DashboardError(
                f"{where} accepts connections, but did not send {what} within {self._timeout:g} s: the controller is "
                "booting, or hangs. Wait a minute and try again; if it repeats, restart the controller"
            ) from None
        except OSError as error:
            raise DashboardError(f"{where} {CLOSED} ({error}, before {what})") from error
        if not answer:
            raise DashboardError(f"{where} {CLOSED} (before {what})")
        return answer.decode("utf-8", "replace").strip()

    def demand(self, line: str, expected: str) -> None:
        """Send a command and check its response.

        Raises:
            DashboardError: the response differs; the text contains it.
        """
        answer = self.ask(line)
        if not answer.lower().startswith(expected.lower()):
            raise DashboardError(f"dashboard: '{line}' was answered '{answer}'")

    def __enter__(self) -> Dashboard:
        return self

    def __exit__(self, *_: object) -> None:
        if self._api is None:
            self._lines.close()
            self._socket.close()


def stop_program(address: str, timeout: float = REPLY_TIMEOUT) -> None:
    """Stop the running program, whatever it is: over dashboard or Robot API, else over the primary interface.

    The primary interface does not reply: the caller has to watch the program's state over RTDE.

    Raises:
        DashboardError: no interface can be reached.
    """
    try:
        with Dashboard(address, timeout) as dashboard:
            dashboard.demand("stop", "Stopped")
    except DashboardError as error:
        try:
            send_command(address, "stop program", timeout)
        except PrimaryError as also:
            raise DashboardError(f"{error}; {also}") from error
