"""What `decant doctor` reads from a UR controller. Nothing moves, nothing is set."""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field

from actors.arm.ur import dashboard as dashboard_port
from actors.arm.ur import primary
from actors.arm.ur.primary import RobotState
from actors.arm.ur.survey import (
    PORTS,
    RTDE,
    Exchange,
    SurveyError,
    ask_dashboard,
    port_problem,
    read_exchange,
    read_state,
)

PATIENT_GAP = 0.1
"""Between two packages over RTDE [s]; beyond it they are looked at once more."""


@dataclass(frozen=True)
class Findings:
    """What was read from a controller; None where it couldn't be.

    Attributes:
        address: that the name stands for; '' if it stands for none.
        ports: why each can't be reached, None where it can.
        dashboard: answers by question.
    """

    address: str
    ports: dict[int, str | None] = field(default_factory=dict)
    dashboard: dict[str, str] | None = None
    state: RobotState | None = None
    exchange: Exchange | None = None
    problems: tuple[str, ...] = ()

    @property
    def software(self) -> tuple[int, ...]:
        """Version of the controller's software; empty if it isn't known."""
        if self.exchange is not None:
            return self.exchange.version
        told = re.search(r"(\d+)\.(\d+)\.(\d+)", (self.dashboard or {}).get("PolyscopeVersion", ""))
        return tuple(int(part) for part in told.groups()) if told else ()

    @property
    def serial(self) -> str:
        """Serial number of the robot; '' if it isn't known."""
        return (self.dashboard or {}).get("get serial number", "")

    @property
    def model(self) -> str:
        """As in laboratory files; '' if it isn't known."""
        name = (self.dashboard or {}).get("get robot model", "").lower()
        if not name or not self.software:
            return ""
        return name if name.endswith("e") or self.software[0] < 5 else f"{name}e"


def look_at(host: str) -> Findings:
    """Ask the controller everything.

    Args:
        host: its address or name.
    """
    try:
        address = socket.getaddrinfo(host, None, socket.AF_INET)[0][4][0]
    except OSError as error:
        return Findings("", problems=(str(error),))
    assert isinstance(address, str)
    ports = {port: port_problem(address, port) for port in PORTS}
    dashboard = state = exchange = None
    problems: list[str] = []
    if ports[dashboard_port.PORT] is None:
        with _noting(problems):
            dashboard = ask_dashboard(address)
    if ports[primary.PORT] is None:
        with _noting(problems):
            state = read_state(address)
    if ports[RTDE] is None:
        with _noting(problems):
            exchange = read_exchange(address)
            if exchange.gap > PATIENT_GAP:  # a hiccup of this computer, or the rule? The better of two tells
                exchange = min(exchange, read_exchange(address), key=lambda e: e.gap)
    return Findings(address, ports, dashboard, state, exchange, tuple(problems))


@contextlib.contextmanager
def _noting(problems: list[str]) -> Iterator[None]:
    try:
        yield
    except SurveyError as error:
        problems.append(str(error))
