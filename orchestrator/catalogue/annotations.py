"""Tags and notes of a run, stored in a file in the run's folder, so that they move with the run."""

from __future__ import annotations

import fcntl
import getpass
import json
import time
from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

REMARKS_NAME = "remarks.json"


class Note(BaseModel):
    """A note about a run.

    Attributes:
        time: seconds since 1970.
        by: its author.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    time: float
    by: str
    text: str


class Annotations(BaseModel):
    """All tags and notes of a run; notes in the order in which they were written."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tags: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()


class AnnotationsError(Exception):
    """The annotations of a run can't be read or written; the text gives the reason and the remedy."""


def read_remarks(run: Path) -> Annotations:
    """The annotations of a run; empty if there are none.

    Raises:
        AnnotationsError: the file is not a file of annotations.
    """
    path = run / REMARKS_NAME
    try:
        return Annotations.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return Annotations()
    except (OSError, ValidationError) as error:
        raise AnnotationsError(f"{path}: can't be read ({str(error).splitlines()[0]}); mend or remove it") from None


def tag(run: Path, add: tuple[str, ...] = (), remove: tuple[str, ...] = ()) -> Annotations:
    """Add tags to a run, and remove others.

    Raises:
        AnnotationsError: as `read_remarks`, or the file can't be written.
    """

    def changed(before: Annotations) -> Annotations:
        tags = dict.fromkeys((*before.tags, *add))
        return before.model_copy(update={"tags": tuple(name for name in tags if name not in remove)})

    return _change(run, changed)


def note(run: Path, text: str, by: str | None = None) -> Annotations:
    """Add a note to a run.

    Raises:
        AnnotationsError: as `tag`.
    """
    written = Note(time=time.time(), by=_me() if by is None else by, text=text)
    return _change(run, lambda before: before.model_copy(update={"notes": (*before.notes, written)}))


def _change(run: Path, change: Callable[[Annotations], Annotations]) -> Annotations:
    """Read the file, change it, and replace it atomically; concurrent changes wait for each other."""
    path = run / REMARKS_NAME
    try:
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            changed = change(read_remarks(run))
            draft = path.with_suffix(".part")
            text = json.dumps(changed.model_dump(mode="json"), indent=2, ensure_ascii=False)
            draft.write_text(text + "\n", encoding="utf-8")
            draft.replace(path)
    except OSError as error:
        raise AnnotationsError(f"{path}: can't be written: {error.strerror}") from None
    return changed


def _me() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return ""
