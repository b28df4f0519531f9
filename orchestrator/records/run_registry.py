"""The state directory of a machine, and the list of folders that contain runs.

The list is a text file to which every new run is appended; all other data are read from the runs. One line is written
without a lock and without a database, so that a search never blocks a run.

The state directory contains data of the machine rather than of one run: the catalogue of runs, the daemon's queue.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path

VARIABLE = "DECANT_STATE"


def state_directory() -> Path:
    """`$DECANT_STATE`, else systemd's `$STATE_DIRECTORY`, else `decant` in `$XDG_STATE_HOME` or `~/.local/state`.

    It need not exist yet.

    Raises:
        OSError: there is no default: none of these is set, and this user has no home.
    """
    if named := os.environ.get(VARIABLE):
        return Path(named).expanduser().absolute()
    if configured := os.environ.get("STATE_DIRECTORY"):
        return Path(configured.split(":")[0])
    if shared := os.environ.get("XDG_STATE_HOME"):
        return Path(shared).expanduser().absolute() / "decant"
    try:
        return Path.home() / ".local" / "state" / "decant"
    except RuntimeError:
        raise OSError(f"this user has no home directory; set {VARIABLE} to a folder for Decant's state") from None


def make_state_directory(path: Path) -> None:
    """Create the state directory if needed, and restrict it to its owner (0700).

    It contains tokens, campaigns and results. Call this before anything is written there. A directory of another user
    is left unchanged: its mode is that user's decision.

    Raises:
        OSError: it can't be created.
    """
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    status = path.stat()
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077 and status.st_uid == os.geteuid():
        path.chmod(mode & 0o700)


def use_state_directory(path: Path) -> None:
    """Set the state directory of this process and its child processes, as `--state` does."""
    os.environ[VARIABLE] = str(path.expanduser().absolute())


LIST_NAME = "runs.txt"

_log = logging.getLogger(__name__)
_reported = False


def register(directory: Path) -> None:
    """Add a run's folder to the list.

    A state directory that can't be written is reported once, and never stops a run.
    """
    global _reported
    try:
        enter([directory])
    except (OSError, UnicodeError) as error:
        if not _reported:
            _log.warning(
                "note: this run is not in the catalogue of runs (%s); `decant runs add %s` enters it later",
                error,
                directory,
            )
        _reported = True


def enter(directories: Iterable[Path], state: Path | None = None) -> None:
    """Append folders to the list.

    Raises:
        OSError: it can't be written.
    """
    path = (state or state_directory()) / LIST_NAME
    make_state_directory(path.parent)
    lines = "".join(f"{directory.absolute()}\n" for directory in directories)
    # One write to a file opened for appending: two runs that begin at the same moment don't mix their lines.
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        os.write(descriptor, lines.encode())
    finally:
        os.close(descriptor)


def known(state: Path) -> list[Path]:
    """The folders of the list, each once, in the order in which they were added.

    Raises:
        OSError: the list exists and can't be read.
    """
    path = state / LIST_NAME
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    return [Path(line) for line in dict.fromkeys(lines) if line.startswith("/")]


def runs_below(directory: Path) -> Iterator[Path]:
    """Run folders in a folder, at any depth, including itself; links are not followed."""
    from orchestrator.records.journal import JOURNAL_NAME  # late: clients of the daemon need only its state directory

    for folder, folders, files in os.walk(directory):
        folders.sort()
        if JOURNAL_NAME in files:
            folders.clear()  # a run contains no other run
            yield Path(folder)
