"""`python -m actors.arm.ur.rtde_worker FD`: the process that exchanges values with the controller.

It ends when its driver closes the connection or dies. Requests are executed one after another; a separate thread
receives stops and signs of life.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import queue
import select
import sys
import threading
from multiprocessing.connection import Connection
from typing import Any

from actors.arm.ur.dashboard import REPLY_TIMEOUT, Dashboard, DashboardError, stop_program
from actors.arm.ur.motion_execution import MotionMonitor, recover
from actors.arm.ur.primary_interface import PrimaryError, read_state
from actors.arm.ur.rtde_client import RtdeClient
from actors.arm.ur.worker_messages import (
    STOPPED_PROGRAM,
    DataPackage,
    Facts,
    MotionOrder,
    MotionOutcome,
    MotionProgress,
    TroubleError,
)
from actors.runtime.bench_clock import DeviceClock, device_clock

HANDS_IN_TIME = 3.0
READ_TIME = 3.0
"""Longest wait for the robot's state [s]."""


class Worker:
    """The worker's requests.

    Args:
        connection: to the driver.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._requests: queue.SimpleQueue[tuple[int, str, tuple[Any, ...]]] = queue.SimpleQueue()
        self._client: RtdeClient | None = None
        self._address = ""
        self._monitor: MotionMonitor | None = None
        self._stops = 0
        self._clock = DeviceClock()
        self._owner_seen = self._clock.now

    # ---- lifetime

    def serve(self) -> None:
        """Serve requests until the driver closes the connection."""
        threading.Thread(target=self._receive, name="hear", daemon=True).start()
        parent = os.getppid()
        while True:
            try:
                number, method, arguments = self._requests.get(timeout=1.0)
            except queue.Empty:
                # the driver is dead, although another process holds the connection's other end
                if os.getppid() != parent:
                    os._exit(0)
                continue
            try:
                answer = (number, True, getattr(self, method)(*arguments))
            except TroubleError as trouble:
                answer = (number, False, trouble)
            except Exception as error:
                answer = (number, False, TroubleError("lost", f"{method}: {error!r}"))
            self._send(answer)

    def _receive(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                request = self._connection.recv()
                self._owner_seen = self._clock.now
                if request[0] == "stop":
                    self._stops = max(self._stops, request[1])
                    if (monitor := self._monitor) is not None:
                        monitor.order_stop()
                elif request[0] == "tilt":
                    if (monitor := self._monitor) is not None:
                        monitor.tilt(request[1])
                elif request[0] == "call":
                    self._requests.put(request[1:])
        os._exit(0)  # the heartbeat ends with the process, and any motion with the heartbeat

    def _send(self, message: Any) -> None:
        with self._sending:
            try:
                self._connection.send(message)
            except OSError:
                os._exit(0)

    def _report(self, progress: MotionProgress) -> None:
        # a driver that reads nothing, such as a suspended program's, must not delay the heartbeat of a motion
        if select.select([], [self._connection], [], 0.0)[1]:
            self._send(progress)

    # ---- requests

    def open(self, address: str, rate: float, silence: float, registers: int, clock: str) -> DataPackage:
        """Connect; nothing moves."""
        self._address, self._clock = address, device_clock(clock)
        self._owner_seen = self._clock.now
        self._client = RtdeClient(address, rate, silence, registers, self._clock)
        return self._client.fresh()

    @property
    def client(self) -> RtdeClient:
        """The client of the controller."""
        if self._client is None:
            raise TroubleError("lost", "not connected")
        return self._client

    def facts(self) -> Facts:
        """Identity and state of the controller; nothing moves."""
        reading = self.client.fresh()
        try:
            with Dashboard(self._address, REPLY_TIMEOUT * self._clock.patience) as dashboard:
                version = _version(dashboard.ask("PolyscopeVersion"))
                model = dashboard.ask("get robot model")
                serial = dashboard.ask("get serial number")
                program = dashboard.ask("programState")
                remote = None if version[0] < 5 else dashboard.ask("is in remote control").lower() == "true"
            state = read_state(self._address, READ_TIME * self._clock.patience)
        except (DashboardError, PrimaryError) as error:
            raise TroubleError("lost", str(error)) from None
        return Facts(model, serial, version, remote, program, reading, state)

    def read(self) -> DataPackage:
        """A fresh package."""
        return self.client.fresh()

    def run(self, motion: MotionOrder) -> MotionOutcome:
        """Execute a motion."""
        if motion.tilts:
            self.client.claim_tilt()
        monitor = MotionMonitor(self.client, self._address, motion, self._report, lambda: self._owner_seen)
        self._monitor = monitor
        try:
            if self._stops > motion.stops:
                monitor.order_stop()
            return monitor.run()
        finally:
            self._monitor = None

    def hands_in(self) -> None:
        """End any program, and check that none runs."""
        end = self._clock.now + HANDS_IN_TIME
        refusal = ""
        if self.client.fresh().runtime != STOPPED_PROGRAM:
            try:
                stop_program(self._address, REPLY_TIMEOUT * self._clock.patience)
            except DashboardError as error:
                refusal = f" ({error})"
        while self.client.fresh().runtime != STOPPED_PROGRAM:
            if self._clock.now > end:
                raise TroubleError("refused", f"a program still runs on the controller{refusal}: keep hands out")
        try:
            with Dashboard(self._address, REPLY_TIMEOUT * self._clock.patience) as dashboard:
                answer = dashboard.ask("programState")
        except DashboardError as error:
            raise TroubleError("lost", str(error)) from None
        if not answer.upper().startswith("STOPPED"):
            raise TroubleError("refused", f"the controller says that its program is '{answer}': keep hands out")
        if not self.client.fresh().stands:
            raise TroubleError("refused", "the arm still moves: keep hands out")

    def recover(self, scale: float) -> str:
        """Make the robot ready after a stop; only the brakes move."""
        return recover(self.client, self._address, scale)


def _version(text: str) -> tuple[int, ...]:
    numbers = "".join(c if c.isdigit() or c == "." else " " for c in text).split()
    dotted = next((n for n in numbers if "." in n), "0.0")
    return tuple(int(number) for number in dotted.split(".") if number)


def main() -> None:
    """Serve on the connection whose file descriptor is the first argument."""
    faulthandler.enable()
    Worker(Connection(int(sys.argv[1]))).serve()


if __name__ == "__main__":
    main()
