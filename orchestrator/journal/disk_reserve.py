"""Disk space that a run reserves, so that every pour can be recorded.

A file next to the journal occupies the space from the start of the run. If the disk fills up while a pour is running,
the file is deleted and the pour's records use its space. The file must exist again before the next pour.

Limitations: on file systems that copy on write or compress (btrfs, zfs), a file's length does not guarantee its space.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from orchestrator.run_errors import RunError

MB = 1_000_000

RESERVE = 12 * MB
"""Size of the reserve [bytes].

A pour's records need about 200 kB, including all pages of the journal that they change. SQLite's write-ahead log grows
to 4 MB before it is copied into the journal, and the journal then grows by the same amount.
"""

FOR_A_POUR = 8 * MB
"""Free space needed in addition to the reserve when a pour begins, because recording and figures also grow [bytes]."""

TO_BEGIN = RESERVE + FOR_A_POUR + 20 * MB
"""Free space needed when a run begins: journal, recording and figures of a small campaign [bytes]."""


class NoSpaceError(RunError):
    """The disk has too little free space for the next step; nothing was begun, and nothing is lost."""

    exit_code = 3


def free_space(path: Path) -> int:
    """Bytes that this user may still write on the disk of a path; the path need not exist."""
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    found = os.statvfs(there)
    return found.f_bavail * found.f_frsize


def require_space(path: Path, needed: int, purpose: str) -> None:
    """Check that there is enough free space.

    Args:
        path: file or folder on the disk.
        needed: [bytes].
        purpose: completes the message 'N MB are needed …'.

    Raises:
        NoSpaceError: with path, needed space and free space.
    """
    free = free_space(path)
    if free < needed:
        raise NoSpaceError(
            f"{path}: {free / MB:.1f} MB are free on its disk, and {needed / MB:.0f} MB are needed {purpose}"
        )


class Reserve:
    """The reserved space of one run.

    Args:
        path: path of the file that occupies it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._held = False

    def take(self) -> None:
        """Reserve the space, unless it is reserved already.

        Raises:
            NoSpaceError: there is not enough.
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
            raise NoSpaceError(  # a quota, which the free space of the disk does not show
                f"{self._path.parent}: {RESERVE / MB:.0f} MB are needed {_PURPOSE}, and can't be had "
                f"({error.strerror}; {free_space(self._path) / MB:.0f} MB are free on the disk)"
            ) from None
        self._held = True

    def check_pour(self) -> None:
        """Check that the next pour can be recorded; reserve the space again if it was used.

        Raises:
            NoSpaceError: it can't be recorded.
        """
        require_space(self._path.parent, FOR_A_POUR + (0 if self._held else RESERVE), _PURPOSE)
        self.take()

    def release(self) -> bool:
        """Free the reserved space for a write that needs it. Returns whether it was reserved."""
        held, self._held = self._held, False
        if held:
            self._remove()
        return held

    def _remove(self) -> None:
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


_PURPOSE = "before anything is poured, so that whatever comes of a pour can be written down"
