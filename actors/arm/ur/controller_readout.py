"""Reads the state of a UR controller over plain sockets, one port at a time. Used by `decant robot check`.

It sends queries to the dashboard, reads the robot's state from the primary port and values over RTDE. None of these can
move the arm or change a setting. They also work in states in which a driver cannot connect, so that the user can find
the cause.

`look_at` returns `Findings`; `actors.arm.ur.commissioning` evaluates them. `recorded_findings` and `findings_of` write
and read them as JSON.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import socket
import statistics
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

from actors.arm.ur import dashboard as dashboard_port
from actors.arm.ur import primary_interface as primary
from actors.arm.ur import robot_api, rtde
from actors.arm.ur.dashboard import Dashboard, DashboardError
from actors.arm.ur.primary_interface import RobotState
from actors.arm.ur.robot_models import model_named
from actors.arm.ur.worker_messages import STANDSTILL
from actors.interfaces import LaboratoryError

SCRIPTS, RTDE = 30003, rtde.PORT
PORTS: dict[int, str] = {
    dashboard_port.PORT: "dashboard",
    **dict.fromkeys(robot_api.PORTS, "Robot API of PolyScope X"),
    primary.PORT: "primary interface",
    SCRIPTS: "programs",
    RTDE: "real-time data exchange",
}
"""Ports that Decant uses, with their names."""

QUESTIONS = (
    "PolyscopeVersion",
    "get robot model",
    "get serial number",
    "is in remote control",
    "robotmode",
    "safetystatus",
    "programState",
)
"""Queries on the dashboard; none of them changes anything."""

SLIDER = "target_speed_fraction"
STATUS = ("robot_mode", "safety_mode", "runtime_state", "robot_status_bits", SLIDER)
"""RTDE values that determine whether the arm can move."""

ROUND_TRIPS = 20


class ReadoutError(LaboratoryError):
    """A port does not respond, or its response cannot be understood."""


@dataclass(frozen=True)
class Exchange:
    """Values read over RTDE, and the quality of the network connection.

    Attributes:
        version: of the controller's software.
        payload: [kg], None if it is not reported.
        payload_centre: in the flange's frame [m], None if it is not reported.
        round_trip: median time from request to response [s].
        slowest: longest of them [s].
        rate: packages received per second, of `wanted` [Hz].
        gap: longest time between two packages [s].
    """

    version: tuple[int, ...]
    payload: float | None
    payload_centre: tuple[float, ...] | None
    round_trip: float
    slowest: float
    rate: float
    gap: float
    wanted: float
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def acceleration(self) -> tuple[float, ...] | None:
        """Acceleration that the tool measures, in its own frame [m/s²]: upwards at rest; None if it is not reported."""
        return self.values.get("actual_tool_accelerometer")

    @property
    def rests(self) -> bool:
        """Whether no joint moves."""
        return max(map(abs, self.values.get("actual_qd", (math.inf,)))) < STANDSTILL


def port_problem(address: str, port: int, timeout: float = 2.0) -> str | None:
    """Why a port cannot be reached; None if it is open."""
    try:
        with socket.create_connection((address, port), timeout=timeout):
            return None
    except ConnectionRefusedError:
        return "refused"
    except TimeoutError:
        return "no answer"
    except OSError as error:
        return error.strerror or str(error)


def ask_dashboard(address: str, questions: Sequence[str] = QUESTIONS, timeout: float = 3.0) -> dict[str, str]:
    """Responses of the dashboard, by query.

    Raises:
        ReadoutError: it does not respond.
    """
    try:
        with Dashboard(address, timeout) as dashboard:
            return {question: dashboard.ask(question) for question in questions}
    except DashboardError as error:
        raise ReadoutError(str(error)) from error


def read_exchange(address: str, rate: float = 125.0, seconds: float = 1.0, timeout: float = 3.0) -> Exchange:
    """Values over RTDE, round-trip times, and the regularity of packages.

    Args:
        address: of the controller.
        rate: requested rate of packages [Hz].
        seconds: time for which they are counted; 0 for one package, without timing.
        timeout: longest wait for a response [s].

    Raises:
        ReadoutError: it does not respond, or its response cannot be understood.
    """
    try:
        with socket.create_connection((address, RTDE), timeout=timeout) as connection:
            return _exchange(rtde.Requests(connection), rate, seconds)
    except (OSError, struct.error, rtde.PackageError) as error:
        raise ReadoutError(f"RTDE at {address} doesn't answer as it should: {error}") from error


def _exchange(connection: rtde.Requests, rate: float, seconds: float) -> Exchange:
    trips = []
    version: tuple[int, ...] = ()
    for _ in range(ROUND_TRIPS if seconds else 1):
        requested_at = time.monotonic()
        version = struct.unpack(">4I", connection.ask(rtde.GET_URCONTROL_VERSION)[:16])
        trips.append(time.monotonic() - requested_at)
    names = ("timestamp", "payload", "payload_cog", "actual_tool_accelerometer", "actual_qd", *STATUS)
    outputs = rtde.Outputs(connection, names, rate)
    arrivals: list[float] = []
    package, begin = b"", time.monotonic()
    while not arrivals or time.monotonic() - begin < seconds:
        package = outputs.next()
        arrivals.append(time.monotonic())
    if seconds and len(arrivals) < 2:
        raise OSError("it sends no packages")
    duration = arrivals[-1] - arrivals[0]
    values = outputs.values(package)
    payload_mass = values.get("payload")
    return Exchange(
        version=version,
        payload=None if payload_mass is None else payload_mass[0],
        payload_centre=values.get("payload_cog"),
        round_trip=statistics.median(trips),
        slowest=max(trips),
        rate=(len(arrivals) - 1) / duration if duration else 0.0,
        gap=max((b - a for a, b in itertools.pairwise(arrivals)), default=0.0),
        wanted=rate,
        values=values,
    )


PATIENT_GAP = 0.1
"""Longest normal time between two RTDE packages [s]; beyond it they are measured once more."""


@dataclass(frozen=True)
class Findings:
    """Values read from a controller; None if one could not be read.

    Attributes:
        address: to which the name resolves; '' if it does not.
        ports: why each cannot be reached; None if it can.
        dashboard: responses by query.
        parts: of the robot's state, as bytes by type.
    """

    address: str
    ports: dict[int, str | None] = field(default_factory=dict)
    dashboard: dict[str, str] | None = None
    parts: dict[int, bytes] | None = None
    exchange: Exchange | None = None
    problems: tuple[str, ...] = ()

    @cached_property
    def state(self) -> RobotState | None:
        """The robot's state."""
        return None if self.parts is None else primary.robot_state(self.parts)

    @property
    def software(self) -> tuple[int, ...]:
        """Version of the controller's software; empty if unknown."""
        if self.exchange is not None:
            return self.exchange.version
        match = re.search(r"(\d+)\.(\d+)\.(\d+)", (self.dashboard or {}).get("PolyscopeVersion", ""))
        return tuple(int(number) for number in match.groups()) if match else ()

    @property
    def serial(self) -> str:
        """Serial number of the robot; '' if unknown."""
        return (self.dashboard or {}).get("get serial number", "")

    @property
    def model(self) -> str:
        """Name of the model in laboratory files; '' if unknown."""
        name = (self.dashboard or {}).get("get robot model", "")
        return model_named(name, self.software) if name and self.software else ""


def read_status(host: str) -> Findings:
    """Read only the values that decide whether the arm can move: the dashboard's answers and one RTDE package.

    It takes a fraction of a second, so it suits a repeated display. The primary port is left alone.

    Args:
        host: address or name of the controller.
    """
    return _read(host, whole=False)


def look_at(host: str) -> Findings:
    """Read everything from the controller.

    Args:
        host: its address or name.
    """
    return _read(host, whole=True)


def _read(host: str, *, whole: bool) -> Findings:
    try:
        address = _resolved(host)
    except OSError as error:
        return Findings("", problems=(str(error),))
    control = _control_port(address)
    further = (primary.PORT, SCRIPTS) if whole else ()
    ports = {port: port_problem(address, port) for port in (control, *further, RTDE)}
    dashboard = parts = exchange = None
    problems: list[str] = []
    if ports[control] is None:
        with _noting(problems):
            dashboard = ask_dashboard(address)
    if whole and ports[primary.PORT] is None:
        with _noting(problems):
            parts = primary.read_parts(address)
    if ports[RTDE] is None:
        with _noting(problems):
            exchange = read_exchange(address) if whole else read_exchange(address, rate=10.0, seconds=0.0)
            # a gap may be caused by this computer, so measure twice and keep the better result
            if whole and exchange.gap > PATIENT_GAP:
                exchange = min(exchange, read_exchange(address), key=lambda e: e.gap)
    return Findings(address, ports, dashboard, parts, exchange, tuple(problems))


def _control_port(address: str) -> int:
    """The dashboard's port; on PolyScope X that of the Robot API."""
    with contextlib.suppress(dashboard_port.DashboardError), Dashboard(address, timeout=2.0) as dashboard:
        return dashboard.port
    return dashboard_port.PORT


def _resolved(host: str) -> str:
    address = socket.getaddrinfo(host, None, socket.AF_INET)[0][4][0]
    assert isinstance(address, str)
    return address


def recorded_findings(findings: Findings) -> dict[str, Any]:
    """JSON-ready values, from which `findings_of` makes the same findings."""
    return {
        "address": findings.address,
        "ports": {str(port): problem for port, problem in findings.ports.items()},
        "dashboard": findings.dashboard,
        "primary": None if findings.parts is None else {str(kind): body.hex() for kind, body in findings.parts.items()},
        "exchange": None if findings.exchange is None else asdict(findings.exchange),
        "problems": list(findings.problems),
    }


def findings_of(recorded: Mapping[str, Any]) -> Findings:
    """The findings that were recorded.

    Raises:
        ValueError: these are not recorded findings.
    """
    try:
        primary_parts, values = recorded["primary"], recorded["exchange"]
        exchange = None
        if values is not None:
            lists = {name: tuple(values[name]) for name in ("version",)}
            centre = None if values["payload_centre"] is None else tuple(values["payload_centre"])
            numbers = {name: tuple(value) for name, value in values["values"].items()}
            exchange = Exchange(**{**values, **lists, "payload_centre": centre, "values": numbers})
        return Findings(
            recorded["address"],
            {int(port): problem for port, problem in recorded["ports"].items()},
            recorded["dashboard"],
            None if primary_parts is None else {int(kind): bytes.fromhex(body) for kind, body in primary_parts.items()},
            exchange,
            tuple(recorded["problems"]),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"not a readout of a controller: {error!r}") from error


@contextlib.contextmanager
def _noting(problems: list[str]) -> Iterator[None]:
    try:
        yield
    except (ReadoutError, primary.PrimaryError) as error:
        problems.append(str(error))
