"""The emulated Hand of a virtual Franka: franky-sim's server of the protocol, with fingers that hold a vessel."""

from __future__ import annotations

import random
import threading
import time
from typing import Any

from franky_sim.franka_gripper_protocol import GripperCommandStatus
from franky_sim.franka_gripper_server import FrankaGripperServer
from franky_sim.franka_server import BaseCommand

from actors.emulators.gripper_emulators import Fingers
from actors.grippers.franka_hand import HandSettings

TICK = 2e-3
"""Time between two states of the Hand [s]."""


class _Hand:
    """What the server moves in place of a simulated robot."""

    def __init__(self, fingers: Fingers) -> None:
        self._fingers = fingers

    @property
    def hand_width(self) -> float:
        """Between the fingertips [m]."""
        return self._fingers.width

    def set_hand_goal(self, width: float, speed: float, force: float) -> None:
        """Begin to move to a width [m]."""
        self._fingers.move(width, speed)


class _Server(FrankaGripperServer):  # type: ignore[misc]  # it has no types
    """The Hand's port, which also answers a command that is stopped."""

    def stop(self, command_id: int, client: Any) -> None:
        """Stop the fingers."""
        command, number = self._pending_command_type, self._pending_command_id
        super().stop(command_id, client)
        if number is not None:
            code = {"command_type_struct": "H", "status_type_struct": "H"}
            BaseCommand.send_response(client, command, number, GripperCommandStatus.kAborted, **code)


class HandEmulator:
    """See `GripperEmulator`. It runs in a thread of this process, at an address of its own.

    Args:
        settings: of the Hand.
    """

    def __init__(self, settings: HandSettings) -> None:
        draw = random.SystemRandom()
        address = f"127.{draw.randint(1, 254)}.{draw.randint(0, 254)}.{draw.randint(1, 254)}"
        self.gripper = settings.with_values(address=address)
        self.fingers = Fingers(0.0, settings.widest, settings.time_scale, settings.clock)
        self._server = _Server(_Hand(self.fingers), address)
        self._server.init()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hand", daemon=True)
        self._thread.start()

    def put(self, width: float | None) -> None:
        """See `GripperEmulator.put`."""
        self.fingers.put(width)

    def fault(self, name: str, value: float = 1.0) -> None:
        """See `GripperEmulator.fault`; a Hand without power sends no state."""
        self.fingers.fault(name, value)

    def close(self) -> None:
        """See `GripperEmulator.close`."""
        self._ending.set()
        self._thread.join()
        self._server.reset_state()
        self._server.cleanup()

    def _run(self) -> None:
        while not self._ending.wait(TICK):
            time.sleep(self.fingers.delay)
            if self.fingers.powered:
                self._server.process_commands()
                self._server.send_state()
