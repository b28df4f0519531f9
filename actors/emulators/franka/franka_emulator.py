"""The emulated Franka arm of a virtual bench, in a process of its own (`franka_process`)."""

from __future__ import annotations

import json
import math
import os
import random
import tempfile
import threading
from pathlib import Path
from typing import Any

from actors.arm.arm_settings import History
from actors.arm.franka.franka_arm import FrankaSettings
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import PATIENCE, SharedClock
from actors.runtime.child_process import START_DEADLINE, ChildProcess, python_module
from actors.runtime.ray_cleanup import MARK
from actors.runtime.remote_object import DeviceLostError
from sim_engine.resources import require

REPLY_TIME = 5.0 * PATIENCE
"""Longest wait for a reply of the process [s]."""

FAULTS = ("trip", "mend", "unplug", "plug")


class FrankaEmulator:
    """See `actors.arm.arm_settings.ArmEmulator`.

    Args:
        spec: settings of the arm.

    Raises:
        LaboratoryError: the simulator is not installed, or does not start.
    """

    def __init__(self, spec: FrankaSettings) -> None:
        require("franky_sim", "a virtual Franka arm")
        if spec.model != "fr3":
            raise LaboratoryError("the emulated Franka is an FR3; write 'model: fr3', or 'mode: hardware'")
        self._clock = Path(tempfile.mkdtemp(prefix="decant-clock-", dir=os.environ.get(MARK))) / "clock"
        draw = random.SystemRandom()
        SharedClock.create(self._clock)
        address = f"127.{draw.randint(1, 254)}.{draw.randint(0, 254)}.{draw.randint(1, 254)}"
        self._spec = spec.with_values(clock=str(self._clock), address=address)
        self._asking = threading.Lock()
        self._process = ChildProcess(
            [
                *python_module("actors.emulators.franka.franka_process", "--address", address),
                *("--clock", str(self._clock)),
                *("--time-scale", repr(spec.time_scale), "--joints=" + ",".join(repr(q) for q in spec.home_joints)),
            ],
            prompt=True,
        )
        try:
            json.loads(self._process.read_line(START_DEADLINE))
        except (OSError, ValueError, EOFError, TimeoutError) as error:
            reason = self._process.last_error or str(error)
            self.close()
            raise LaboratoryError(f"no virtual Franka could be started: {reason}") from error

    @property
    def arm(self) -> FrankaSettings:
        """See `ArmEmulator.arm`."""
        return self._spec

    @property
    def true_arm(self) -> FrankaSettings:
        """See `ArmEmulator.true_arm`: the lengths are nominal."""
        return self._spec

    def install(self) -> None:
        """See `ArmEmulator.install`: nothing is needed."""

    def history(self, since: float) -> History:
        """See `ArmEmulator.history`; ten minutes of it are kept.

        Raises:
            DeviceLostError: the process does not reply.
        """
        try:
            reply = self._ask({"since": since if math.isfinite(since) else math.copysign(1e12, since)})
        except LaboratoryError as error:
            raise DeviceLostError(f"what the virtual arm did is not known: {error}") from error
        return History(tuple(reply["times"]), tuple(map(tuple, reply["joints"])), float(reply["now"]))

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `ArmEmulator.fault`: 'pace', 'state', and these faults.

        - 'trip': a reflex stops the robot; 'mend': it is over. A client's recovery ends it as well.
        - 'unplug': no client reaches the robot, which stops; 'plug': the cable is back.
        - 'kill': the simulator's process ends.
        """
        if name == "kill":
            self._process.kill()
            return {}
        if name in FAULTS:
            self._ask({"orders": [name]})
        elif name == "pace":
            self._ask({"pace": arguments["scale"]})
        elif name != "state":
            known = ", ".join((*FAULTS, "kill"))
            raise LaboratoryError(f"the virtual Franka has no fault '{name}'; there are {known}")
        return {"runtime_state": "STOPPED", "speeds": [0.0], "time": self.history(math.inf).now}

    def close(self) -> None:
        """End it. May be called again."""
        self._process.close(terminate=True)
        SharedClock.remove(self._clock)

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        try:
            with self._asking:
                self._process.write(json.dumps(request).encode() + b"\n")
                reply: dict[str, Any] = json.loads(self._process.read_line(REPLY_TIME))
        except (OSError, ValueError, EOFError, TimeoutError) as error:
            raise LaboratoryError(f"the virtual Franka does not reply: {error}") from error
        return reply
