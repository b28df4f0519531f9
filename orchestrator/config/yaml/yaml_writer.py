"""Converts validated sections back to file content that is complete, exact and independent of other files."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import Tag

from orchestrator.config.yaml.file_access import resolved
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.yaml_source import Place
from sim_engine.settings.model import IN_FILE, FieldMark, Settings
from sim_engine.settings.quantity import Quantity

T = TypeVar("T")


def as_file(section: Settings, place: Place, references: References, *, whole: bool = True) -> dict[str, Any]:
    """A section in the format of a file, JSON-ready: loading it gives an equal section.

    Defaults are written (unless the section is recorded as given), numbers keep all digits, paths are absolute, and
    sections from other files are included.

    Args:
        section: the section, without problems.
        place: place of the section.
        references: the references that read its other files.
        whole: whether defaults are included.
    """
    whole = whole and not section.recorded_as_given
    return _Writer(references, whole).section(section.completed() if whole else section, place)


@dataclass(frozen=True)
class _Writer:
    references: References
    whole: bool

    def section(self, section: Settings, place: Place) -> dict[str, Any]:
        table: dict[str, Any] = {}
        for key, name in section.written_keys().items():
            value, info = getattr(section, name), type(section).model_fields[name]
            if value is None or not (self.whole or name in section.model_fields_set):
                continue
            found = self._value(value, info.annotation, tuple(info.metadata), place.at(key))
            if found != {}:  # an empty mapping has no content and could conflict with other keys
                table[key] = found
        return table

    def _value(self, value: Any, annotation: Any, metadata: tuple[Any, ...], place: Place) -> Any:
        if isinstance(value, Settings):
            return as_file(value, place, self.references, whole=self.whole)
        if isinstance(value, str):
            return self._text(value, annotation, metadata, place)
        if isinstance(value, Mapping):
            return {key: self._value(item, Any, (), place.at(key)) for key, item in value.items()}
        if isinstance(value, list | tuple):
            hints = _items(annotation, len(value))
            return [self._value(value[i], hint, (), place.at(i)) for i, hint in enumerate(hints)]
        if isinstance(value, float) and (quantity := _find(Quantity, annotation, metadata)) is not None:
            if quantity.unit != "1":
                return f"{value!r} {quantity.unit}"
            return round(value) if quantity.whole else value
        return value

    def _text(self, value: str, annotation: Any, metadata: tuple[Any, ...], place: Place) -> Any:
        if _find(FieldMark, annotation, metadata) == IN_FILE:
            return str(resolved(place.directory / value))
        model = _behind_a_path(annotation)
        found = None if model is None else self.references.section(value, place, model)
        return value if found is None else as_file(*found, self.references, whole=self.whole)


def _parts(annotation: Any) -> list[tuple[Any, tuple[Any, ...]]]:
    """The alternatives of an annotation, each with its metadata: the members of unions, the content of Annotated."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        inner, *metadata = typing.get_args(annotation)
        return [(part, (*own, *metadata)) for part, own in _parts(inner)]
    if origin in (typing.Union, type(int | str)):
        return [found for part in typing.get_args(annotation) for found in _parts(part)]
    return [(annotation, ())]


def _behind_a_path(annotation: Any) -> type[Settings] | None:
    """The section that may be in its own file, referenced by a path."""
    for part, metadata in _parts(annotation):
        if any(isinstance(m, Tag) and m.tag == "inline" for m in metadata):
            return typing.cast("type[Settings]", part)
    return None


def _find(kind: type[T], annotation: Any, metadata: tuple[Any, ...]) -> T | None:
    """The first metadata of one kind in an annotation."""
    every = [*metadata, *(m for _, own in _parts(annotation) for m in own)]
    return next((m for m in every if isinstance(m, kind)), None)


def _items(annotation: Any, count: int) -> list[Any]:
    """Annotations of the items of a list or tuple."""
    for part, _ in _parts(annotation):
        if typing.get_origin(part) in (list, tuple):
            inner = [hint for hint in typing.get_args(part) if hint is not Ellipsis]
            return inner if len(inner) == count else inner[:1] * count
    return [Any] * count
