"""Exact conversion of values to JSON and back: requests, outcomes and plans, and the results of stages.

`to_json` and `from_json` follow the type annotations of the values, so a new field needs no code here. Floats are
preserved bit for bit (shortest round-trip notation). Numbers that are not finite are written as {"$float": "nan"},
because JSON cannot represent them.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import types
from collections.abc import Hashable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ValidationError

from orchestrator.learning.requests import WRITTEN_IF_SET, Outcome, Request
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import StageResult

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


def first_difference(expected: Any, actual: Any, path: str = "") -> str | None:
    """The first place where two JSON-ready values differ, as text for a message; None if they are equal."""
    if isinstance(expected, dict) and isinstance(actual, dict):
        for key in sorted(set(expected) | set(actual)):
            place = f"{path}.{key}" if path else str(key)
            if key not in actual:
                return f"{place}: {_short(expected[key])} became nothing"
            if key not in expected:
                return f"{place}: nothing became {_short(actual[key])}"
            if found := first_difference(expected[key], actual[key], place):
                return found
        return None
    if isinstance(expected, list) and isinstance(actual, list) and len(expected) == len(actual):
        for index, (left, right) in enumerate(zip(expected, actual, strict=True)):
            if found := first_difference(left, right, f"{path}[{index}]"):
                return found
        return None
    if canonical(expected) == canonical(actual):
        return None
    return f"{path or 'value'}: {_short(expected)} became {_short(actual)}"


def to_json(value: Any, hint: Any = Any) -> Any:
    """A JSON-ready copy of a value of the annotated type.

    Raises:
        CodecError: the value does not have that type, or contains something that JSON can't represent.
    """
    if hint is Any or hint is object:
        return _plain(value)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _union_to_json(value, get_args(hint))
    if origin is Literal:
        return value
    if origin is tuple:
        return [to_json(v, h) for v, h in zip(value, _element_hints(hint, len(value)), strict=True)]
    if origin in (list, dict):
        arguments = get_args(hint)
        if origin is list:
            return [to_json(v, arguments[0]) for v in value]
        return {_key(k): to_json(v, arguments[1]) for k, v in value.items()}
    if not isinstance(hint, type):
        raise CodecError(f"no rule to write a value annotated {hint!r}")
    if hint is float:
        return _float_to_json(float(value))
    if hint in (int, bool, str):
        return hint(value)
    if not isinstance(value, hint):
        raise CodecError(f"expected {hint.__name__}, got {type(value).__name__}")
    if issubclass(hint, Path | StrEnum):
        return str(value)
    if issubclass(hint, StageResult):
        return encode_result(cast(StageResult, value))
    if issubclass(hint, BaseModel):
        return cast(BaseModel, value).model_dump(mode="json")
    if dataclasses.is_dataclass(hint):
        values = {name: (getattr(value, name), h) for name, h in written_fields(hint).items()}
        absent = {name for name in _written_if_set(hint) if values[name][0] is None}
        return {name: to_json(one, h) for name, (one, h) in values.items() if name not in absent}
    if dataclasses.is_dataclass(value):  # only a base class is annotated
        return {_TYPE: type(value).__name__, **to_json(value, type(value))}
    raise CodecError(f"no rule to write a {hint.__name__}")


def from_json(data: Any, hint: Any = Any) -> Any:
    """Inverse of `to_json` for the same annotation.

    Raises:
        CodecError: the data don't fit the type; the text names the place.
    """
    if hint is Any or hint is object:
        return _unplain(data)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _union_from_json(data, get_args(hint))
    if origin is Literal:
        if data not in get_args(hint):
            raise CodecError(f"expected one of {', '.join(map(repr, get_args(hint)))}, got {data!r}")
        return data
    if origin is tuple:
        _expect(data, list)
        if get_args(hint) == (float, Ellipsis) and all(type(v) is float for v in data):  # most of what a journal has
            return tuple(data)
        return tuple(from_json(v, h) for v, h in zip(data, _element_hints(hint, len(data)), strict=True))
    if origin is list:
        _expect(data, list)
        return [from_json(v, get_args(hint)[0]) for v in data]
    if origin is dict:
        _expect(data, dict)
        return {k: from_json(v, get_args(hint)[1]) for k, v in data.items()}
    if hint is float:
        return _float_from_json(data)
    if hint in (int, bool, str):
        _expect(data, hint)
        return data
    if isinstance(hint, type) and issubclass(hint, Path):
        return hint(data)
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        _expect(data, str)
        return hint(data)
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return hint.model_validate(data)
    if dataclasses.is_dataclass(hint):
        return _dataclass_from_json(data, cast("type[Any]", hint))
    raise CodecError(f"no rule to read a value annotated {hint!r}")


def _dataclass_from_json(data: Any, hint: type[Any]) -> Any:
    _expect(data, dict)
    hints = written_fields(cast(Hashable, hint))
    if unknown := set(data) - set(hints) - {_TYPE}:
        raise CodecError(
            f"{hint.__name__} has no field {', '.join(sorted(unknown))}; was it written by a newer version?"
        )
    defaults = {field.name for field in dataclasses.fields(hint) if field.default is not dataclasses.MISSING}
    if missing := hints.keys() - data.keys() - defaults:  # a field of a later version has its default
        raise CodecError(f"{hint.__name__} lacks {', '.join(sorted(missing))}; was it written by an older version?")
    values = {}
    for name in (name for name in hints if name in data):
        try:
            values[name] = from_json(data[name], hints[name])
        except (CodecError, ValueError, TypeError) as error:
            raise CodecError(f"{hint.__name__}.{name}: {error}") from error
    try:
        return hint(**values)
    except TypeError as error:
        raise CodecError(f"{hint.__name__}: {error}") from error


def _union_to_json(value: Any, arguments: tuple[Any, ...]) -> Any:
    if value is None and type(None) in arguments:
        return None
    members = [a for a in arguments if a is not type(None)]
    if len(members) == 1:
        return to_json(value, members[0])
    for member in members:
        if isinstance(member, type) and type(value) is member:
            written = to_json(value, member)
            return {_TYPE: member.__name__, **written} if dataclasses.is_dataclass(member) else written
    raise CodecError(f"expected one of {', '.join(_name(m) for m in members)}, got {type(value).__name__}")


def _union_from_json(data: Any, arguments: tuple[Any, ...]) -> Any:
    if data is None and type(None) in arguments:
        return None
    members = [a for a in arguments if a is not type(None)]
    if len(members) == 1:
        return from_json(data, members[0])
    if isinstance(data, Mapping) and _TYPE in data:
        for member in members:
            if dataclasses.is_dataclass(member) and _name(member) == data[_TYPE]:
                return from_json(data, member)
        raise CodecError(f"expected one of {', '.join(_name(m) for m in members)}, got {data[_TYPE]!r}")
    for member in members:
        if isinstance(member, type) and type(data) is member:
            return from_json(data, member)
    raise CodecError(f"expected one of {', '.join(_name(m) for m in members)}, got {_short(data)}")


@functools.cache
def written_fields(cls: Any) -> dict[str, Any]:
    """The fields of a dataclass that are written, with their types."""
    hints = get_type_hints(cls)
    fields = (field for field in dataclasses.fields(cls) if field.init)
    return {field.name: hints[field.name] for field in fields if field.metadata.get("written") is not False}


@functools.cache
def _written_if_set(cls: Any) -> frozenset[str]:
    return frozenset(field.name for field in dataclasses.fields(cls) if field.metadata == WRITTEN_IF_SET)


def _element_hints(hint: Any, count: int) -> tuple[Any, ...]:
    arguments = get_args(hint)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return (arguments[0],) * count
    if len(arguments) != count:
        raise CodecError(f"expected {len(arguments)} elements, got {count}")
    return arguments


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


def _expect(data: Any, kind: type[Any]) -> None:
    if not isinstance(data, kind) or (kind is int and isinstance(data, bool)):
        raise CodecError(f"expected {kind.__name__}, got {_short(data)}")


def _name(hint: Any) -> str:
    return getattr(hint, "__name__", str(hint))


def _short(value: Any, limit: int = 80) -> str:
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
    known = StageResult.KINDS.get(str(kind))
    if known is None:
        raise RunError(
            f"a result of the kind '{kind}' is not known; is the package installed whose strategy learnt it? "
            f"Known are: {', '.join(sorted(StageResult.KINDS))}"
        )
    try:
        return known.model_validate(from_json(data))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise RunError(f"a result of the kind '{kind}' can't be read: {place}: {first['msg']}") from None


def result_of(results: Results, stage: str, kind: type[L]) -> L:
    """The result of a stage.

    Raises:
        RunError: there is no such stage, or its result is of another kind.
    """
    found = results.get(stage)
    if not isinstance(found, kind):
        what = "nothing" if found is None else f"a result of the kind '{found.kind}'"
        raise RunError(f"stage {stage} should have learnt a {kind.__name__}, but there is {what}")
    return found
