"""The emulated UR controller of a virtual bench.

`UrEmulator` starts a controller with the settings of an arm, fills in its address, and reads what the arm truly did.
"""

from __future__ import annotations

import os
import random
import socket
import struct
import tempfile
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

from actors.arm.arm_settings import History
from actors.arm.ur_settings import UrArmSettings
from actors.emulators.ur_controller.controller_process import REPLY_TIME, VirtualController, VirtualControllerError
from actors.emulators.ur_controller.robot import MODELS, calibrated
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import SharedClock
from actors.runtime.ray_cleanup import MARK
from actors.runtime.remote_object import DeviceLostError

PORTS = (29999, 30001, 30002, 30003, 30004, 30011, 30012)
"""Ports of a controller: the same at every address."""

ATTEMPTS = 20

FREQUENCY = 125.0
"""Control cycles per controller second [Hz]; in scaled time, more cost much and do not change the weighed masses."""


SCRIPTS = 30003


class UrEmulator:
    """A controller in a process of its own, which ends with this process.

    Args:
        spec: settings of the arm.
    """

    def __init__(self, spec: UrArmSettings) -> None:
        self._clock = Path(tempfile.mkdtemp(prefix="decant-clock-", dir=os.environ.get(MARK))) / "clock"
        SharedClock.create(self._clock)
        self._spec = spec.with_values(clock=str(self._clock))
        try:
            self._controller = _start_controller(self._spec)
        except BaseException:
            SharedClock.remove(self._clock)
            raise

    @property
    def arm(self) -> UrArmSettings:
        """See `ArmEmulator.arm`."""
        return self._spec.with_values(address=self._controller.address)

    @property
    def true_arm(self) -> UrArmSettings:
        """See `ArmEmulator.true_arm`; its robot is calibrated, as a real one is."""
        return self.arm.with_values(calibration=calibrated(MODELS[self._spec.model]).calibration)

    def install(self) -> None:
        """See `ArmEmulator.install`; sets gravity, TCP and payload, which a real controller has in its installation."""
        arm = self._spec
        tool = ", ".join(f"{value!r}" for value in arm.tool.as_list)
        centre = ", ".join(f"{value!r}" for value in arm.payload_centre.vector)
        up = ", ".join(f"{9.82 * value!r}" for value in arm.mount.up)
        lines = [f"set_gravity([{up}])", f"set_tcp(p[{tool}])", f"set_payload({arm.payload!r}, [{centre}])"]
        program = "\n  ".join(["def install():", *lines]) + "\nend\n"
        before = self._state()["messages"]
        with socket.create_connection((self._controller.address, SCRIPTS), timeout=REPLY_TIME) as connection:
            connection.sendall(program.encode("ascii"))
            end = time.monotonic() + REPLY_TIME
            while (state := self._state())["runtime_state"] != "STOPPED" or state["messages"] == before:
                if time.monotonic() > end:
                    raise LaboratoryError("the virtual arm does not take its settings over")
                time.sleep(0.01)

    def _state(self) -> dict[str, Any]:
        return self._controller.fault("state")

    def history(self, since: float) -> History:
        """See `ArmEmulator.history`; ten minutes of it are kept.

        Raises:
            DeviceLostError: the controller does not reply.
        """
        try:
            answer = self._controller.fault("samples", since=since)
        except VirtualControllerError as error:
            raise DeviceLostError(f"what the virtual arm did is not known: {error}") from error
        samples = struct.iter_unpack("7d", b64decode(answer["samples"]))
        moments = [(t, joints) for t, *joints in samples]
        return History(tuple(t for t, _ in moments), tuple(tuple(q) for _, q in moments), float(answer["now"]))

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `ArmEmulator.fault`, and docs/reference/virtual-devices.md."""
        try:
            return self._controller.fault(name, **arguments)
        except VirtualControllerError as error:
            raise LaboratoryError(str(error)) from error

    def close(self) -> None:
        """End it. May be called again."""
        self._controller.close()
        SharedClock.remove(self._clock)


def _start_controller(arm: UrArmSettings) -> VirtualController:
    """Start a controller at a free random loopback address, because campaigns and tests run in parallel."""
    chance, reason = random.SystemRandom(), ""
    for _ in range(ATTEMPTS):
        address = f"127.{chance.randint(1, 254)}.{chance.randint(0, 254)}.{chance.randint(1, 254)}"
        if not _is_free(address):
            continue
        try:
            frequency = FREQUENCY if arm.time_scale > 1.0 else None
            return VirtualController.start(
                address, arm.model, arm.time_scale, frequency, calibrated=True, joints=arm.home.angles, clock=arm.clock
            )
        except VirtualControllerError as error:
            reason = str(error)
    raise LaboratoryError(f"no virtual controller could be started: {reason or 'no free loopback address was found'}")


def _is_free(address: str) -> bool:
    for port in PORTS:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError:
                return False
    return True
