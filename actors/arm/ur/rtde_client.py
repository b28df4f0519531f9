"""RTDE of a controller, for the worker process only. A client is discarded, never reconnected; on a virtual bench, it
receives again what only a late host has ended.

`LibraryReader` receives the values with the client library ur-rtde. Its newest release has no wheel for Python 3.13 and
later; there `OutputReader` receives them. `InputWriter` writes the input registers of the program, and no others:
client libraries claim all outputs, the speed slider and registers of a fieldbus, so that no PLC, gripper or ROS driver
could be connected at the same time. Their control interfaces upload a program of their own and reconnect by themselves.
This is not acceptable in a cell where nothing may run without consent.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib.util
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from actors.arm.ur import rtde
from actors.arm.ur.dashboard import Dashboard, DashboardError
from actors.arm.ur.worker_messages import (
    CLOCK,
    GO,
    HEARTBEAT,
    NUMBER,
    STATUS,
    STOP_ORDER,
    TILT_COUNTER,
    TILT_HIGHEST,
    TILT_PATIENCE,
    TILT_SPEED,
    TOOL,
    DataPackage,
    TiltOrder,
    TroubleError,
)
from actors.runtime.bench_clock import DeviceClock, SharedClock

PORTS = {rtde.PORT: "RTDE", 30001: "primary interface"}
PROBE_TIME = 2.0

CONSTRUCTION_TIME = 5.0
"""Time after which a blocked constructor of the library ends the process [s], because it holds the interpreter lock."""

ATTEMPTS, BETWEEN_ATTEMPTS = 3, 0.4
"""Number of connection attempts, and the time between them [s]: a controller may need a moment to notice that the
previous connection was cut.
"""

AT_REST = 8.0
"""Factor of the longest silence while nothing moves, because a controller may be loading a program."""

ORDERS = ((STOP_ORDER,), (HEARTBEAT,), (GO,))
"""Integer inputs, each written alone."""

TILT_INPUTS = ((TILT_SPEED, TILT_COUNTER, TILT_HIGHEST, TILT_PATIENCE),)
"""Double inputs of a dose, written together."""

_SAME_READINGS = 10
"""Number of readings with the same time before data count as stale: a single late reading proves nothing."""

_DOUBLES = (CLOCK, *range(TOOL, TOOL + 6))

_VARIABLES = [
    *("timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "runtime_state", "robot_status_bits"),
    *("target_speed_fraction", "speed_scaling", "payload", "payload_cog", "safety_status_bits"),
    *(f"output_int_register_{n}" for n in (NUMBER, STATUS)),
    *(f"output_double_register_{n}" for n in _DOUBLES),
]
_FORCE, _WRIST = "actual_TCP_force", "ft_raw_wrench"
"""Read from controllers that have them; the second one since 5.9, from robots with a sensor in the wrist."""


class RtdeClient:
    """Reads the controller's state and writes the input registers of its program.

    Args:
        address: of the controller.
        rate: of reading [Hz of the clock].
        silence: longest time without new data [s of the clock].
        registers: first of the three integer inputs that are written.
        clock: of the controller.

    Raises:
        TroubleError: the controller cannot be reached, or another client writes these inputs.
    """

    def __init__(self, address: str, rate: float, silence: float, registers: int, clock: DeviceClock) -> None:
        timeout = PROBE_TIME * clock.patience
        for port, name in PORTS.items():
            _probe(address, port, name, timeout)
        try:
            with Dashboard(address, timeout):
                pass
        except DashboardError as error:
            raise TroubleError("lost", f"no robot at {address}: {error}. {_ENABLED}") from None
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._outputs = self._receive(address, rate, clock)
                self._inputs = InputWriter(address, registers, timeout=timeout)
                self._tilt: InputWriter | None = None
                break
            except TroubleError:
                if attempt == ATTEMPTS:
                    raise
                time.sleep(BETWEEN_ATTEMPTS)
        self._address, self._rate, self._registers, self._timeout = address, rate, registers, timeout
        self.clock = clock
        self._commands = int(time.monotonic() * 1e3) % 1_000_000  # not the number that an earlier client wrote last
        self._silence = silence
        self._last: DataPackage | None = None
        self._changed, self._changed_to = clock.now, self._outputs.latest()[1]["timestamp"][0]
        self._same_readings = 0

    # ---- reading

    def look(self, silences: float = 1.0) -> DataPackage:
        """The latest package.

        Args:
            silences: longest silence, as a multiple of the usual one.

        Raises:
            TroubleError: the connection is lost, or the controller's time does not advance.
        """
        if self._outputs.lost:
            if not self._host_was_late(silences):
                raise TroubleError("lost", f"the connection to the controller was lost ({self._outputs.lost})")
            self._outputs = self._receive(self._address, self._rate, self.clock)
        seen, values = self._outputs.latest()
        last = self._last
        if last is not None and values["timestamp"][0] == last.time:
            self._same_readings += 1
            if self._same_readings >= _SAME_READINGS and self.clock.now - self._changed > silences * self._silence:
                raise TroubleError("lost", f"the controller has said nothing new for {silences * self._silence:g} s")
            return last
        self._same_readings, self._changed, self._changed_to = 0, self.clock.now, values["timestamp"][0]
        self._last = DataPackage(
            time=values["timestamp"][0],
            seen=seen,
            joints=values["actual_q"],
            speeds=values["actual_qd"],
            robot_mode=values["robot_mode"][0],
            safety_mode=values["safety_mode"][0],
            runtime=values["runtime_state"][0],
            slider=values["target_speed_fraction"][0],
            scaling=values["speed_scaling"][0],
            payload=values["payload"][0],
            centre=values["payload_cog"],
            number=values[f"output_int_register_{NUMBER}"][0],
            status=values[f"output_int_register_{STATUS}"][0],
            clock=values[f"output_double_register_{CLOCK}"][0],
            tool=tuple(values[f"output_double_register_{TOOL + k}"][0] for k in range(6)),
            status_bits=values["robot_status_bits"][0],
            force=values.get(_FORCE, ()),
            wrist=values.get(_WRIST, ()),
        )
        return self._last

    @staticmethod
    def _receive(address: str, rate: float, clock: DeviceClock) -> LibraryReader | OutputReader:
        return (LibraryReader if has_library() else OutputReader)(address, rate, clock.patience)

    def _host_was_late(self, silences: float) -> bool:
        """Whether only the reader gave up, on a virtual bench whose clock stood.

        The library closes its connection for good after 2.5 s of wall time without a package, also if the emulator or
        its own thread was given no processor. A cut connection ends the writer's as well, and a controller that says
        nothing lets the clock go on. Packages have come since the last look, which may be minutes ago; the controller's
        time, by which their last one is dated, goes at least as fast as the clock.
        """
        heard = self._changed + max(self._outputs.latest()[1]["timestamp"][0] - self._changed_to, 0.0)
        stood = self.clock.now - heard <= silences * self._silence
        return isinstance(self.clock, SharedClock) and stood and not self._inputs.lost

    def fresh(self) -> DataPackage:
        """A package that is newer than this call.

        Raises:
            TroubleError: none arrives.
        """
        self._last, self._same_readings = None, 0
        before = self.look(AT_REST).time
        while True:
            time.sleep(0.004)
            reading = self.look(AT_REST)
            if reading.time != before:
                return reading

    # ---- writing

    def beat(self, count: int) -> None:
        """Write the heartbeat, so that the program continues."""
        self._inputs.write(HEARTBEAT, count & 0xFFFF)

    def go(self, number: int) -> None:
        """Write the order to start."""
        self._inputs.write(GO, number)

    def order_stop(self, number: int) -> None:
        """Write the order to stop."""
        self._inputs.write(STOP_ORDER, number)

    def claim_tilt(self) -> None:
        """Claim the inputs of a dose, the first time that one is poured.

        Raises:
            TroubleError: the controller does not answer, or another client writes one of them.
        """
        if self._tilt is None:
            self._tilt = InputWriter(self._address, self._registers, TILT_INPUTS, "DOUBLE", self._timeout)

    def tilt(self, order: TiltOrder) -> None:
        """Write an order of a dose with a new counter, in one package."""
        if self._tilt is not None:
            self._commands += 1
            self._tilt.write(TILT_SPEED, order.speed, float(self._commands), order.highest, order.patience)


def has_library() -> bool:
    """Whether the client library ur-rtde is installed."""
    return importlib.util.find_spec("rtde_receive") is not None


class LibraryReader:
    """Receives the controller's values with the client library ur-rtde.

    Args:
        address: of the controller.
        rate: of packages [Hz].
        patience: factor of the waits for its replies.

    Raises:
        TroubleError: the controller does not answer, or lacks a value.
    """

    def __init__(self, address: str, rate: float, patience: float = 1.0) -> None:
        from rtde_receive import RTDEReceiveInterface  # type: ignore[import-not-found]

        try:
            with socket.create_connection((address, rtde.PORT), timeout=PROBE_TIME * patience) as connection:
                known = rtde.Outputs(rtde.Requests(connection), (*_VARIABLES, _FORCE, _WRIST), rate).fields
            _require_variables(address, known)
            self._optional = [name for name in (_FORCE, _WRIST) if name in known]
            with _bounded(CONSTRUCTION_TIME * patience):
                self._receive: Any = RTDEReceiveInterface(address, rate, [*_VARIABLES, *self._optional])
        except (OSError, RuntimeError, ValueError, rtde.PackageError) as error:
            raise TroubleError("lost", f"{address}: its RTDE does not answer as it should: {error}") from None

    @property
    def lost(self) -> str:
        """Why no more packages come; '' while they may."""
        return "" if self._receive.isConnected() else "ur-rtde is not connected"

    def latest(self) -> tuple[float, dict[str, tuple[Any, ...]]]:
        """The time of this call [s of `time.monotonic`], and the values of the latest package by field.

        Raises:
            TroubleError: packages come faster than their values can be read one by one.
        """
        r = self._receive
        for _ in range(20):
            time_before = r.getTimestamp()
            values: dict[str, tuple[Any, ...]] = {
                "timestamp": (time_before,),
                "actual_q": tuple(r.getActualQ()),
                "actual_qd": tuple(r.getActualQd()),
                "robot_mode": (r.getRobotMode(),),
                "safety_mode": (r.getSafetyMode(),),
                "runtime_state": (r.getRuntimeState(),),
                "target_speed_fraction": (r.getTargetSpeedFraction(),),
                "speed_scaling": (r.getSpeedScaling(),),
                "payload": (r.getPayload(),),
                "payload_cog": tuple(r.getPayloadCog()),
                "robot_status_bits": (r.getRobotStatus(),),
                "safety_status_bits": (r.getSafetyStatusBits(),),
                **{f"output_int_register_{n}": (r.getOutputIntRegister(n),) for n in (NUMBER, STATUS)},
                **{f"output_double_register_{n}": (r.getOutputDoubleRegister(n),) for n in _DOUBLES},
            }
            if _FORCE in self._optional:
                values[_FORCE] = tuple(r.getActualTCPForce())
            if _WRIST in self._optional:
                values[_WRIST] = tuple(r.getFtRawWrench())
            if r.getTimestamp() == time_before:
                return time.monotonic(), values
        raise TroubleError("lost", "packages come faster than they can be read")


class OutputReader:
    """Receives the controller's values over a connection of its own, in a thread.

    Args:
        address: of the controller.
        rate: of packages [Hz].
        patience: factor of the waits for its replies.

    Attributes:
        lost: why no more packages come; '' while they may.

    Raises:
        TroubleError: the controller does not answer, or lacks a value.
    """

    def __init__(self, address: str, rate: float, patience: float = 1.0) -> None:
        self.lost = ""
        try:
            connection = socket.create_connection((address, rtde.PORT), timeout=PROBE_TIME * patience)
            self._outputs = rtde.Outputs(rtde.Requests(connection), (*_VARIABLES, _FORCE, _WRIST), rate)
            self._latest = time.monotonic(), self._outputs.next()
            connection.settimeout(None)
        except (OSError, rtde.PackageError) as error:
            raise TroubleError("lost", f"{address}: its RTDE does not answer as it should: {error}") from None
        _require_variables(address, self._outputs.fields)
        threading.Thread(target=self._follow, name="outputs", daemon=True).start()

    def _follow(self) -> None:
        try:
            while True:
                payload = self._outputs.next()
                self._latest = time.monotonic(), payload
        except (OSError, rtde.PackageError) as error:
            self.lost = str(error)

    def latest(self) -> tuple[float, dict[str, tuple[Any, ...]]]:
        """When the latest package arrived [s of `time.monotonic`], and its values by field."""
        seen, payload = self._latest
        return seen, self._outputs.values(payload)


class InputWriter:
    """Writes inputs over a connection of its own, and claims no other variable.

    Args:
        address: of the controller.
        first: number of the first input.
        groups: inputs that are written together, counted from the first.
        kind: of the inputs, 'INT32' or 'DOUBLE'.
        timeout: for each response [s].

    Raises:
        TroubleError: the controller does not answer, or another client writes one of the inputs.
    """

    def __init__(
        self,
        address: str,
        first: int,
        groups: Sequence[tuple[int, ...]] = ORDERS,
        kind: Literal["INT32", "DOUBLE"] = "INT32",
        timeout: float = PROBE_TIME,
    ) -> None:
        self._writing = threading.Lock()
        self._recipes: dict[int, int] = {}
        self._code = "i" if kind == "INT32" else "d"
        word = "int" if kind == "INT32" else "double"
        try:
            self._socket = socket.create_connection((address, rtde.PORT), timeout=timeout)
            requests = rtde.Requests(self._socket)
            if requests.ask(rtde.REQUEST_PROTOCOL_VERSION, b"\0\2") != b"\1":
                raise TroubleError("lost", f"{address}: its RTDE does not know protocol 2")
            for group in groups:
                name = ",".join(f"input_{word}_register_{first + register}" for register in group)
                answer = requests.ask(rtde.SETUP_INPUTS, name.encode("ascii"))
                self._recipes[group[0]] = answer[0]
                self._check(address, name, rtde.names(answer[1:]), [kind] * len(group))
            self._socket.setblocking(False)  # a write never waits: some bytes always fit into the buffer
        except (OSError, rtde.PackageError, IndexError) as error:
            raise TroubleError("lost", f"{address}: its RTDE does not answer as it should: {error}") from None

    def _check(self, address: str, name: str, kinds: list[str], wanted: list[str]) -> None:
        if kinds == wanted:
            return
        self._socket.close()
        if "IN_USE" in kinds:
            raise TroubleError(
                "refused",
                f"{address}: another client writes {name}, such as a PLC, a gripper's URCap, a ROS driver or another "
                "Decant; end it, or choose other inputs with the arm's key 'registers'",
            )
        raise TroubleError(
            "refused",
            f"{address}: {name} is {' '.join(kinds) or 'unknown'}; inputs from 24 on need software 3.9 or 5.3, for an "
            "older one choose 'registers' below 21",
        )

    @property
    def lost(self) -> bool:
        """Whether the controller has closed the connection."""
        try:
            return not self._socket.recv(4096)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def write(self, register: int, *values: float) -> None:
        """Write a group of inputs, named by its first one.

        A lost connection is noticed by reading, and by the program's watchdog.
        """
        # If another thread is blocked here, the stop must still be attempted by other means.
        if not self._writing.acquire(timeout=0.2):
            return
        try:
            with contextlib.suppress(OSError):
                data = struct.pack(f">B{len(values)}{self._code}", self._recipes[register], *values)
                self._socket.sendall(rtde.package(rtde.DATA_PACKAGE, data))
                self._socket.recv(4096)  # messages of the controller, which nothing reads; usually there are none
        finally:
            self._writing.release()


def _probe(address: str, port: int, name: str, timeout: float) -> None:
    try:
        with socket.create_connection((address, port), timeout=timeout):
            pass
    except OSError as error:
        raise TroubleError(
            "lost",
            f"no robot at {address}: its {name} (port {port}) does not answer: {error}. {_ENABLED}",
        ) from None


_ENABLED = "Is the controller on, on this network, and are its services enabled?"


def _require_variables(address: str, known: Sequence[str]) -> None:
    """Check that the controller has all values.

    Raises:
        TroubleError: it lacks one.
    """
    if missing := [name for name in _VARIABLES if name not in known]:
        raise TroubleError("refused", f"{address}: its software is too old: it has no {', '.join(missing)}")


@contextlib.contextmanager
def _bounded(seconds: float) -> Iterator[None]:
    """End this process if the body takes longer. The timer is a C thread, which does not need the interpreter lock."""
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
