"""Robotiq grippers 2F-85, 2F-140 and Hand-E, through the socket of their URCap on the robot's controller.

`RobotiqSettings` are the settings, `RobotiqGripper` the driver, `parse_reply` reads one reply.

The URCap listens on TCP port 63352 of the controller: `SET NAME value [NAME value …]` is answered `ack`, `GET NAME` is
answered `NAME value`, or `NAME ?` while the gripper cannot be read. A GET's reply ends with a line feed, and the `ack`
with none.

Sources: the instruction manuals of the three grippers for the registers behind the names (OBJ, STA, FLT, POS, PRE);
ur_rtde's RobotiqGripper, airo-mono and the ports of the manufacturer's example for the socket. Not tried on a gripper.
"""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from actors.arm.arm_settings import ArmSettings
from actors.grippers.gripper_interface import (
    REST,
    GripperError,
    GripperSettings,
    GripperState,
    TcpPort,
    Width,
    check_urcap,
    opened,
    settled,
)
from actors.runtime.bench_clock import device_clock
from sim_engine.settings.model import NOT_IN_FINGERPRINT, Example, Problems
from sim_engine.settings.quantity import Quantity

PORT = 63352

REPLY_TIMEOUT = 2.0
"""Longest wait for a reply [s]."""

TRAVEL = 8.0
"""Longest time of a motion of the fingers [s]; at the lowest speed a 2F-85 takes four."""

ACTIVATION = 10.0
"""Longest time of an activation [s]; it takes 2 to 3 s."""

REACTION = 0.15
"""Time after a command within which OBJ may still be that of the motion before [s]."""

RESET, READY = 0, 3
"""Values of STA; 1 is activating."""

MOVING, OPENING_STOPPED, CLOSING_STOPPED, ARRIVED = range(4)
"""Values of OBJ; an object that is lost leaves ARRIVED."""

Register = Annotated[int, Strict(), Field(ge=0, le=255)]

FAULTS = {
    5: "it waits for its activation",
    7: "it must be activated first",
    8: "it is too hot; wait until it has cooled down",
    9: "its communication is not ready",
    10: "its supply voltage is too low",
    11: "an automatic release is in progress",
    12: "internal fault",
    13: "activation fault; is something in the way of its fingers?",
    14: "overcurrent",
    15: "an automatic release has opened it; it must be activated again",
}
"""Meaning of FLT. Source: the manuals of 2F-85, 2F-140 and Hand-E."""


@dataclass(frozen=True)
class RobotiqModel:
    """One gripper.

    Attributes:
        stroke: width of the open fingers [m].
        forces: [N].
        open, closed: positions of the open and the closed fingers, without an object.
    """

    stroke: float
    forces: tuple[float, float]
    open: int
    closed: int


MODELS = {
    "2F-85": RobotiqModel(0.085, (20.0, 235.0), 3, 230),
    "2F-140": RobotiqModel(0.140, (10.0, 125.0), 3, 230),
    "Hand-E": RobotiqModel(0.050, (20.0, 130.0), 3, 230),
}
"""Source: the manuals; the positions 3 and 230 or 231 are the manufacturer's and airo-mono's for a 2F-85, and assumed
for the others."""


class RobotiqSettings(GripperSettings):
    """A Robotiq gripper with its URCap."""

    kind: Literal["robotiq"] = "robotiq"
    """A Robotiq gripper; the default kind."""

    model: Annotated[Literal["2F-85", "2F-140", "Hand-E"], Example("2F-85")]
    """Model of the gripper."""

    port: Annotated[TcpPort, NOT_IN_FINGERPRINT] = PORT
    """TCP port of the URCap on the controller."""

    speed: Annotated[float, Quantity("1", "0.3", 0.0, 1.0)] = 0.3
    """Speed of the fingers, as a fraction of the gripper's range."""

    stroke: Width | None = None
    """Width between the fingertips when open, for other fingertips than the standard ones."""

    open_position: Register | None = None
    """Position that the gripper reports when open without an object; 3 unless given."""

    closed_position: Register | None = None
    """Position that the gripper reports when closed without an object; 230 unless given."""

    @property
    def _model(self) -> RobotiqModel:
        return MODELS[self.model]

    @property
    def widest(self) -> float:
        """See `GripperSettings.widest`."""
        return self._model.stroke if self.stroke is None else self.stroke

    @property
    def forces(self) -> tuple[float, float]:
        """See `GripperSettings.forces`."""
        return self._model.forces

    @property
    def ends(self) -> tuple[int, int]:
        """Positions of the open and the closed fingers."""
        begin = self._model.open if self.open_position is None else self.open_position
        return begin, self._model.closed if self.closed_position is None else self.closed_position

    def width_at(self, position: int) -> float:
        """Width at a position [m]; positions beyond the ends count as the ends."""
        begin, end = self.ends
        return self.widest * min(max((end - position) / (end - begin), 0.0), 1.0)

    def position_at(self, width: float) -> int:
        """Position at a width [m]."""
        begin, end = self.ends
        return round(end + (begin - end) * min(max(width / self.widest, 0.0), 1.0))

    def force_register(self, force: float) -> int:
        """Value of FOR for a force [N]; the relation is only roughly linear."""
        low, high = self.forces
        return round(255.0 * min(max((force - low) / (high - low), 0.0), 1.0))

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `GripperSettings.driver`."""
        return RobotiqGripper, (self,)

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        super().check_values(problems)
        if problems.valid("model", "open_position", "closed_position") and self.ends[0] + 50 > self.ends[1]:
            text = "the closed fingers have a position at least 50 above that of the open ones"
            problems.add(text, "closed_position" if self.closed_position is not None else "open_position")

    def check_laboratory(self, problems: Problems, *, mode: str, arm: ArmSettings | None) -> None:
        """See `GripperSettings.check_laboratory`."""
        super().check_laboratory(problems, mode=mode, arm=arm)
        check_urcap(problems, self, self.port, PORT, mode=mode, arm=arm)


_REPLY = re.compile(rb"([A-Z]{3}) +(\?|-?\d{1,4})\r?\n?")


def parse_reply(data: bytes, name: str) -> int | None:
    """Value of a reply to GET.

    Args:
        data: the whole reply.
        name: of the variable that was requested.

    Returns:
        None if the gripper cannot be read now ('?'), as during an emergency stop.

    Raises:
        GripperError: it is no reply to this request.
    """
    match = _REPLY.fullmatch(data)
    if match is None or match[1] != name.encode():
        raise GripperError(f"'GET {name}' was answered with {data[:40]!r}; is this the port of the gripper's URCap?")
    return None if match[2] == b"?" else int(match[2])


class RobotiqGripper:
    """Driver; see `Gripper`.

    A connection on which a reply was late or wrong is closed, so that no late reply is taken for that of a later
    request. The next request connects again.

    Args:
        settings: model, address and port.
        timeout: longest wait for a reply [s].
    """

    def __init__(self, settings: RobotiqSettings, timeout: float = REPLY_TIMEOUT) -> None:
        self._settings, self._clock = settings, device_clock(settings.clock)
        self._timeout = timeout * self._clock.patience
        self._where = f"gripper {settings.model} at {settings.address}:{settings.port}"
        self._socket: socket.socket | None = None
        self._one_at_a_time = threading.Lock()
        self._requested: tuple[int, int] | None = None  # position and force

    # ---- the socket

    def get(self, name: str) -> int:
        """Read a variable.

        Raises:
            GripperError: there is no reply, or the gripper cannot be read now.
        """
        data = self._ask(f"GET {name}\n".encode(), lambda got: got.endswith(b"\n"))
        try:
            value = parse_reply(data, name)
        except GripperError as error:
            self._drop()
            raise GripperError(f"{self._where}: {error}") from None
        if value is None:
            raise GripperError(
                f"{self._where} cannot be read: the robot has an emergency stop, or the gripper has no power"
            )
        return value

    def set(self, **values: int) -> None:
        """Write variables together.

        Raises:
            GripperError: they are not acknowledged.
        """
        pairs = " ".join(f"{name} {value}" for name, value in values.items())
        answer = self._ask(f"SET {pairs}\n".encode(), lambda got: len(got) >= len(b"ack"))
        if answer.strip() != b"ack":
            self._drop()
            raise GripperError(f"{self._where}: 'SET {pairs}' was answered with {answer[:40]!r} instead of 'ack'")

    def _ask(self, request: bytes, complete: Callable[[bytes], bool]) -> bytes:
        with self._one_at_a_time:
            try:
                if self._socket is None:
                    self._socket = socket.create_connection(
                        (self._settings.address, self._settings.port), timeout=self._timeout
                    )
                connection = self._socket
                connection.settimeout(self._timeout)
                connection.sendall(request)
                data, end = b"", time.monotonic() + self._timeout
                while not complete(data):
                    connection.settimeout(max(end - time.monotonic(), 1e-3))
                    received = connection.recv(4096)
                    if not received:
                        raise ConnectionError("it closed the connection")
                    data = (data + received).lstrip(b"\r\n")  # one may follow an 'ack'
                return data
            except TimeoutError:
                self._drop()
                raise GripperError(
                    f"{self._where}: no answer to '{request.decode().strip()}' within {self._timeout:g} s; is the "
                    "URCap installed, and the gripper connected?"
                ) from None
            except OSError as error:
                self._drop()
                raise GripperError(f"{self._where}: {error}; is the URCap installed and running?") from None

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    # ---- see `Gripper`

    def connect(self) -> str:
        """See `Gripper.connect`."""
        state = self.state()
        return f"a Robotiq {self._settings.model}, {state}"

    def prepare(self) -> None:
        """See `Gripper.prepare`: activates the gripper, if it is not active or has a fault."""
        if self.get("STA") == READY and self.get("ACT") == 1 and self.get("FLT") == 0:
            return
        self.set(ACT=0)
        self._wait("STA", RESET)
        self.set(ACT=1)
        self._wait("STA", READY)
        self.set(GTO=0)
        self._requested = None

    def _wait(self, name: str, value: int) -> None:
        end = self._clock.now + ACTIVATION
        while (current := self.get(name)) != value:
            if self._clock.now > end:
                fault = FAULTS.get(self.get("FLT"), "")
                raise GripperError(
                    f"{self._where} is not ready after {ACTIVATION:g} s ({name} {current}){fault and ': '}{fault}"
                )
            time.sleep(REST)

    def state(self) -> GripperState:
        """See `Gripper.state`."""
        position, detection, fault = self.get("POS"), self.get("OBJ"), self.get("FLT")
        active = self.get("ACT") == 1 and self.get("STA") == READY
        going = active and self.get("GTO") == 1  # otherwise OBJ means nothing
        force, problem = self.get("FOR"), ""
        if fault:
            problem = FAULTS.get(fault, f"fault {fault}")
        elif not active:
            problem = "it is not activated: it was switched off, or never activated; its brake may still hold an object"
        elif self._requested is not None:
            problem = self._other_client(force)
        low, high = self._settings.forces
        return GripperState(
            self._settings.width_at(position),
            moving=going and detection == MOVING,
            detected=going and detection == CLOSING_STOPPED,
            force=low + (high - low) * force / 255.0,
            problem=problem,
        )

    def _other_client(self, force: int) -> str:
        """Whether the gripper has the position and the force that this driver requested last; else the problem."""
        assert self._requested is not None
        wanted, pressed = self._requested
        echo = self.get("PRE")
        if echo != wanted:
            return f"another client commands it: position {echo} was requested, and not {wanted}"
        if force != pressed:
            return f"another client commands it: its force was set to {force} of 255, and not {pressed}"
        return ""

    def open(self, width: float) -> GripperState:
        """See `Gripper.open`."""
        return opened(self._go(self._settings.position_at(width), 0), width, self._settings.accuracy, self._where)

    def grip(self, width: float, force: float) -> GripperState:
        """See `Gripper.grip`."""
        return self._go(self._settings.position_at(width), self._settings.force_register(force))

    def _go(self, position: int, force: int) -> GripperState:
        if self.get("STA") != READY or self.get("ACT") != 1:
            raise GripperError(f"{self._where} is not activated")
        self._requested = None
        self.set(POS=position, SPE=round(255.0 * self._settings.speed), FOR=force, GTO=1)
        end = time.monotonic() + self._timeout
        while (echo := self.get("PRE")) != position:
            if time.monotonic() > end:
                raise GripperError(
                    f"{self._where} does not take the position {position}: it reports {echo}. Does another client "
                    "command it?"
                )
            time.sleep(REST)
        self._requested = (position, force)
        return settled(self.state, REACTION / max(self._settings.time_scale, 1.0), TRAVEL, self._clock)

    def stop(self) -> None:
        """See `Gripper.stop`; fingers that stand go on pressing."""
        if self.get("OBJ") == MOVING:
            self.set(GTO=0)

    def close(self) -> None:
        """See `Gripper.close`."""
        self._drop()
