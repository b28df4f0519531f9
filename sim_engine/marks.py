"""Marks on declared fields, for records that hold on to what decided a run.

`Annotated[Path, FREE]` on a field of a dataclass or a pydantic model says it where the field is declared; whoever makes
a fingerprint reads it there (`marks_of`).
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel


@dataclass(frozen=True)
class Mark:
    """What a field is to a run's fingerprint."""

    meaning: str


FREE = Mark("decides no request")
"""The field may change between two parts of a run: no request depends on it."""

BY_CONTENT = Mark("a file that matters by its content")
"""The field is the path of a file, which may move; what stands in the file matters."""


@functools.cache
def marks_of(cls: type[Any]) -> dict[str, Mark | None]:
    """The fields of a dataclass or a pydantic model, in order, each with its mark."""
    if issubclass(cls, BaseModel):
        found = {name: info.metadata for name, info in cls.model_fields.items()}
    else:
        hints = typing.get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls)]
        found = {name: list(getattr(hints[name], "__metadata__", ())) for name in names}
    return {name: next((m for m in metadata if isinstance(m, Mark)), None) for name, metadata in found.items()}
