"""Notes of a run, stored in a file in the run's folder, so that they move with the run."""

from __future__ import annotations

import fcntl
import getpass
import json
import time
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from orchestrator.learning.run_errors import RunError

ANNOTATIONS_NAME = "remarks.json"


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


class _Annotations(BaseModel):
    model_config = ConfigDict(extra="forbid")

    tags: tuple[str, ...] = ()
    """Of a file of an earlier version."""

    notes: tuple[Note, ...] = ()


class AnnotationsError(RunError):
    """The notes of a run can't be read or written; the text gives the reason and the remedy."""


def read_notes(run: Path) -> tuple[Note, ...]:
    """The notes of a run, the oldest first. Tags, which earlier versions have written, are a note of their words.

    Raises:
        AnnotationsError: the file is not a file of notes.
    """
    path = run / ANNOTATIONS_NAME
    try:
        content = _Annotations.model_validate_json(path.read_bytes())
        if not content.tags:
            return content.notes
        return (Note(time=path.stat().st_mtime, by="", text=f"tags: {', '.join(content.tags)}"), *content.notes)
    except FileNotFoundError:
        return ()
    except (OSError, ValidationError) as error:
        raise AnnotationsError(f"{path}: can't be read ({str(error).splitlines()[0]}); correct or remove it") from None


def add_note(run: Path, text: str, by: str | None = None) -> tuple[Note, ...]:
    """Add a note to a run; returns all of them.

    The file is replaced atomically; concurrent changes wait for each other.

    Args:
        text: of the note.
        by: its author; the user of this process unless given.

    Raises:
        AnnotationsError: as `read_notes`, or the file can't be written.
    """
    path = run / ANNOTATIONS_NAME
    try:
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            notes = (*read_notes(run), Note(time=time.time(), by=_user() if by is None else by, text=text))
            draft = path.with_suffix(".part")
            content = json.dumps({"notes": [note.model_dump() for note in notes]}, indent=2, ensure_ascii=False)
            draft.write_text(content + "\n", encoding="utf-8")
            draft.replace(path)
    except OSError as error:
        raise AnnotationsError(f"{path}: can't be written: {error.strerror}") from None
    return notes


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return ""
