"""OnRobot grippers RG2, RG6 and 2FG7, over XML-RPC: from the URCap on the robot's controller, or from a Compute Box.

`OnRobotSettings` are the settings, `OnRobotGripper` the driver. The server listens on TCP port 41414, path `/`.

Sources: the methods are those that a controller listed, and their arguments those of public clients (RyanPaulMcKenna's
onRobot, the manufacturer's client for Doosan robots, ROS drivers). Reported by their users: whole numbers as width and
force of `rg_grip` are refused (fault -501); `rg_grip` returns 0 at once, and 'not busy' is reported for another 0.4 s;
the path `/RPC2` is not served. Not tried on a gripper.
"""

from __future__ import annotations

import http.client
import threading
import xmlrpc.client
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from xml.parsers.expat import ExpatError

from actors.arm.arm_settings import ArmSettings
from actors.grippers.gripper_interface import (
    GripperError,
    GripperSettings,
    GripperState,
    TcpPort,
    check_urcap,
    opened,
    settled,
)
from actors.runtime.bench_clock import device_clock
from sim_engine.settings.model import NOT_IN_FINGERPRINT, Example, Problems
from sim_engine.settings.quantity import Quantity

PORT = 41414

REPLY_TIMEOUT = 3.0
"""Longest wait for a reply [s]."""

REACTION = 0.6
"""Time after a command within which the gripper may not have begun to move [s]; 0.4 s were measured with an RG6."""

TRAVEL = 10.0
"""Longest time of a motion of the fingers [s]."""


@dataclass(frozen=True)
class OnRobotModel:
    """One gripper.

    Attributes:
        device: its number for `cb_is_device_connected`.
        prefix: of its methods.
        widest: width of the open fingers [m]; that of a 2FG7 depends on how its fingers are mounted.
        forces: [N].
    """

    device: int
    prefix: str
    widest: float
    forces: tuple[float, float]


MODELS = {
    "RG2": OnRobotModel(0x20, "rg", 0.110, (3.0, 40.0)),
    "RG6": OnRobotModel(0x21, "rg", 0.160, (25.0, 120.0)),
    "2FG7": OnRobotModel(0xC0, "twofg", 0.073, (20.0, 140.0)),
}
"""Source: the numbers of public clients, and the manufacturer's data sheets."""


class OnRobotSettings(GripperSettings):
    """An OnRobot gripper with its URCap or a Compute Box."""

    kind: Literal["onrobot"] = "onrobot"
    """An OnRobot gripper."""

    model: Annotated[Literal["RG2", "RG6", "2FG7"], Example("RG2")]
    """Model of the gripper."""

    port: Annotated[TcpPort, NOT_IN_FINGERPRINT] = PORT
    """TCP port of the XML-RPC server."""

    index: Literal[0, 1, 2] = 0
    """Place of the gripper: 0 alone, 1 and 2 on a dual quick changer."""

    speed: Annotated[float, Quantity("1", "0.3", 0.1, 1.0)] = 0.3
    """Speed of the fingers of a 2FG7, as a fraction of its range."""

    @property
    def widest(self) -> float:
        """See `GripperSettings.widest`."""
        return MODELS[self.model].widest

    @property
    def forces(self) -> tuple[float, float]:
        """See `GripperSettings.forces`."""
        return MODELS[self.model].forces

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `GripperSettings.driver`."""
        return OnRobotGripper, (self,)

    def check_laboratory(self, problems: Problems, *, mode: str, arm: ArmSettings | None) -> None:
        """See `GripperSettings.check_laboratory`."""
        super().check_laboratory(problems, mode=mode, arm=arm)
        check_urcap(problems, self, self.port, PORT, mode=mode, arm=arm)


class _Transport(xmlrpc.client.Transport):
    """A transport that does not wait for ever."""

    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        """See `xmlrpc.client.Transport`."""
        connection = super().make_connection(host)
        connection.timeout = self._timeout
        return connection


class OnRobotGripper:
    """Driver; see `Gripper`.

    Args:
        settings: model, address and port.
        timeout: longest wait for a reply [s].
    """

    def __init__(self, settings: OnRobotSettings, timeout: float = REPLY_TIMEOUT) -> None:
        self._settings, self._model = settings, MODELS[settings.model]
        self._where = f"gripper {settings.model} at {settings.address}:{settings.port}"
        self._url = f"http://{settings.address}:{settings.port}/"
        self._clock = device_clock(settings.clock)
        self._timeout = timeout * self._clock.patience
        self._server = self._proxy()
        self._one_at_a_time = threading.Lock()  # a proxy has one connection, for one request at a time

    def _proxy(self) -> xmlrpc.client.ServerProxy:
        return xmlrpc.client.ServerProxy(self._url, transport=_Transport(self._timeout))

    def call(self, method: str, *arguments: float) -> Any:
        """Call a method of the server.

        Raises:
            GripperError: there is no answer, or the server refuses the request.
        """
        with self._one_at_a_time:
            try:
                return getattr(self._server, method)(*arguments)
            except xmlrpc.client.Fault as error:
                raise GripperError(f"{self._where}: {method} is refused: {error.faultString}") from None
            except (OSError, http.client.HTTPException, xmlrpc.client.Error, ValueError, SyntaxError) as error:
                self._server = self._proxy()  # a late reply is not taken for that of a later request
                raise GripperError(
                    f"{self._where}: no answer to {method}: {error or type(error).__name__}; is the URCap of OnRobot "
                    "installed, and this its port?"
                ) from None
            except ExpatError as error:
                self._server = self._proxy()
                raise GripperError(f"{self._where}: {method} was not answered with XML-RPC: {error}") from None

    def _own(self, name: str, *arguments: float) -> Any:
        return self.call(f"{self._model.prefix}_{name}", self._settings.index, *arguments)

    def _number(self, name: str) -> float:
        value = self._own(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise GripperError(f"{self._where}: {self._model.prefix}_{name} was answered with {str(value)[:40]!r}")
        return float(value)

    # ---- see `Gripper`

    def connect(self) -> str:
        """See `Gripper.connect`."""
        if not self._connected():
            raise GripperError(
                f"{self._where}: the server answers, and no {self._settings.model} is connected at index "
                f"{self._settings.index}; check the cable, the power of the tool and the index"
            )
        return f"an OnRobot {self._settings.model}, {self.state()}"

    def _connected(self) -> bool:
        return bool(self.call("cb_is_device_connected", self._settings.index, self._model.device))

    def prepare(self) -> None:
        """See `Gripper.prepare`: these grippers are ready once they have power."""
        self.connect()

    def state(self) -> GripperState:
        """See `Gripper.state`."""
        two_fingers = self._model.prefix == "twofg"
        width = 1e-3 * self._number("get_external_width" if two_fingers else "get_width")
        problem = ""
        if not self._connected():
            problem = "it is not connected to its server any more: it has no power, or its cable is loose"
        elif two_fingers and self._own("get_error_not_calibrated"):
            problem = "it is not calibrated"
        elif two_fingers and self._own("get_error_linear_sensor"):
            problem = "its linear sensor has an error"
        elif not two_fingers and self._own("get_safety_failed"):
            problem = "its safety circuit has failed; switch the tool off and on"
        elif not two_fingers and (self._own("get_s1_triggered") or self._own("get_s2_triggered")):
            problem = "one of its safety switches was pressed; switch the tool off and on"
        return GripperState(
            width,
            moving=bool(self._own("get_busy")),
            detected=bool(self._own("get_grip_detected")) and not problem,
            force=self._number("get_force") if two_fingers else None,
            problem=problem,
        )

    def open(self, width: float) -> GripperState:
        """See `Gripper.open`."""
        return opened(self._go(width, self._settings.forces[0]), width, self._settings.accuracy, self._where)

    def grip(self, width: float, force: float) -> GripperState:
        """See `Gripper.grip`."""
        state = self._go(width, force)
        if state.detected and state.force is not None and state.force < 0.5 * force:
            raise GripperError(f"{self._where}: it grips with {state.force:.0f} N instead of {force:.0f} N")
        return state

    def _go(self, width: float, force: float) -> GripperState:
        millimetres = 1e3 * width
        if self._model.prefix == "twofg":
            low, high = self._number("get_min_external_width"), self._number("get_max_external_width")
            if millimetres > high + 0.05:
                raise GripperError(
                    f"{self._where}: with its fingers as mounted it opens to {high:.1f} mm, and {millimetres:.1f} mm "
                    "are needed; mount the fingers outwards, or set their lengths on the pendant"
                )
            percent = round(100.0 * self._settings.speed)
            reply = self._own("grip_external", max(millimetres, low), round(force), percent)
        else:
            reply = self._own("grip", float(max(millimetres, 0.0)), float(force))
        if reply not in (None, 0, True):
            raise GripperError(f"{self._where} does not grip: it answered {reply!r}")
        return settled(self.state, REACTION / max(self._settings.time_scale, 1.0), TRAVEL, self._clock)

    def stop(self) -> None:
        """See `Gripper.stop`."""
        self._own("stop")

    def close(self) -> None:
        """See `Gripper.close`."""
        with self._one_at_a_time:
            self._server("close")()
