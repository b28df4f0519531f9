"""Room on the disk that a run keeps free for itself, so that no pour is made that could not be written down.

A file beside the journal holds the room from the run's beginning on. Where the disk gets full while a pour is under way
the file is let go of, and the pour's records go where it was. Before the next pour it has to be there again.

Limitations: on file systems that copy on write or compress (btrfs, zfs) a file's length promises less than its room.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from orchestrator.run_errors import RunError

MB = 1_000_000

RESERVE = 12 * MB
"""A pour's records are some 200 kB with all pages of the journal that they touch; SQLite's log of changes grows to 4 MB
before it is copied into the journal, and so does the journal then [bytes]."""

FOR_A_POUR = 8 * MB
"""What has to be free beside the reserve when a pour begins: recording and figures grow beside the journal [bytes]."""

TO_BEGIN = RESERVE + FOR_A_POUR + 20 * MB
"""What has to be free where a run begins: its journal, a recording and the figures of a small campaign [bytes]."""


class NoSpaceError(RunError):
    """The disk has not enough room for what comes next; nothing was begun, and nothing is lost."""

    exit_code = 3


def free_space(path: Path) -> int:
    """Bytes that this user may still write on the disk of a file or folder, or of where it would be made."""
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    found = os.statvfs(there)
    return found.f_bavail * found.f_frsize


def require_space(path: Path, needed: int, purpose: str) -> None:
    """See that there is room.

    Args:
        path: file or folder on the disk.
        needed: [bytes].
        purpose: ends 'N MB are needed …', for people.

    Raises:
        NoSpaceError: with path, room needed and room free.
    """
    free = free_space(path)
    if free < needed:
        raise NoSpaceError(
            f"{path}: {free / MB:.1f} MB are free on its disk, and {needed / MB:.0f} MB are needed {purpose}"
        )


class Reserve:
    """The room of one run.

    Args:
        path: of the file that holds it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._held = False

    def take(self) -> None:
        """Hold the room, unless it is held.

        Raises:
            NoSpaceError: there isn't so much.
        """
        if self._held:
            return
        try:
            with self._path.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, RESERVE)
        except OSError as error:
            self._remove()
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            require_space(self._path.parent, RESERVE + FOR_A_POUR, _PURPOSE)
            raise NoSpaceError(  # a quota, which the disk knows nothing of
                f"{self._path.parent}: {RESERVE / MB:.0f} MB are needed {_PURPOSE}, and can't be had "
                f"({error.strerror}; {free_space(self._path) / MB:.0f} MB are free on the disk)"
            ) from None
        self._held = True

    def check_pour(self) -> None:
        """See that whatever comes of the next pour can be written down; hold the room anew if it had been used.

        Raises:
            NoSpaceError: it can't.
        """
        require_space(self._path.parent, FOR_A_POUR + (0 if self._held else RESERVE), _PURPOSE)
        self.take()

    def release(self) -> bool:
        """Let go of the room, for something that has to be written now. Returns whether it was held."""
        held, self._held = self._held, False
        if held:
            self._remove()
        return held

    def _remove(self) -> None:
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


_PURPOSE = "before anything is poured, so that whatever comes of a pour can be written down"
