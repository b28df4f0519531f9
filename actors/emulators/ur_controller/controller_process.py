"""Starting a virtual controller from Python, talking to its fault port, and making sure that it ends.

The virtual controller as the emulator of a UR arm on a virtual bench; see `actors.bench.device_emulators.ArmEmulator`.
"""

from __future__ import annotations

import json
import os
import random
import socket
import time
from collections.abc import Sequence
from dataclasses import replace
from math import degrees
from types import TracebackType
from typing import Any

from actors.arm.arm_settings import UrArmSpec
from actors.bench.device_emulators import History
from actors.interfaces import LaboratoryError
from actors.runtime.child_process import ChildProcess, python_module

START_TIME = 40.0
"""Longest wait for the process to be ready [s]."""


class VirtualControllerError(Exception):
    """The process doesn't start, or doesn't understand a fault; the text says why."""


class VirtualController:
    """A controller in a process of its own. Made by `start`; a context manager that closes.

    Attributes:
        address: of its ports 30001 … 30004 and 29999.
        fault_port: where faults are asked for, at the same address.
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
        joints: Sequence[float] | None = None,
        prioritised: bool = True,
        patience: float = START_TIME,
    ) -> VirtualController:
        """Start the process and wait until all its ports are open.

        Args:
            address: any loopback address; each controller needs one of its own.
            model: 'ur10' or 'ur10e'.
            time_scale: controller seconds per wall second.
            frequency: control cycles per controller second [Hz]; the model's by default.
            state: of power, 'running', 'idle' or 'off'.
            local: begin in local control.
            joints: six positions to begin with [rad]; a pose in the middle of its reach by default.
            prioritised: its clock goes before other work on the machine; see docs/virtual-ur.md, "Control period".
            patience: longest wait [s].

        Raises:
            VirtualControllerError: it did not get ready, with what it said.
        """
        command = python_module("actors.emulators.ur_controller", "--address", address, "--model", model)
        command += ["--time-scale", repr(float(time_scale)), "--state", state, "--parent", str(os.getpid())]
        command += [] if frequency is None else ["--frequency", repr(float(frequency))]
        command += ["--local"] if local else []
        command += [] if prioritised else ["--normal-priority"]
        command += [] if joints is None else ["--joints=" + ",".join(repr(degrees(q)) for q in joints)]
        process = ChildProcess(command)
        try:
            ready = json.loads(process.read_line(patience))
            return cls(process, address, int(ready["fault_port"]))
        except BaseException as error:
            process.kill()
            said = process.last_error or str(error)
            process.release()
            if not isinstance(error, Exception):
                raise
            raise VirtualControllerError(
                f"virtual controller at {address}: not ready within {patience:g} s: {said}"
            ) from error

    def fault(self, name: str, *, patience: float = 5.0, **arguments: Any) -> dict[str, Any]:
        """Ask for a fault, or for what the controller knows of itself; see docs/virtual-ur.md for names.

        Args:
            name: of the fault.
            patience: longest wait for the answer [s].
            arguments: of the fault.

        Returns:
            What it answers; {'ok': True} at least.

        Raises:
            VirtualControllerError: it doesn't know such a fault, or its arguments are wrong, or it doesn't answer.
        """
        try:
            with socket.create_connection((self.address, self.fault_port), timeout=patience) as connection:
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

    def close(self, patience: float = 5.0) -> None:
        """End the process."""
        self._process.close(patience, terminate=True)

    def __enter__(self) -> VirtualController:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


PORTS = (29999, 30001, 30002, 30003, 30004, 30011, 30012)
"""Ports of a controller: the same at every address."""

ATTEMPTS = 20

FREQUENCY = 125.0
"""Control cycles per controller second [Hz]; in scaled time more cost much and change nothing that is weighed."""


SCRIPTS = 30003


class UrEmulator:
    """A controller in a process of its own, which ends with this one.

    Args:
        spec: which model stands where.
    """

    def __init__(self, spec: UrArmSpec) -> None:
        self._spec = spec
        self._controller = _start_controller(spec)

    @property
    def arm(self) -> UrArmSpec:
        """See `ArmEmulator.arm`."""
        return replace(self._spec, address=self._controller.address)

    def install(self) -> None:
        """See `ArmEmulator.install`: on a real controller somebody has set TCP and payload in the installation."""
        arm = self._spec
        tool = ", ".join(f"{value!r}" for value in arm.tool.as_list)
        centre = ", ".join(f"{value!r}" for value in arm.payload_centre)
        up = ", ".join(f"{9.82 * value!r}" for value in arm.mount.up)
        lines = [f"set_gravity([{up}])", f"set_tcp(p[{tool}])", f"set_payload({arm.payload!r}, [{centre}])"]
        program = "\n  ".join(["def install():", *lines]) + "\nend\n"
        with socket.create_connection((self._controller.address, SCRIPTS), timeout=5.0) as connection:
            connection.sendall(program.encode("ascii"))
            time.sleep(0.3)

    def history(self, since: float) -> History:
        """See `ArmEmulator.history`; it is kept for two minutes.

        Raises:
            LaboratoryError: the controller doesn't say.
        """
        try:
            now = float(self._controller.fault("state")["time"])
            answer = self._controller.fault("history", since=since)
        except VirtualControllerError as error:
            raise LaboratoryError(f"what the virtual arm did is not known: {error}") from error
        return History(tuple(answer["times"]), tuple(tuple(q) for q in answer["joints"]), now)

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `ArmEmulator.fault`, and docs/virtual-ur.md."""
        try:
            return self._controller.fault(name, **arguments)
        except VirtualControllerError as error:
            raise LaboratoryError(str(error)) from error

    def close(self) -> None:
        """End it. May be called again."""
        self._controller.close()


def _start_controller(arm: UrArmSpec) -> VirtualController:
    """At a loopback address that nobody uses: campaigns and tests run side by side."""
    chance, said = random.SystemRandom(), ""
    for _ in range(ATTEMPTS):
        address = f"127.{chance.randint(1, 254)}.{chance.randint(0, 254)}.{chance.randint(1, 254)}"
        if not _is_free(address):
            continue
        try:
            return VirtualController.start(
                address, arm.model, arm.time_scale, FREQUENCY if arm.time_scale > 1.0 else None, joints=arm.home
            )
        except VirtualControllerError as error:
            said = str(error)
    raise LaboratoryError(f"no virtual controller could be started: {said or 'no free loopback address was found'}")


def _is_free(address: str) -> bool:
    for port in PORTS:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError:
                return False
    return True
