"""A Franka arm: its settings, and the driver's side of it.

- `FrankaSettings` are plain values; `actors.device_kinds.FrankaKind` joins them with the rest.
- `FrankaRobot` is the `VelocityRobot` of `actors.arm.joint_driver.VelocityArm`: it passes every call to a process of
  its own (`actors.arm.franka.franka_worker`), which holds the client library. That process brings the cup upright if
  this one is gone or silent.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmFacts
from actors.arm.joint_driver import JointReading
from actors.arm.planned_pour import PourPath
from actors.arm.urdf_chain import ChainArmSettings, ChainModel, chain_of
from actors.runtime.bench_clock import device_clock
from actors.runtime.child_process import ConnectedProcess
from sim_engine.settings.model import NOT_IN_FINGERPRINT, Choice, Example, Text

FloatArray = NDArray[np.float64]

MODELS = ("fr3", "panda")

ANSWER_TIME = 1.0
"""Longest wait for the worker's reply [s of the clock], ten times as long on a virtual bench."""

POLL = 0.1
"""Time between two looks at the clock in that wait [s]."""

OPEN_TIME = 20.0
"""Longest wait for the client library to connect [s]."""


class FrankaSettings(ChainArmSettings):
    """A Franka arm that holds the pourer."""

    kind: Literal["franka"] = "franka"
    """A Franka Research 3, or a Panda."""

    model: Annotated[str, Choice(lambda: MODELS, similar=False), Example("fr3")]
    """Model of the robot."""

    address: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """Network address of its control box; a virtual laboratory starts its own robot."""

    @property
    def kinematics(self) -> ChainModel:
        """See `JointArmSettings.kinematics`: nominal lengths, with the Hand."""
        return chain_of(Path(__file__).with_name(f"{self.model}.urdf"), "base", "flange")

    @property
    def title(self) -> str:
        """See `ArmSettings.title`."""
        return f"{self.model.upper()} at {self.address}"


class FrankaRobot:
    """See `actors.arm.joint_driver.VelocityRobot`.

    Args:
        spec: model and address of the robot.
    """

    def __init__(self, spec: FrankaSettings) -> None:
        self._spec = spec
        self._asking = threading.Lock()
        self._worker: ConnectedProcess | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the worker."""
        return None if self._worker is None else self._worker.pid

    def connect(self) -> ArmFacts:
        """See `VelocityRobot.connect`; starts a new worker."""
        self.close()
        self._worker = ConnectedProcess("actors.arm.franka.franka_worker", prompt=True)
        facts: ArmFacts = self._ask("open", self._spec, deadline=OPEN_TIME)
        return facts

    def read(self) -> JointReading:
        """See `VelocityRobot.read`."""
        reading: JointReading = self._ask("read")
        return reading

    def pours(self, path: PourPath | None) -> None:
        """State the pour under way, along which the worker brings the cup upright; None after its end."""
        self._ask("pours", path)

    def turn(self, speeds: FloatArray, seconds: float) -> None:
        """See `VelocityRobot.turn`."""
        self._ask("turn", speeds, seconds)

    def halt(self) -> None:
        """See `VelocityRobot.halt`."""
        self._ask("halt", deadline=3.0)

    def recover(self) -> str:
        """Have the robot recover from a reflex or a violated limit, after a person has looked into it."""
        done: str = self._ask("recover", deadline=OPEN_TIME)
        return done

    def close(self) -> None:
        """See `VelocityRobot.close`; waits until the worker has let go of the robot."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.connection.close()
            worker.close()

    def _ask(self, name: str, *arguments: object, deadline: float = ANSWER_TIME) -> Any:
        """Have the worker do something.

        Raises:
            ConnectionError: it does not reply, or cannot reach the robot.
            ArmError: as it reports.
        """
        with self._asking:
            worker = self._worker
            if worker is None or worker.connection.closed:
                raise ConnectionError(f"the arm at {self._spec.address} is not connected; connect first")
            connection, address = worker.connection, self._spec.address
            try:
                connection.send((name, arguments))
                clock = device_clock(self._spec.clock)
                end = clock.now + deadline * clock.patience
                while not (replied := connection.poll(POLL)) and clock.now < end:
                    pass
                reply = connection.recv() if replied else None
            except (OSError, EOFError) as error:
                connection.close()
                reason = f": {worker.last_error}" if worker.wait(1.0) and worker.last_error else ""
                raise ConnectionError(f"the driver's process for {address} has ended{reason}") from error
            if not replied:
                connection.close()  # it then brings the cup upright, and ends
                if name == "open":
                    raise ConnectionError(
                        f"the robot at {address} does not reply: check that no other client is in control"
                    )
                raise ConnectionError(f"the driver's process for {address} does not reply")
        if isinstance(reply, Exception):
            raise reply
        return reply
