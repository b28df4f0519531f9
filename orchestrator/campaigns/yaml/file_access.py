"""Access to files and folders named by the user: checks with clear reasons, and text up to a size limit."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path

from sim_engine.errors import did_you_mean

SIZE_LIMIT = 500_000
"""Largest file that is read [bytes]: a campaign has 2,000, a theta.json with its posterior 15,000."""


_roots: ContextVar[tuple[Path, ...] | None] = ContextVar("roots", default=None)


class UnreadableError(Exception):
    """A file can't be read; the message gives the reason without the file's name."""


@contextlib.contextmanager
def confined(roots: Sequence[Path]) -> Iterator[None]:
    """Restrict reading to these files and folders within this context, for campaigns from untrusted sources.

    Args:
        roots: absolute paths without links.
    """
    token = _roots.set(tuple(roots))
    try:
        yield
    finally:
        _roots.reset(token)


def out_of_bounds(path: Path) -> str | None:
    """Reason why a path may not be read; None if it may. The target of a link decides."""
    roots = _roots.get()
    if roots is None:
        return None
    target = resolved(path)
    if any(target == root or root in target.parents for root in roots):
        return None
    return "lies outside of the folders that this campaign may refer to"


def resolved(path: Path) -> Path:
    """The absolute path without links; for links that form a cycle, the first one is kept."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError):
        return path.absolute()


def why_unreadable(path: Path) -> str | None:
    """Reason why a path is not a readable file; None if it is."""
    if (outside := out_of_bounds(path)) is not None:
        return outside
    try:
        mode = path.stat().st_mode
    except OSError as error:
        match error.errno:
            case errno.ENOENT | errno.ENOTDIR:
                return "no such file"
            case errno.ELOOP:
                return "is a link that leads back to itself; let it point to a file"
            case _:
                return f"can't be read: {error.strerror}"
    except ValueError:
        return "no file can have such a name"
    if stat.S_ISDIR(mode):
        return "is a directory; name a file in it"
    if stat.S_ISFIFO(mode):
        return "is a pipe, which is not waited for; name a file"
    if not stat.S_ISREG(mode):
        return "is a device or a socket; name a file"
    return None


def missing_file(path: Path) -> str | None:
    """Message for a named file that can't be read; None if it can be read."""
    why = why_unreadable(path)
    if why is None:
        return None
    if why != "no such file":
        return f"{path} {why}"
    return f"no such file: {path}; {similar(path) or 'paths are relative to the directory of the file they stand in'}"


def similar(path: Path) -> str | None:
    """'did you mean …?' with a similar file of the same directory; None if there is none."""
    try:
        guess = did_you_mean(path.name, [p.name for p in path.parent.iterdir()])
    except OSError:
        return None
    return f"did you mean '{guess}'?" if guess else None


def why_not_writable(directory: Path) -> str | None:
    """Reason why a directory, which need not exist, can't be written; None if there is no known reason."""
    for path in (directory, *directory.parents):
        try:
            mode = path.stat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            return f"{directory} can't be written: {error.strerror}"
        except ValueError:
            return "no folder can have such a name"
        if not stat.S_ISDIR(mode):
            return f"{directory} can't be written: {path} is a file; name a folder"
        if not os.access(path, os.W_OK | os.X_OK):
            return f"{directory} can't be written: the permission is missing in {path}; name another folder"
        return None
    return None


def read_bytes(path: Path, *, limit: int = SIZE_LIMIT) -> bytes:
    """The content of a file.

    Args:
        path: the file.
        limit: maximum size [bytes].

    Raises:
        UnreadableError: it does not exist, is not a file, or is too large.
    """
    if (why := why_unreadable(path)) is not None:
        hint = similar(path) if why == "no such file" else None
        raise UnreadableError(f"{why}; {hint}" if hint else why)
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
            size = max(os.fstat(file.fileno()).st_size, len(content))
    except OSError as error:
        raise UnreadableError(f"can't be read: {error.strerror}") from error
    if size > limit:
        raise UnreadableError(
            f"is too large: {size / 1e6:.3g} MB, and {limit / 1e6:g} MB are read at most. Is it the right file?"
        )
    return content


def read_text(path: Path, *, limit: int = SIZE_LIMIT) -> str:
    """The text of a file in UTF-8.

    Raises:
        UnreadableError: as `read_bytes`, or it is not text in UTF-8.
    """
    try:
        return read_bytes(path, limit=limit).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnreadableError(f"is not text in UTF-8 (byte {error.start}); save it as UTF-8") from None
