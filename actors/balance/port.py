"""What `decant doctor` says about a serial port, before anything is opened for good."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from actors.balance.wire import port_advice, ports
from actors.checks import Check


def look_at_port(name: str) -> Check:
    """Whether it is there, is a serial port, and may be opened.

    Args:
        name: as in the laboratory's file.
    """
    port = Path(name)
    if not port.exists():
        known = ports()
        there = f"there are {', '.join(known)}" if known else "no serial port is there"
        return Check("balance port", "fail", f"{port} isn't there", f"plug the cable in, switch it on; {there}")
    if (other := _other_than_a_port(port)) is not None:
        return Check("balance port", "fail", f"{port} is {other}", "name the serial port that the balance is on")
    if not os.access(port, os.R_OK | os.W_OK):
        todo = f"add the user to the group '{_group(port)}' and log in anew"
        return Check("balance port", "fail", f"this user may not open {port}", todo)
    if (advice := port_advice(name)) is not None:
        return Check("balance port", "warn", str(port), advice)
    return Check("balance port", "ok", str(port))


def _group(port: Path) -> str:
    try:
        return port.group()
    except (KeyError, OSError):
        return "dialout"


def _other_than_a_port(port: Path) -> str | None:
    """What stands there, if it is not a serial port; None where it is one, or can't be opened to see."""
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
