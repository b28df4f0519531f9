"""What a virtual bench has in place of hardware: a controller without a robot, a balance on a pseudo-terminal.

Plain and blocking; `actors.device` puts it on the machine that the bench is on, beside the drivers that talk to it.
"""

from __future__ import annotations

import random
import socket
from dataclasses import dataclass
from typing import Any

from actors.arm.spec import UrArmSpec
from actors.balance.spec import AUTO, BalanceSpec
from actors.balance.virtual_serial.handle import VirtualSerialBalance
from actors.protocols import LaboratoryError
from actors.virtual_ur.launcher import VirtualController, VirtualControllerError

PORTS = (29999, 30001, 30002, 30003, 30004, 30011, 30012)
"""Of a controller: the same at every address."""

ATTEMPTS = 20

FREQUENCY = 125.0
"""Control cycles per controller second [Hz]; in scaled time more cost much and change nothing that is weighed."""


@dataclass(frozen=True)
class Addresses:
    """Where drivers find what was started.

    Attributes:
        controller: of the arm.
        port: of the balance; '' if there is none.
    """

    controller: str
    port: str


@dataclass(frozen=True)
class History:
    """What the controller's joints did.

    Attributes:
        times: of the controller [s], increasing.
        joints: six at each of these [rad].
        now: when it was asked [s].
    """

    times: tuple[float, ...]
    joints: tuple[tuple[float, ...], ...]
    now: float


class VirtualSite:
    """Controller and balance in processes of their own, which end with this one.

    Args:
        arm: which model stands where.
        balance: what the balance's data sheet says; None for weights that are typed.
    """

    def __init__(self, arm: UrArmSpec, balance: BalanceSpec | None) -> None:
        self._controller = _start_controller(arm)
        self._balance: VirtualSerialBalance | None = None
        try:
            if balance is not None and balance.serial is not None and balance.virtual is not None:
                self._balance = _start_balance(balance, arm.time_scale)
        except BaseException:
            self._controller.close()
            raise

    def addresses(self) -> Addresses:
        """Where they are."""
        return Addresses(self._controller.address, "" if self._balance is None else self._balance.port)

    def prepare(self, seed: tuple[int, ...]) -> None:
        """A new pour: the balance's chance begins anew, and it is empty."""
        if self._balance is not None:
            self._balance.prepare(seed)

    def put(self, mass: float) -> None:
        """What stands on the balance from now on [kg]."""
        if self._balance is not None:
            self._balance.put(mass)

    def history(self, since: float) -> History:
        """What the joints did since a controller time [s]; it is kept for two minutes.

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
        """Ask the controller for a fault, or what it knows of itself; see docs/virtual-ur.md."""
        try:
            return self._controller.fault(name, **arguments)
        except VirtualControllerError as error:
            raise LaboratoryError(str(error)) from error

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """Have something done to the balance: 'unplug', 'plug', 'faults' …, see `VirtualSerialBalance`."""
        if self._balance is None:
            raise LaboratoryError("there is no virtual balance here")
        return self._balance.order(what, **values)

    def close(self) -> None:
        """End both. May be called again."""
        self._controller.close()
        if self._balance is not None:
            self._balance.close()


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


def _start_balance(balance: BalanceSpec, time_scale: float) -> VirtualSerialBalance:
    assert balance.serial is not None
    dialect = "kcp" if balance.serial.dialect == AUTO else balance.serial.dialect
    # A line that takes no time: in scaled time its characters would be the slowest thing on the bench.
    return VirtualSerialBalance.start(dialect, baud=0, scale=balance.virtual, time_scale=time_scale, latency=0.002)
