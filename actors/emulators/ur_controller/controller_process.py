"""Start an emulated UR controller in a process of its own, inject faults, and end it.

`VirtualController` is the handle of the process. This module imports nothing heavy, because the process imports it too.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Sequence
from math import degrees
from types import TracebackType
from typing import Any

from actors.runtime.child_process import START_DEADLINE, ChildProcess, python_module

REPLY_TIME = 50.0
"""Longest wait for a reply of the process [s], on a machine that may be busy."""


class VirtualControllerError(Exception):
    """The process does not start, or refuses a fault; the text gives the reason."""


class VirtualController:
    """A controller in a process of its own. Create it with `start`; as a context manager it closes itself.

    Attributes:
        address: of its ports 30001 … 30004 and 29999.
        fault_port: port for fault requests, at the same address.
        pid: of its process.
    """

    def __init__(self, process: ChildProcess, address: str, fault_port: int) -> None:
        self._process = process
        self.address = address
        self.fault_port = fault_port
        self.pid = process.pid

    @classmethod
    def start(
        cls,
        address: str = "127.0.0.2",
        model: str = "ur10e",
        time_scale: float = 1.0,
        frequency: float | None = None,
        *,
        state: str = "running",
        local: bool = False,
        calibrated: bool = False,
        polyscope_x: bool = False,
        joints: Sequence[float] | None = None,
        clock: str = "",
        timeout: float = START_DEADLINE,
    ) -> VirtualController:
        """Start the process and wait until all its ports are open.

        Args:
            address: any loopback address; each controller needs one of its own.
            model: a name in `actors.arm.ur.robot_models.MODELS`.
            time_scale: controller seconds per wall second.
            frequency: control cycles per controller second [Hz]; the model's by default.
            state: initial power mode, 'running', 'idle' or 'off'.
            local: start in local control.
            calibrated: the robot differs from nominal lengths, as a real one does.
            polyscope_x: software 10.14, with a Robot API instead of the dashboard.
            joints: six initial positions [rad]; a pose in the middle of its workspace by default.
            clock: file of the clock that the devices of a bench share (`actors.runtime.bench_clock.SharedClock`); ''
                for none.
            timeout: longest wait [s].

        Raises:
            VirtualControllerError: it did not get ready; the text includes its error output.
        """
        command = python_module("actors.emulators.ur_controller", "--address", address, "--model", model)
        command += ["--time-scale", repr(float(time_scale)), "--state", state, "--parent", str(os.getpid())]
        command += [] if frequency is None else ["--frequency", repr(float(frequency))]
        command += ["--local"] if local else []
        command += ["--calibrated"] if calibrated else []
        command += ["--polyscope-x"] if polyscope_x else []
        command += ["--clock", clock] if clock else []
        command += [] if joints is None else ["--joints=" + ",".join(repr(degrees(q)) for q in joints)]
        process = ChildProcess(command, prompt=True)
        try:
            ready = json.loads(process.read_line(timeout))
            return cls(process, address, int(ready["fault_port"]))
        except BaseException as error:
            process.kill()
            reason = process.last_error or str(error)
            process.release()
            if not isinstance(error, Exception):
                raise
            raise VirtualControllerError(
                f"virtual controller at {address}: not ready within {timeout:g} s: {reason}"
            ) from error

    def fault(self, name: str, *, timeout: float = REPLY_TIME, **arguments: Any) -> dict[str, Any]:
        """Inject a fault, or read the controller's internal state; see docs/reference/virtual-devices.md for names.

        Args:
            name: of the fault.
            timeout: longest wait for the reply [s].
            arguments: of the fault.

        Returns:
            The reply; {'ok': True} at least.

        Raises:
            VirtualControllerError: the fault is unknown, its arguments are wrong, or no reply came.
        """
        try:
            with socket.create_connection((self.address, self.fault_port), timeout=timeout) as connection:
                connection.sendall(json.dumps({"fault": name, **arguments}).encode() + b"\n")
                with connection.makefile("rb") as lines:
                    line = lines.readline()
            answer: dict[str, Any] = json.loads(line)
        except (OSError, ValueError) as error:
            raise VirtualControllerError(f"virtual controller at {self.address}: '{name}': {error}") from error
        if not answer.get("ok"):
            raise VirtualControllerError(f"virtual controller at {self.address}: {answer.get('error')}")
        return answer

    @property
    def alive(self) -> bool:
        """Whether its process runs."""
        return self._process.alive

    def close(self, timeout: float = 5.0) -> None:
        """End the process."""
        self._process.close(timeout, terminate=True)

    def __enter__(self) -> VirtualController:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
