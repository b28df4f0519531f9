"""Fault injection for tests: a TCP port with one line of JSON per request and one per reply.

`ControllerFaults` implements the faults, `FaultServer` the port.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import math
from array import array
from base64 import b64encode
from collections.abc import Callable
from typing import Any

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.control_clock import Host
from actors.emulators.ur_controller.controller import Watcher
from actors.emulators.ur_controller.robot import TRACKING_LAG, RobotMode
from actors.emulators.ur_controller.safety_system import SafetyConfiguration, SafetyPlane

LONGEST_LINE = 100_000


class FaultError(Exception):
    """The fault is unknown, or its arguments are invalid."""


# More than 25 methods: one method for each fault.
class ControllerFaults:
    """All faults of one host, by name. Times are controller times [s] unless wall time is named.

    Args:
        host: the host that the faults act on.
    """

    def __init__(self, host: Host) -> None:
        self._host = host
        self._controller = host.controller
        self._names: dict[str, Callable[..., dict[str, Any] | None]] = {
            name: getattr(self, name) for name in vars(type(self)) if not name.startswith("_") and name != "call"
        }

    def call(self, request: Any) -> dict[str, Any]:
        """Execute a request.

        Raises:
            FaultError: the request is invalid.
        """
        if not isinstance(request, dict) or not isinstance(request.get("fault"), str):
            raise FaultError('a request is an object with "fault" and its arguments')
        arguments = {str(k): v for k, v in request.items() if k != "fault"}
        name = request["fault"]
        if name not in self._names:
            raise FaultError(f"no fault '{name[:50]}'; there are {', '.join(self._names)}")
        try:
            return self._names[name](**arguments) or {}
        except (TypeError, ValueError, LookupError, ArithmeticError) as error:
            raise FaultError(f"{name}: {error!r} with {arguments}"[:500]) from error

    # ---- conditions

    def _when(
        self,
        do: Callable[[], None],
        after: float | None = None,
        joint: int | None = None,
        above: float | None = None,
        below: float | None = None,
    ) -> None:
        """Execute now, after a time, or once a joint's measured position passes a value [rad]."""
        if after is None and joint is None:
            do()
            return
        watcher: Watcher
        if after is not None:
            due = self._controller.now + _finite(after)
            watcher = _once(lambda: self._controller.now >= due, do)
        else:
            number = int(joint or 0)
            if not 0 <= number <= 5 or (above is None) == (below is None):
                raise ValueError("a joint is 0 … 5, and either 'above' or 'below' says where")
            robot = self._controller.robot
            if above is not None:
                high = _finite(above)
                watcher = _once(lambda: robot.q[number] >= high, do)
            else:
                low = _finite(below or 0.0)
                watcher = _once(lambda: robot.q[number] <= low, do)
        self._controller.watchers.append(watcher)

    def pace(self, scale: float) -> None:
        """Set the controller seconds per second of the clock from now on."""
        if not 0.0 < scale <= 1000.0:
            raise ValueError("0 < scale <= 1000")
        self._controller.time_scale = float(scale)

    # ---- safety

    def protective_stop(self, reason: str = "fault port", code: int = 157, **when: Any) -> None:
        """Trigger a protective stop, with the code of an error; 157 is a collision."""
        self._when(lambda: self._controller.protective_stop(str(reason), int(code)), **when)

    def freedrive(self, active: bool = True, **when: Any) -> None:
        """Press the freedrive button, or let it go; nothing is moved by hand."""

        def apply() -> None:
            self._controller.freedrive = bool(active)

        self._when(apply, **when)

    def force(self, wrench: list[float], **when: Any) -> None:
        """Push the tool: force and torque in the base's frame [N], [N m]. Only the reported values change."""
        x, y, z, rx, ry, rz = map(_finite, wrench)

        def apply() -> None:
            self._controller.robot.external_force = (x, y, z, rx, ry, rz)

        self._when(apply, **when)

    def emergency_stop(self, system: bool = False, **when: Any) -> None:
        """Press the emergency stop button."""
        self._when(lambda: self._controller.emergency_stop(system=bool(system)), **when)

    def release_emergency_stop(self, **when: Any) -> None:
        """Release the emergency stop button."""
        self._when(self._controller.release_emergency_stop, **when)

    def reduced(self, active: bool = True, **when: Any) -> None:
        """Switch the reduced mode, as an input or a plane does; its lower limits are not modelled."""

        def apply() -> None:
            self._controller.safety.reduced = bool(active)

        self._when(apply, **when)

    def safeguard(self, active: bool = True, **when: Any) -> None:
        """Apply the safeguard stop (a person enters the guarded area), or release it."""
        self._when(lambda: self._controller.set_safeguard(bool(active)), **when)

    def safety_fault(self, **when: Any) -> None:
        """Fail the safety system itself: only a restart helps."""
        self._when(self._controller.safety_fault, **when)

    def checksum(self, value: str | None = None) -> None:
        """Report another safety checksum, up to eight hexadecimal digits; None restores the true one."""
        self._controller.safety.reported_checksum = None if value is None else f"{int(value, 16) & 0xFFFFFFFF:08X}"

    def limits(
        self,
        joint_ranges: list[list[float]] | None = None,
        joint_speeds: list[float] | None = None,
        tool_speed: float | None = None,
        planes: list[dict[str, Any]] | None = None,
    ) -> dict[str, Any]:
        """Narrow the safety configuration; limits that are not given become the model's own."""
        safety = SafetyConfiguration.of(self._controller.model)
        ranges, speeds = safety.joint_ranges, safety.joint_speeds
        if joint_ranges is not None:
            ranges = tuple((_finite(low), _finite(high)) for low, high in joint_ranges)
        if joint_speeds is not None:
            a, b, c, d, e, f = (_finite(v) for v in joint_speeds)
            speeds = (a, b, c, d, e, f)
        if len(ranges) != 6:
            raise ValueError("six joint ranges")
        walls = []
        for plane in planes or []:
            x, y, z = (_finite(v) for v in plane["normal"])
            size = math.sqrt(x * x + y * y + z * z)
            walls.append(SafetyPlane((x / size, y / size, z / size), _finite(plane["offset"])))
        speed = safety.tool_speed if tool_speed is None else _finite(tool_speed)
        configuration = SafetyConfiguration(ranges, speeds, speed, tuple(walls))
        self._controller.configure_safety(configuration)
        return {"checksum": configuration.checksum}

    # ---- connections

    def stall(self, seconds: float | None = None, motion: bool = True, **when: Any) -> None:
        """Keep connections but send no replies, for some wall seconds or until 'clear'.

        With `motion` False the whole controller hangs: the arm stands still.
        """

        def begin() -> None:
            self._host.stall(True, motion=bool(motion))
            if seconds is not None:
                self._later(_finite(seconds), self._resume)

        self._when(begin, **when)

    def _resume(self) -> None:
        self._host.stall(False)

    def drop(self, **when: Any) -> None:
        """Close all connections; new ones are accepted."""
        self._when(self._host.connections.drop, **when)

    def refuse(self, seconds: float | None = None, **when: Any) -> None:
        """Close all connections and accept none, for some wall seconds or until 'clear'."""

        def begin() -> None:
            self._host.close()
            self._host.connections.drop()
            if seconds is not None:
                self._later(_finite(seconds), self._reopen)

        self._when(begin, **when)

    def reboot(self, seconds: float = 10.0, **when: Any) -> None:
        """Disappear for some wall seconds, then be switched off as after a power cut."""

        def begin() -> None:
            self._controller.reboot()
            self._host.connections.uploads.forget()
            self.refuse(seconds)

        self._when(begin, **when)

    def _later(self, seconds: float, do: Callable[[], None]) -> None:
        asyncio.get_running_loop().call_later(seconds, do)

    def _reopen(self) -> None:
        self._host.reopen()

    # ---- arm and panel

    def noise(self, sigma: float = 0.0) -> None:
        """Add noise to the measured joint positions [rad]."""
        self._controller.robot.noise = max(0.0, _finite(sigma))

    def lag(self, seconds: float = TRACKING_LAG) -> None:
        """Set the time constant with which joints follow their targets [s]; weak joints have a larger one than the
        default.
        """
        value = _finite(seconds)
        if value <= 0.0:
            raise ValueError("a time constant is above 0 s")
        self._controller.robot.lag = value

    def slider(self, fraction: float, **when: Any) -> None:
        """Move the speed slider."""
        value = _finite(fraction)
        if not 0.0 <= value <= 1.0:
            raise ValueError("the slider goes from 0 to 1")

        def move() -> None:
            self._controller.robot.mover.slider = value

        self._when(move, **when)

    def slowing(self, fraction: float, **when: Any) -> None:
        """Slow programs down whatever the slider says, as a controller does near its limits."""
        value = _finite(fraction)
        if not 0.0 < value <= 1.0:
            raise ValueError("a slowed program runs at 0 to 1 of its speed")

        def slow() -> None:
            self._controller.robot.mover.slowing = value

        self._when(slow, **when)

    def remote(self, active: bool, **when: Any) -> None:
        """Switch remote control on or off."""
        self._when(lambda: self._host.set_remote(bool(active)), **when)

    def inputs(self, digital: dict[str, bool] | None = None, analog: list[float] | None = None) -> None:
        """Set the input levels: digital by number (0–7 standard, 8–15 configurable, 16–17 tool), and analogue."""
        for number, level in (digital or {}).items():
            if not 0 <= int(number) <= 17:
                raise ValueError("digital inputs are 0 … 17")
            self._controller.signals.set_input(int(number), bool(level))
        for at, value in enumerate(analog or []):
            self._controller.signals.analog_in[at] = _finite(value)

    def power(self, mode: str) -> None:
        """Set the power mode at once: 'running', 'idle', 'off'."""
        modes = {"running": RobotMode.RUNNING, "idle": RobotMode.IDLE, "off": RobotMode.POWER_OFF}
        if mode == "off":
            self._controller.power_off()
        self._controller.power.mode = modes[mode]

    # ---- queries

    def state(self) -> dict[str, Any]:
        """Return the controller's state and the statistics of its clock."""
        c = self._controller
        return {
            "time": c.now,
            "robot_mode": c.power.mode.name,
            "safety_mode": c.safety.mode.name,
            "runtime_state": c.runtime.name,
            "program": c.program.name if c.program is not None else None,
            "remote": c.remote,
            "joints": list(c.robot.mover.q),
            "speeds": list(c.robot.mover.qd),
            "pose": list(c.robot.target_pose),
            "tcp": list(c.robot.tcp),
            "payload": c.robot.payload,
            "cog": list(c.robot.cog),
            "slider": c.robot.mover.slider,
            "checksum": c.safety.checksum,
            "popup": c.popup,
            "safety_popup": c.safety_popup,
            "messages": list(self._host.messages),
            "timing": self._host.timing.report(),
        }

    def history(self, since: float = 0.0) -> dict[str, Any]:
        """Return the executed joint positions since a controller time, without noise, and the time now."""
        entries = self._entries(since)
        joints = [list(q) for _, q in entries]
        return {"times": [t for t, _ in entries], "joints": joints, "now": self._controller.now}

    def samples(self, since: float = 0.0) -> dict[str, Any]:
        """Return the same as doubles in base64: a time and six joints each.

        Two minutes as text would take 0.3 s of processor time. The clock stands meanwhile and nothing is sent, on a
        busy machine for longer than clients wait.
        """
        numbers = array("d", itertools.chain.from_iterable((t, *q) for t, q in self._entries(since)))
        return {"samples": b64encode(numbers.tobytes()).decode("ascii"), "now": self._controller.now}

    def _entries(self, since: float) -> list[tuple[float, Joints]]:
        start = _finite(since)
        newest = itertools.takewhile(lambda one: one[0] >= start, reversed(self._controller.robot.history))
        return list(newest)[::-1]

    def clear(self) -> None:
        """End stalls and refusals, and cancel pending faults."""
        self._controller.watchers.clear()
        self._resume()
        self._reopen()


def _finite(value: Any) -> float:
    result = float(value)
    if not math.isfinite(result):
        raise ValueError(f"{value} is not a number to work with")
    return result


def _once(condition: Callable[[], bool], do: Callable[[], None]) -> Watcher:
    def watch() -> bool:
        if not condition():
            return False
        do()
        return True

    return watch


class FaultServer:
    """The TCP port for faults.

    Args:
        host: the host that the faults act on.
    """

    def __init__(self, host: Host) -> None:
        self._host = host
        self._faults = ControllerFaults(host)
        self._server: asyncio.Server | None = None

    async def open(self, port: int) -> int:
        """Listen; returns the port number. With 0, the system chooses a free port."""
        self._server = await asyncio.start_server(self._serve, self._host.address, port, limit=LONGEST_LINE)
        number: int = self._server.sockets[0].getsockname()[1]
        return number

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                try:
                    answer = {"ok": True, **self._faults.call(json.loads(line))}
                except (FaultError, ValueError, RecursionError) as error:
                    answer = {"ok": False, "error": str(error)}
                writer.write(json.dumps(answer).encode() + b"\n")
                await writer.drain()
        except (ConnectionError, ValueError):
            pass  # closed, or a line without an end
        finally:
            writer.close()
