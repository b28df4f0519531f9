"""Tags and notes of a run, stored in a file in the run's folder, so that they move with the run."""

from __future__ import annotations

import fcntl
import getpass
import json
import time
from collections.abc import Sequence
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


class Annotations(BaseModel):
    """All tags and notes of a run; notes in the order in which they were written."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tags: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()


class AnnotationsError(RunError):
    """The annotations of a run can't be read or written; the text gives the reason and the remedy."""


def read_annotations(run: Path) -> Annotations:
    """The annotations of a run; empty if there are none.

    Raises:
        AnnotationsError: the file is not a file of annotations.
    """
    path = run / ANNOTATIONS_NAME
    try:
        return Annotations.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return Annotations()
    except (OSError, ValidationError) as error:
        raise AnnotationsError(f"{path}: can't be read ({str(error).splitlines()[0]}); correct or remove it") from None


def annotate(
    run: Path, *, add: Sequence[str] = (), remove: Sequence[str] = (), note: str | None = None, by: str | None = None
) -> Annotations:
    """Add tags to a run, remove others, and add a note.

    The file is replaced atomically; concurrent changes wait for each other.

    Args:
        note: text of the note.
        by: its author; the user of this process unless given.

    Raises:
        AnnotationsError: as `read_annotations`, or the file can't be written.
    """
    path = run / ANNOTATIONS_NAME
    notes = [] if note is None else [Note(time=time.time(), by=_user() if by is None else by, text=note)]
    try:
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            before = read_annotations(run)
            tags = tuple(name for name in dict.fromkeys((*before.tags, *add)) if name not in remove)
            changed = Annotations(tags=tags, notes=(*before.notes, *notes))
            draft = path.with_suffix(".part")
            text = json.dumps(changed.model_dump(mode="json"), indent=2, ensure_ascii=False)
            draft.write_text(text + "\n", encoding="utf-8")
            draft.replace(path)
    except OSError as error:
        raise AnnotationsError(f"{path}: can't be written: {error.strerror}") from None
    return changed


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return ""
