"""A small interface to the RTDE client library, for the worker process only. A client is discarded, never reconnected.

It uses only the part of the library that reads values. `InputWriter` writes the three input registers: the library's
own writer claims all outputs, the speed slider and registers of a fieldbus, so that no PLC, gripper or ROS driver could
be connected at the same time. The library's control interface uploads its own program when it is created, reconnects by
itself, uploads again, and then ends the running program and sometimes its process. This is not acceptable in a cell
where nothing may run without consent.

`client_missing` reports whether the library is installed.
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
    TILT_SPEED,
    TOOL,
    DataPackage,
    TroubleError,
)


def client_missing() -> str | None:
    """Why no arm can be reached from this machine: the client library is not installed; None if it is."""
    if importlib.util.find_spec("rtde_receive") is not None:
        return None
    return (
        "the arm needs the package ur-rtde, which is not installed: pip install 'decant-pouring[lab]' "
        "(Python 3.13 and later build it from its source: see docs/laboratory/connect-an-arm.md)"
    )


PORTS = {rtde.PORT: "RTDE", 30001: "primary interface"}
PROBE_TIME = 2.0
CONSTRUCTION_TIME = 5.0
"""Time after which a blocked constructor ends the process [s], because it holds the interpreter lock."""

ATTEMPTS, BETWEEN_ATTEMPTS = 3, 0.4
"""Number of connection attempts, and the time between them [s]: a controller may need a moment to notice that the
previous connection was cut.
"""

AT_REST = 8.0
"""Factor of the longest silence while nothing moves, because a controller may be loading a program."""

ORDERS = ((STOP_ORDER,), (HEARTBEAT,), (GO,))
"""Integer inputs, each written alone."""

TILT_INPUTS = ((TILT_SPEED, TILT_COUNTER),)
"""Double inputs of a dose, written together."""

_SAME_READINGS = 10
"""Number of readings with the same time before data count as stale: a single late reading proves nothing."""

_VARIABLES = [
    *("timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "runtime_state", "robot_status_bits"),
    *("target_speed_fraction", "speed_scaling", "payload", "payload_cog", "safety_status_bits"),
    *(f"output_int_register_{n}" for n in (NUMBER, STATUS)),
    *(f"output_double_register_{n}" for n in (CLOCK, *range(TOOL, TOOL + 6))),
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

    Raises:
        TroubleError: the controller cannot be reached, another client writes these inputs, or the library is missing.
    """

    def __init__(self, address: str, rate: float, silence: float, registers: int) -> None:
        for port, name in PORTS.items():
            _probe(address, port, name)
        try:
            with Dashboard(address, PROBE_TIME):
                pass
        except DashboardError as error:
            raise TroubleError("lost", f"no robot at {address}: {error}. {_ENABLED}") from None
        if (missing := client_missing()) is not None:
            raise TroubleError("refused", missing)
        from rtde_receive import RTDEReceiveInterface  # type: ignore[import-not-found]

        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._forces = _offered(address, (_FORCE, _WRIST))
                with _bounded(CONSTRUCTION_TIME):
                    self._receive: Any = RTDEReceiveInterface(address, rate, [*_VARIABLES, *self._forces])
                self._inputs = InputWriter(address, registers)
                self._tilt: InputWriter | None = None
                break
            except (RuntimeError, ValueError, TroubleError) as error:
                if attempt == ATTEMPTS:
                    if isinstance(error, TroubleError):
                        raise
                    raise TroubleError("lost", f"{address}: {error}") from None
                time.sleep(BETWEEN_ATTEMPTS)
        self._address, self._registers = address, registers
        self._commands = int(time.monotonic() * 1e3) % 1_000_000  # not the number that an earlier client wrote last
        self._silence = silence
        self._last: DataPackage | None = None
        self._same_readings = 0

    # ---- reading

    def look(self, patience: float = 1.0) -> DataPackage:
        """The latest package.

        Args:
            patience: longest silence, as a multiple of the usual one.

        Raises:
            TroubleError: the connection is lost, or the controller's time does not advance.
        """
        r = self._receive
        if not r.isConnected():
            raise TroubleError("lost", "the connection to the controller was lost")
        for _ in range(20):
            time_before = r.getTimestamp()
            last = self._last
            if last is not None and time_before == last.time:
                self._same_readings += 1
                if self._same_readings >= _SAME_READINGS and time.monotonic() - last.seen > patience * self._silence:
                    raise TroubleError(
                        "lost", f"the controller has said nothing new for {patience * self._silence:g} s"
                    )
                return last
            reading = DataPackage(
                time=time_before,
                seen=time.monotonic(),
                joints=tuple(r.getActualQ()),
                speeds=tuple(r.getActualQd()),
                robot_mode=r.getRobotMode(),
                safety_mode=r.getSafetyMode(),
                runtime=r.getRuntimeState(),
                slider=r.getTargetSpeedFraction(),
                scaling=r.getSpeedScaling(),
                payload=r.getPayload(),
                centre=tuple(r.getPayloadCog()),
                number=r.getOutputIntRegister(NUMBER),
                status=r.getOutputIntRegister(STATUS),
                clock=r.getOutputDoubleRegister(CLOCK),
                tool=tuple(r.getOutputDoubleRegister(TOOL + k) for k in range(6)),
                status_bits=r.getRobotStatus(),
                force=tuple(r.getActualTCPForce()) if _FORCE in self._forces else (),
                wrist=tuple(r.getFtRawWrench()) if _WRIST in self._forces else (),
            )
            if r.getTimestamp() == time_before:
                self._last, self._same_readings = reading, 0
                return reading
        raise TroubleError("lost", "packages come faster than they can be read")

    def fresh(self) -> DataPackage:
        """A package that is newer than this call.

        Raises:
            TroubleError: none arrives.
        """
        before = self._receive.getTimestamp()
        self._last, self._same_readings = None, 0
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
            self._tilt = InputWriter(self._address, self._registers, TILT_INPUTS, "DOUBLE")

    def tilt(self, speed: float) -> None:
        """Write the wanted speed of the tilt [rad/s] with a new counter, in one package."""
        if self._tilt is not None:
            self._commands += 1
            self._tilt.write(TILT_SPEED, speed, float(self._commands))


class InputWriter:
    """Writes inputs over a connection of its own, and claims no other variable.

    Args:
        address: of the controller.
        first: number of the first input.
        groups: inputs that are written together, counted from the first.
        kind: of the inputs, 'INT32' or 'DOUBLE'.

    Raises:
        TroubleError: the controller does not answer, or another client writes one of the inputs.
    """

    def __init__(
        self,
        address: str,
        first: int,
        groups: Sequence[tuple[int, ...]] = ORDERS,
        kind: Literal["INT32", "DOUBLE"] = "INT32",
    ) -> None:
        self._writing = threading.Lock()
        self._recipes: dict[int, int] = {}
        self._code = "i" if kind == "INT32" else "d"
        word = "int" if kind == "INT32" else "double"
        try:
            self._socket = socket.create_connection((address, rtde.PORT), timeout=PROBE_TIME)
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


def _offered(address: str, names: tuple[str, ...]) -> list[str]:
    """Which values the controller has. It refuses a recipe that names another one."""
    try:
        with socket.create_connection((address, rtde.PORT), timeout=PROBE_TIME) as connection:
            requests = rtde.Requests(connection)
            requests.ask(rtde.REQUEST_PROTOCOL_VERSION, b"\0\2")
            answer = requests.ask(rtde.SETUP_OUTPUTS, struct.pack(">d", 1.0) + ",".join(names).encode("ascii"))
    except (OSError, rtde.PackageError) as error:
        raise TroubleError("lost", f"{address}: its RTDE does not answer as it should: {error}") from None
    return [name for name, kind in zip(names, rtde.names(answer[1:]), strict=False) if kind in rtde.FORMATS]


def _probe(address: str, port: int, name: str) -> None:
    try:
        with socket.create_connection((address, port), timeout=PROBE_TIME):
            pass
    except OSError as error:
        raise TroubleError(
            "lost",
            f"no robot at {address}: its {name} (port {port}) does not answer: {error}. {_ENABLED}",
        ) from None


_ENABLED = "Is the controller on, on this network, and are its services enabled?"


@contextlib.contextmanager
def _bounded(seconds: float) -> Iterator[None]:
    """End this process if the body takes longer. The timer is a C thread, which does not need the interpreter lock."""
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
