"""Where Decant keeps what belongs to a machine rather than to one run: the catalogue of runs, the daemon's queue."""

from __future__ import annotations

import os
import stat
from pathlib import Path

VARIABLE = "DECANT_STATE"


def state_directory() -> Path:
    """`$DECANT_STATE`, else what systemd gives a unit, else `decant` in `$XDG_STATE_HOME` or `~/.local/state`.

    It need not exist yet.

    Raises:
        OSError: nothing says where: none of these is set, and this user has no home.
    """
    if named := os.environ.get(VARIABLE):
        return Path(named).expanduser().absolute()
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if shared := os.environ.get("XDG_STATE_HOME"):
        return Path(shared).expanduser().absolute() / "decant"
    try:
        return Path.home() / ".local" / "state" / "decant"
    except RuntimeError:
        raise OSError(f"this user has no home directory; set {VARIABLE} to a folder for Decant's state") from None


def make_state_directory(path: Path) -> None:
    """Make the state directory, or take one that exists, and let only its owner read it (0700).

    It holds tokens, campaigns and results. Call this before anything is written there. A directory of another user is
    left as it is: its mode is that user's decision.

    Raises:
        OSError: it can't be made.
    """
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    found = path.stat()
    mode = stat.S_IMODE(found.st_mode)
    if mode & 0o077 and found.st_uid == os.geteuid():
        path.chmod(mode & 0o700)


def use_state_directory(path: Path) -> None:
    """Have this process and those that it starts keep their state there: what `--state` does."""
    os.environ[VARIABLE] = str(path.expanduser().absolute())
