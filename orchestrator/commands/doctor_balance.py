"""What `decant doctor` finds out about a balance. It asks questions; a tare is tried only if it was asked for."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from actors.balance.errors import BalanceError
from actors.balance.serial_balance import SerialBalance
from actors.balance.spec import BalanceSpec
from orchestrator.commands.doctor_look import Check

COARSE = 0.5e-3
"""A display with larger steps tells little of small spills [kg]."""


def look_at_balance(spec: BalanceSpec | None, *, tare: bool) -> list[Check]:
    """Port, dialect, a stable reading, its step; and whether it obeys a tare.

    Args:
        spec: as in the laboratory's file, its port filled in.
        tare: also tare it.
    """
    if spec is None:
        return [Check("balance", "fail", "the file has none", "add a 'balance' section, or 'placement: manual'")]
    if spec.serial is None:
        return [Check("balance", "ok", "all weights are typed by the operator")]
    port = Path(spec.serial.port)
    if not port.exists():
        known = (
            sorted(str(p) for p in Path("/dev/serial/by-id").glob("*")) if Path("/dev/serial/by-id").is_dir() else []
        )
        there = f"there are {', '.join(known)}" if known else "no serial port is there"
        return [Check("balance port", "fail", f"{port} isn't there", f"plug the cable in, switch it on; {there}")]
    if (other := _other_than_a_port(port)) is not None:
        return [Check("balance port", "fail", f"{port} is {other}", "name the serial port that the balance is on")]
    if not os.access(port, os.R_OK | os.W_OK):
        return [
            Check(
                "balance port",
                "fail",
                f"this user may not open {port}",
                f"add the user to the group '{_group(port)}' and log in anew",
            )
        ]
    checks = [Check("balance port", "ok", str(port))]
    balance = SerialBalance(spec.serial)
    try:
        checks.append(Check("balance", "ok", balance.connect()))
        weight = balance.weigh()
        checks.append(Check("balance reading", "ok", f"{1e3 * weight.mass:g} g, stable"))
        coarse = weight.step > COARSE
        advice = "spills of less than a few steps can't be told apart; a finer balance would help" if coarse else ""
        checks.append(Check("balance step", "warn" if coarse else "ok", f"{1e3 * weight.step:g} g", advice))
        if tare:
            balance.tare()
            checks.append(Check("balance tare", "ok", "it obeyed, and rests at zero"))
        else:
            checks.append(
                Check("balance tare", "ok", "not tried; --tare tries it (what is on it counts as nothing then)")
            )
    except BalanceError as error:
        checks.append(
            Check("balance", "fail", str(error), "docs/balances.md has a table of what it says and what to do")
        )
    finally:
        balance.close()
    return checks


def _group(port: Path) -> str:
    try:
        return port.group()
    except (KeyError, OSError):
        return "dialout"


def _other_than_a_port(port: Path) -> str | None:
    """What stands there, if it is no serial port; None where it is one, or can't be opened to see."""
    if port.is_dir():
        return "a folder"
    if not stat.S_ISCHR(port.stat().st_mode):
        return "a file"
    try:
        opened = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        return None if os.isatty(opened) else "a device, and not a serial port"
    finally:
        os.close(opened)
