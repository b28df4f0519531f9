"""Exact conversion of values to JSON and back: requests, outcomes and plans, and the results of stages.

`to_json` and `from_json` follow the type annotations of the values, by cattrs, so a new field needs no code here.
Floats are preserved bit for bit (shortest round-trip notation). Numbers that are not finite are written as
{"$float": "nan"}, because JSON cannot represent them.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import types
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ValidationError

from actors.optimizer.questions import WRITTEN_IF_SET
from orchestrator.learning.requests import Outcome, Request
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import StageResult, without_empty_extras

T = TypeVar("T")
_FLOAT = "$float"
_TYPE = "type"


class CodecError(RunError, ValueError):
    """A value that can't be encoded, or data that can't be decoded."""


def encode_request(request: Request) -> dict[str, Any]:
    """JSON-ready mapping of a request, tagged with its type."""
    return cast("dict[str, Any]", to_json(request, Request))


def decode_request(data: Mapping[str, Any]) -> Request:
    """Inverse of `encode_request`. Raises CodecError."""
    return cast(Request, from_json(data, Request))


def encode_outcome(outcome: Outcome) -> dict[str, Any]:
    """JSON-ready mapping of an outcome, tagged with its type."""
    return cast("dict[str, Any]", to_json(outcome, Outcome))


def decode_outcome(data: Mapping[str, Any]) -> Outcome:
    """Inverse of `encode_outcome`. Raises CodecError."""
    return cast(Outcome, from_json(data, Outcome))


def canonical(data: Any) -> str:
    """The canonical text of a JSON-ready value: sorted keys, no blanks. Equal values have equal texts."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest(data: Any) -> str:
    """SHA-256 of the canonical text, in hexadecimal."""
    return hashlib.sha256(canonical(data).encode()).hexdigest()


NOTHING: Final = object()
"""Takes the place of a value that is missing."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """A place where two JSON-ready values differ.

    Attributes:
        path: keys and indices that lead to it.
        expected, actual: values there; `NOTHING` where the key is missing.
    """

    path: tuple[str | int, ...]
    expected: Any
    actual: Any

    def __str__(self) -> str:
        """'action.x_offset: 0.1 became 0.2'."""
        steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in self.path)
        place = "".join(steps).removeprefix(".") or "value"
        return f"{place}: {_short(self.expected)} became {_short(self.actual)}"


def first_difference(expected: Any, actual: Any, path: tuple[str | int, ...] = ()) -> Difference | None:
    """The first place where two JSON-ready values differ; None if they are equal. A key with null is as a missing key:
    versions differ in the fields that they write.
    """
    if isinstance(expected, dict) and isinstance(actual, dict):
        present = (key for key in sorted(expected | actual) if (expected.get(key), actual.get(key)) != (None, None))
        inner = [(key, expected.get(key, NOTHING), actual.get(key, NOTHING)) for key in present]
    elif isinstance(expected, list) and isinstance(actual, list) and len(expected) == len(actual):
        inner = [(index, *pair) for index, pair in enumerate(zip(expected, actual, strict=True))]
    elif NOTHING not in (expected, actual) and canonical(expected) == canonical(actual):
        return None
    else:
        return Difference(path, expected, actual)
    differences = (first_difference(before, after, (*path, step)) for step, before, after in inner)
    return next(filter(None, differences), None)


def to_json(value: Any, hint: Any = Any) -> Any:
    """A JSON-ready copy of a value of the annotated type.

    Raises:
        CodecError: the value does not have that type, or contains something that JSON can't represent.
    """
    return _converter().unstructure(value, unstructure_as=hint)


def from_json(data: Any, hint: Any = Any) -> Any:
    """Inverse of `to_json` for the same annotation.

    Raises:
        CodecError: the data don't fit the type; the text names the place.
    """
    try:
        return _converter().structure(data, hint)
    except (ValueError, TypeError, ExceptionGroup) as error:
        raise CodecError(_message(error)) from error


@functools.cache
def _converter() -> Any:
    """The converter with our rules: tagged unions, strict values, and numbers that JSON lacks."""
    from cattrs import Converter
    from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn, override

    def no_rule_to_write(hint: Any) -> Any:
        def write(value: Any) -> dict[str, Any]:
            if isinstance(value, hint) and dataclasses.is_dataclass(value):  # only a base class is annotated
                return {_TYPE: type(value).__name__, **c.unstructure(value)}
            raise CodecError(f"no rule to write a {type(value).__name__} as {_name(hint)}")

        return write

    def no_rule_to_read(hint: Any) -> Any:
        raise CodecError(f"no rule to read a value annotated {hint!r}")

    def is_literal(hint: Any) -> bool:
        return get_origin(hint) is Literal

    c = Converter(
        forbid_extra_keys=True,
        unstruct_collection_overrides={tuple: list},
        unstructure_fallback_factory=no_rule_to_write,
        structure_fallback_factory=no_rule_to_read,
    )
    c.register_unstructure_hook(float, lambda value: _float_to_json(float(value)))
    c.register_structure_hook(float, lambda data, _: _float_from_json(data))
    for kind in (int, bool, str):
        c.register_unstructure_hook(kind, kind)
        c.register_structure_hook(kind, _expect)
    c.register_unstructure_hook_func(lambda hint: hint is Any or hint is object, _plain)
    c.register_structure_hook_func(lambda hint: hint is Any or hint is object, lambda data, _: _unplain(data))
    c.register_unstructure_hook_func(is_literal, lambda value: value)
    c.register_structure_hook_func(is_literal, _one_of)
    c.register_unstructure_hook(Path, str)
    c.register_structure_hook(Path, lambda data, hint: hint(data))
    c.register_unstructure_hook(StrEnum, str)
    c.register_structure_hook(StrEnum, lambda data, hint: hint(_expect(data, str)))
    c.register_unstructure_hook(BaseModel, lambda value: value.model_dump(mode="json"))
    c.register_structure_hook(BaseModel, lambda data, hint: hint.model_validate(data))
    c.register_unstructure_hook(StageResult, encode_result)

    def choices(cls: Any) -> dict[str, Any]:
        written, if_set = written_fields(cls), _written_if_set(cls)
        return {
            field.name: override(omit=field.name not in written, omit_if_default=field.name in if_set)
            for field in dataclasses.fields(cls)
        }

    @c.register_unstructure_hook_factory(dataclasses.is_dataclass)
    def write_dataclass(cls: Any) -> Any:
        fields = make_dict_unstructure_fn(cls, c, **choices(cls))

        def write(value: Any) -> dict[str, Any]:
            if not isinstance(value, cls):
                raise CodecError(f"expected {cls.__name__}, got {type(value).__name__}")
            return fields(value)

        return write

    @c.register_structure_hook_factory(dataclasses.is_dataclass)
    def read_dataclass(cls: Any) -> Any:
        fields, names = (
            make_dict_structure_fn(cls, c, **choices(cls)),
            {field.name for field in dataclasses.fields(cls)},
        )

        def read(data: Any, _: Any) -> Any:
            written = {key: value for key, value in _expect(data, dict).items() if key != _TYPE}
            return fields(without_empty_extras(written, names), cls)

        return read

    def is_union(hint: Any) -> bool:
        return get_origin(hint) in (Union, types.UnionType) and len(set(get_args(hint)) - {types.NoneType}) > 1

    @c.register_unstructure_hook_factory(is_union)
    def write_union(hint: Any) -> Any:
        members = {member: c.get_unstructure_hook(member) for member in get_args(hint)}

        def write(value: Any) -> Any:
            cls = type(value)
            if cls not in members:
                raise CodecError(f"expected one of {_names(hint)}, got {cls.__name__}")
            written = members[cls](value)
            return {_TYPE: cls.__name__, **written} if dataclasses.is_dataclass(cls) else written

        return write

    @c.register_structure_hook_factory(is_union)
    def read_union(hint: Any) -> Any:
        tagged: dict[Any, Any] = {_name(member): member for member in get_args(hint)}

        def read(data: Any, _: Any) -> Any:
            member = tagged.get(data[_TYPE]) if isinstance(data, Mapping) and _TYPE in data else type(data)
            if member not in get_args(hint):
                shown = repr(data[_TYPE]) if isinstance(data, Mapping) and _TYPE in data else _short(data)
                raise CodecError(f"expected one of {_names(hint)}, got {shown}")
            return None if data is None else c.structure(data, cast("type[Any]", member))

        return read

    return c


def _message(error: BaseException) -> str:
    """The first of the errors of a conversion, with its place."""
    from cattrs.errors import AttributeValidationNote, ClassValidationError, ForbiddenExtraKeysError

    if not isinstance(error, ExceptionGroup):
        return str(error)
    if not isinstance(error, ClassValidationError):
        return _message(error.exceptions[0])
    name = error.cl.__name__
    if unknown := [key for e in error.exceptions if isinstance(e, ForbiddenExtraKeysError) for key in e.extra_fields]:
        return f"{name} has no field {', '.join(sorted(unknown))}; was it written by a newer version?"
    if missing := [e.args[0] for e in error.exceptions if isinstance(e, KeyError)]:  # a later field has a default
        return f"{name} lacks {', '.join(sorted(missing))}; was it written by an older version?"
    first = error.exceptions[0]
    places = [note.name for note in getattr(first, "__notes__", ()) if isinstance(note, AttributeValidationNote)]
    return f"{'.'.join([name, *places])}: {_message(first)}"


def _names(hint: Any) -> str:
    return ", ".join(_name(member) for member in get_args(hint) if member is not types.NoneType)


@functools.cache
def written_fields(cls: Any) -> dict[str, Any]:
    """The fields of a dataclass that are written, with their types."""
    hints = get_type_hints(cls)
    fields = (field for field in dataclasses.fields(cls) if field.init)
    return {field.name: hints[field.name] for field in fields if field.metadata.get("written") is not False}


@functools.cache
def _written_if_set(cls: Any) -> frozenset[str]:
    return frozenset(field.name for field in dataclasses.fields(cls) if field.metadata == WRITTEN_IF_SET)


def _plain(value: Any) -> Any:
    """A JSON-ready copy of any value, including tuples, numpy scalars and numpy arrays."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return _float_to_json(float(value))
    if isinstance(value, Mapping):
        return {_key(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy arrays and scalars, without importing numpy here
        return _plain(value.tolist())
    raise CodecError(f"a {type(value).__name__} can't be written as JSON: {_short(repr(value))}")


def _unplain(data: Any) -> Any:
    if isinstance(data, dict):
        return _float_from_json(data) if set(data) == {_FLOAT} else {k: _unplain(v) for k, v in data.items()}
    return [_unplain(v) for v in data] if isinstance(data, list) else data


def _float_to_json(value: float) -> Any:
    return value if math.isfinite(value) else {_FLOAT: str(value)}


def _float_from_json(data: Any) -> float:
    if isinstance(data, dict) and set(data) == {_FLOAT}:
        return float(data[_FLOAT])
    if isinstance(data, bool) or not isinstance(data, int | float):
        raise CodecError(f"expected a number, got {_short(data)}")
    return float(data)


def _key(key: Any) -> str:
    if not isinstance(key, str):
        raise CodecError(f"JSON keys are texts, got {key!r}")
    return key


def _expect(data: Any, kind: type[Any]) -> Any:
    if not isinstance(data, kind) or (kind is int and isinstance(data, bool)):
        raise CodecError(f"expected {kind.__name__}, got {_short(data)}")
    return data


def _one_of(data: Any, hint: Any) -> Any:
    if data not in get_args(hint):
        raise CodecError(f"expected one of {', '.join(map(repr, get_args(hint)))}, got {data!r}")
    return data


def _name(hint: Any) -> str:
    return getattr(hint, "__name__", str(hint))


def _short(value: Any, limit: int = 80) -> str:
    if value is NOTHING:
        return "nothing"
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= limit else text[: limit - 1] + "…"


L = TypeVar("L", bound=StageResult)

Results = Mapping[str, StageResult]
"""Results of the stages by name, in order."""


def encode_result(result: StageResult) -> dict[str, Any]:
    """JSON-ready mapping of a result; numbers that are not finite are encoded as in the journal."""
    return cast("dict[str, Any]", to_json(result.model_dump()))


def decode_result(data: Mapping[str, Any]) -> StageResult:
    """Inverse of `encode_result`.

    Raises:
        RunError: the kind is unknown, or the data don't fit it.
    """
    kind = data.get("kind")
    if kind not in StageResult.KINDS:
        from orchestrator.learning.strategy_registry import result_kinds

        result_kinds()  # the kind may belong to a package that is not loaded yet
    result_type = StageResult.KINDS.get(str(kind))
    if result_type is None:
        raise RunError(
            f"a result of the kind '{kind}' is not known; is the package installed whose strategy learnt it? "
            f"Known are: {', '.join(sorted(StageResult.KINDS))}"
        )
    try:
        return result_type.model_validate(from_json(data))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(key) for key in first["loc"])
        raise RunError(f"a result of the kind '{kind}' can't be read: {place}: {first['msg']}") from None


def result_of(results: Results, stage: str, kind: type[L]) -> L:
    """The result of a stage.

    Raises:
        RunError: there is no such stage, or its result is of another kind.
    """
    entry = results.get(stage)
    if not isinstance(entry, kind):
        present = "nothing" if entry is None else f"a result of the kind '{entry.kind}'"
        raise RunError(f"stage {stage} should have learnt a {kind.__name__}, but there is {present}")
    return entry
