"""The dashboard's lines over a plain socket: also the way to stop a program when everything else hangs."""

from __future__ import annotations

import socket

PORT = 29999
PATIENCE = 1.5
"""Longest wait for a connection or an answer [s]."""


class DashboardError(Exception):
    """It can't be reached, or refuses."""


class Dashboard:
    """One connection; a context manager. Made anew for each purpose: one from before a switch of control is of no use.

    Args:
        address: of the controller.
        patience: for each answer [s].

    Raises:
        DashboardError: nobody is there.
    """

    def __init__(self, address: str, patience: float = PATIENCE) -> None:
        try:
            self._socket = socket.create_connection((address, PORT), timeout=patience)
            self._lines = self._socket.makefile("rb")
            self._lines.readline()
        except OSError as error:
            raise DashboardError(f"dashboard of {address}:{PORT}: {error}") from error

    def ask(self, line: str) -> str:
        """Send a line. Returns the answer.

        Raises:
            DashboardError: there is none.
        """
        try:
            self._socket.sendall(line.encode() + b"\n")
            answer = self._lines.readline()
        except OSError as error:
            raise DashboardError(f"dashboard: no answer to '{line}': {error}") from error
        if not answer:
            raise DashboardError(f"dashboard: hung up at '{line}'")
        return answer.decode("utf-8", "replace").strip()

    def demand(self, line: str, expected: str) -> None:
        """Send a command that must be answered by something.

        Raises:
            DashboardError: it is answered otherwise, with the answer.
        """
        answer = self.ask(line)
        if not answer.lower().startswith(expected.lower()):
            raise DashboardError(f"dashboard: '{line}' was answered '{answer}'")

    def __enter__(self) -> Dashboard:
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.close()
        self._socket.close()


def stop_program(address: str, patience: float = PATIENCE) -> None:
    """End whatever program runs.

    Raises:
        DashboardError: it can't be reached.
    """
    with Dashboard(address, patience) as dashboard:
        dashboard.demand("stop", "Stopped")
