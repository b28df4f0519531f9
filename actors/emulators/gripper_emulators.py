"""Emulated grippers on loopback sockets: Robotiq's URCap (ASCII over TCP) and OnRobot's server (XML-RPC).

`Fingers` are two fingers with an object between them; `RobotiqEmulator` and `OnRobotEmulator` put them behind a
protocol. They run in threads of this process and end with it. A second client connects as the first one does.

Sources: those of the drivers. Assumed: FLT 7 after a request without activation; the time constants.
"""

from __future__ import annotations

import contextlib
import socket
import socketserver
import threading
import time
from collections.abc import Callable
from typing import Any
from xmlrpc.client import Fault
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from actors.grippers.onrobot_gripper import MODELS as ONROBOT_MODELS
from actors.grippers.onrobot_gripper import OnRobotSettings
from actors.grippers.robotiq_gripper import ARRIVED as ARRIVED_OBJ
from actors.grippers.robotiq_gripper import CLOSING_STOPPED, MOVING, READY, RESET, RobotiqSettings
from actors.runtime.bench_clock import device_clock

LOOPBACK = "127.0.0.1"

ACTIVATING = 1
"""Value of STA during an activation."""

ACTIVATION_TIME = 2.5
"""Duration of an activation [s of gripper time]."""

BEFORE_MOTION = 0.4
"""Time from a command to an OnRobot gripper until it moves and reports so [s of gripper time]."""

SPEEDS = (0.02, 0.15)
"""Slowest and fastest speed of the fingers [m/s]."""

OUTWARD = (0.033, 0.071)
"""Widths of a 2FG7 with its fingers mounted outwards, as one reported them [m]."""

CROOKED = 6e-3
"""How much wider an object is that is held crooked [m]."""


class Fingers:
    """Two fingers, and an object between them.

    Args:
        closed, widest: their smallest and largest width [m].
        time_scale: gripper seconds per second of the clock.
        clock: file of the bench's clock; '' for the wall clock.

    Attributes:
        object: width of the object [m]; None if there is none.
        absent: the object is not between the fingers, wherever the operator says it is.
        crooked: it is held crooked.
        weak: the force is a fifth of the requested one.
        powered: the gripper has power.
        delay: time before each answer [s of the clock].
    """

    def __init__(self, closed: float, widest: float, time_scale: float, clock: str = "") -> None:
        self.closed, self.widest = closed, widest
        self._scale = time_scale if time_scale > 0.0 else 1e3
        self._clock = device_clock(clock)
        self.object: float | None = None
        self.absent = self.crooked = self.weak = False
        self.powered = True
        self.delay = 0.0
        self._from = self._target = widest
        self._begin, self._speed = self.now, SPEEDS[1]

    @property
    def now(self) -> float:
        """Gripper time [s]."""
        return self._scale * self._clock.now

    def put(self, width: float | None) -> None:
        """See `GripperEmulator.put`."""
        opening, self.object = self.width, width
        if width is None:
            self.move(self._target, self._speed, start=opening)

    @property
    def _obstacle(self) -> float | None:
        if self.object is None or self.absent:
            return None
        return self.object + (CROOKED if self.crooked else 0.0)

    @property
    def _end(self) -> float:
        """Where the motion ends [m]: at its target, or at the object."""
        obstacle = self._obstacle
        if obstacle is None or self._from < obstacle - 1e-6 or self._target >= obstacle:
            return self._target
        return obstacle

    @property
    def width(self) -> float:
        """Between the fingertips [m]."""
        way, end = self._speed * max(self.now - self._begin, 0.0), self._end
        return max(self._from - way, end) if end < self._from else min(self._from + way, end)

    @property
    def moving(self) -> bool:
        """Whether the fingers move."""
        return self.powered and self.now > self._begin and abs(self.width - self._end) > 1e-6

    @property
    def stopped_by_object(self) -> bool:
        """Whether an object has stopped the closing fingers, and is still there."""
        return self._end > self._target and abs(self.width - self._end) <= 1e-6

    def move(self, target: float, speed: float, *, after: float = 0.0, start: float | None = None) -> None:
        """Begin to move to a width [m], after a time [s of gripper time]."""
        self._from = self.width if start is None else start
        self._target = min(max(target, self.closed), self.widest)
        self._begin, self._speed = self.now + after, speed

    def halt(self) -> None:
        """Stop; fingers that press on an object go on pressing."""
        if self.moving or self.now <= self._begin:
            self.move(self.width, self._speed)

    def fault(self, name: str, value: float) -> None:
        """See `GripperEmulator.fault`: 'absent', 'crooked', 'lost', 'weak', 'power', 'slow'.

        Raises:
            ValueError: there is no such fault.
        """
        match name:
            case "absent":
                self.absent = bool(value)
            case "crooked":
                self.crooked = bool(value)
            case "weak":
                self.weak = bool(value)
            case "lost":
                self.put(None)
            case "slow":
                self.delay = value
            case "power":
                self.halt()
                self.powered = bool(value)
            case _:
                raise ValueError(f"no fault '{name}' of a gripper")


class RobotiqEmulator:
    """A Robotiq gripper and its URCap; see `GripperEmulator`.

    Args:
        settings: model, address and port; without an address, a free port of this machine.
    """

    def __init__(self, settings: RobotiqSettings) -> None:
        self._settings = settings
        self.fingers = Fingers(0.0, settings.widest, settings.time_scale, settings.clock)
        self._lock = threading.Lock()
        self._values = {"ACT": 0, "GTO": 0, "ATR": 0, "ARD": 0, "FOR": 0, "SPE": 0, "POS": 0, "MOD": 0}
        self._fault, self._activated = 0, 0.0
        emulator = self

        class Client(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                while line := self.rfile.readline(200):
                    time.sleep(emulator.fingers.delay)
                    self.wfile.write(emulator.answer(line.decode("ascii", "replace")))

        self._server = _Server(settings.address, settings.port, Client)
        self.gripper = settings.with_values(address=self._server.address, port=self._server.port)
        self.activate()

    def activate(self) -> None:
        """Activate it, as the pendant of a real robot does; it stands open."""
        self._values["ACT"], self._activated = 1, self.fingers.now - ACTIVATION_TIME

    def put(self, width: float | None) -> None:
        """See `GripperEmulator.put`."""
        with self._lock:
            self.fingers.put(width)

    def fault(self, name: str, value: float = 1.0) -> None:
        """See `GripperEmulator.fault`; 'not_activated' as well. Power that comes back leaves it not activated."""
        with self._lock:
            if name in ("not_activated", "power"):
                self._values["ACT"] = self._values["GTO"] = 0
            if name != "not_activated":
                self.fingers.fault(name, value)

    def close(self) -> None:
        """See `GripperEmulator.close`."""
        self._server.end()

    def answer(self, line: str) -> bytes:
        """Reply to a line; b'' if the URCap gives none."""
        words = line.split()
        with self._lock:
            if len(words) == 2 and words[0] == "GET":
                value = self._read(words[1])
                return f"{words[1]} {'?' if value is None or not self.fingers.powered else value}\n".encode()
            pairs = list(zip(words[1::2], words[2::2], strict=False))
            good = all(name in self._values and value.isdigit() and int(value) < 256 for name, value in pairs)
            if words[:1] != ["SET"] or not pairs or len(words) % 2 == 0 or not good:
                return b""  # a misspelt request is acknowledged by nobody
            if self.fingers.powered:
                self._write({name: int(value) for name, value in pairs})
            return b"ack"

    @property
    def _status(self) -> int:
        if not self._values["ACT"]:
            return RESET
        return READY if self.fingers.now - self._activated >= ACTIVATION_TIME else ACTIVATING

    def _read(self, name: str) -> int | None:
        fingers = self.fingers
        match name:
            case "STA":
                return self._status
            case "PRE":
                return self._values["POS"]
            case "POS":
                return self._settings.position_at(fingers.width)
            case "FLT":
                return self._fault
            case "OBJ":
                if fingers.moving or self._status == ACTIVATING:
                    return MOVING
                return CLOSING_STOPPED if fingers.stopped_by_object else ARRIVED_OBJ
            case "FOR" if fingers.weak:
                return self._values["FOR"] // 5
        return self._values.get(name)

    def _write(self, values: dict[str, int]) -> None:
        was = self._values["ACT"]
        self._values.update(values)
        if self._values["ACT"] and not was:
            self._activated, self._fault = self.fingers.now, 0
            self.fingers.move(self.fingers.widest, SPEEDS[1])
            return
        if not self._values["ACT"]:
            self._fault = 0
        if not {"POS", "GTO"} & values.keys() or not (values.get("GTO", self._values["GTO"])):
            if values.get("GTO") == 0 and was:
                self.fingers.halt()
            return
        if self._status != READY:
            self._fault = 7
            return
        slow, fast = SPEEDS
        speed = slow + (fast - slow) * self._values["SPE"] / 255.0
        self.fingers.move(self._settings.width_at(self._values["POS"]), speed)


class OnRobotEmulator:
    """An OnRobot gripper and its server; see `GripperEmulator`.

    Args:
        settings: model, address and port; without an address, a free port of this machine.
    """

    def __init__(self, settings: OnRobotSettings) -> None:
        self._settings, self._model = settings, ONROBOT_MODELS[settings.model]
        self._two = self._model.prefix == "twofg"
        closed, widest = OUTWARD if self._two else (0.0, settings.widest)
        self.fingers = Fingers(closed, widest, settings.time_scale, settings.clock)
        self._force, self._safety = 0.0, False
        self._server = _XmlServer(settings.address, settings.port, self._methods(), lambda: self.fingers.delay)
        self.gripper = settings.with_values(address=self._server.address, port=self._server.port)

    def put(self, width: float | None) -> None:
        """See `GripperEmulator.put`."""
        self.fingers.put(width)

    def fault(self, name: str, value: float = 1.0) -> None:
        """See `GripperEmulator.fault`; 'safety' as well: a safety switch was pressed."""
        if name == "safety":
            self._safety = bool(value)
        else:
            self.fingers.fault(name, value)

    def close(self) -> None:
        """See `GripperEmulator.close`."""
        self._server.end()

    def _methods(self) -> dict[str, Callable[..., Any]]:
        fingers, prefix = self.fingers, self._model.prefix
        held = {
            "get_busy": lambda index: fingers.moving,
            "get_grip_detected": lambda index: fingers.powered and fingers.stopped_by_object,
            "get_status": lambda index: 2 if fingers.stopped_by_object else 0,
            "stop": self._stop,
        }
        by_name: dict[str, Callable[..., Any]] = {
            "get_width": lambda index: 1e3 * fingers.width,
            "get_safety_failed": lambda index: False,
            "get_s1_triggered": lambda index: self._safety,
            "get_s2_triggered": lambda index: False,
            "grip": self._grip,
        }
        if self._two:
            by_name = {
                "get_external_width": lambda index: 1e3 * fingers.width,
                "get_min_external_width": lambda index: 1e3 * fingers.closed,
                "get_max_external_width": lambda index: 1e3 * fingers.widest,
                "get_error_not_calibrated": lambda index: False,
                "get_error_linear_sensor": lambda index: False,
                "get_force": lambda index: round(self._pressed),
                "grip_external": self._grip_external,
            }
        methods = {f"{prefix}_{name}": method for name, method in {**held, **by_name}.items()}
        return {**methods, "cb_is_device_connected": self._is_connected}

    @property
    def _pressed(self) -> float:
        return self._force * (0.2 if self.fingers.weak else 1.0) if self.fingers.stopped_by_object else 2.0

    def _is_connected(self, index: int, device: int) -> bool:
        return self.fingers.powered and index == self._settings.index and device == self._model.device

    def _stop(self, index: int) -> int:
        self.fingers.halt()
        return 0

    def _grip(self, index: int, width: float, force: float) -> int:
        if not isinstance(width, float) or not isinstance(force, float):
            raise Fault(-501, "Type mismatch: expected double, got int")
        return self._move(index, width, force, SPEEDS[1])

    def _grip_external(self, index: int, width: float, force: int, speed: int) -> int:
        if not isinstance(width, float) or not isinstance(force, int) or not isinstance(speed, int):
            raise Fault(-501, "Type mismatch")
        return self._move(index, width, float(force), SPEEDS[1] * speed / 100.0)

    def _move(self, index: int, width: float, force: float, speed: float) -> int:
        low, high = self._model.forces
        if not self.fingers.powered or index != self._settings.index or self._safety or not low <= force <= high:
            return 1
        self._force = force
        self.fingers.move(1e-3 * width, speed, after=BEFORE_MOTION)
        return 0


class _Threads(socketserver.ThreadingMixIn):
    """A TCP server that runs in a thread, with one more for each client."""

    daemon_threads = True
    allow_reuse_address = True
    block_on_close = False

    address, port = LOOPBACK, 0

    def begin(self) -> None:
        """Serve from now on."""
        self._clients: set[socket.socket] = set()
        address: Any = self.server_address  # type: ignore[attr-defined]
        self.address, self.port = str(address[0]), int(address[1])
        threading.Thread(target=self.serve_forever, args=(0.05,), name="gripper", daemon=True).start()  # type: ignore[attr-defined]

    def process_request(self, request: Any, client_address: Any) -> None:
        """See `socketserver.ThreadingMixIn`."""
        self._clients.add(request)
        super().process_request(request, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that have gone."""

    def end(self) -> None:
        """End it, and all connections. May be called again."""
        self.shutdown()  # type: ignore[attr-defined]
        self.server_close()
        for client in self._clients:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)


class _Server(_Threads, socketserver.TCPServer):
    def __init__(self, address: str, port: int, handler: type[socketserver.BaseRequestHandler]) -> None:
        super().__init__((address or LOOPBACK, port if address else 0), handler)
        self.begin()


class _XmlHandler(SimpleXMLRPCRequestHandler):
    rpc_paths = ("/",)


class _XmlServer(_Threads, SimpleXMLRPCServer):
    def __init__(
        self, address: str, port: int, methods: dict[str, Callable[..., Any]], delay: Callable[[], float]
    ) -> None:
        super().__init__((address or LOOPBACK, port if address else 0), _XmlHandler, logRequests=False)
        self._delay = delay
        for name, method in methods.items():
            self.register_function(method, name)
        self.begin()

    def _dispatch(self, method: str, params: Any) -> Any:
        time.sleep(self._delay())
        return super()._dispatch(method, params)
