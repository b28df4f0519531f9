"""What the sections of all files have in common: strict keys, required keys, values that may stand in another file.

Marks on declared fields, for records that hold on to what decided a run.

`Annotated[Path, FREE]` on a field of a dataclass or a pydantic model says it where the field is declared; whoever makes
a fingerprint reads it there (`marks_of`).
"""

from __future__ import annotations

import dataclasses
import functools
import operator
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
    Tag,
)
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, PydanticKnownError, core_schema


@dataclass(frozen=True)
class FieldMark:
    """What a field is to a run's fingerprint."""

    meaning: str


FREE = FieldMark("decides no request")
"""The field may change between two parts of a run: no request depends on it."""

BY_CONTENT = FieldMark("a file that matters by its content")
"""The field is the path of a file, which may move; what stands in the file matters."""


@functools.cache
def marks_of(cls: type[Any]) -> dict[str, FieldMark | None]:
    """The fields of a dataclass or a pydantic model, in order, each with its mark."""
    if issubclass(cls, BaseModel):
        found = {name: info.metadata for name, info in cls.model_fields.items()}
    else:
        hints = typing.get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls)]
        found = {name: list(getattr(hints[name], "__metadata__", ())) for name in names}
    return {name: next((m for m in metadata if isinstance(m, FieldMark)), None) for name, metadata in found.items()}


Count = Annotated[int, Strict(), Field(ge=0)]
"""A whole number, 0 or more."""

PositiveCount = Annotated[int, Strict(), Field(ge=1)]
"""A whole number, 1 or more."""


@dataclass(frozen=True)
class AtMost:
    """Pydantic annotation: an upper bound of a whole number, with the reason for it.

    Attributes:
        le: largest value that is allowed.
        reason: completes 'at most 2,000: …'.
    """

    le: int
    reason: str

    def _validate(self, value: int) -> int:
        if value > self.le:
            text = f"{value} is too large; at most {self.le:,}: {self.reason}"
            raise PydanticCustomError("at_most", "{text}", {"text": text})
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._validate, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {**handler(schema), "maximum": self.le}


MOST_POURS = 2_000
MOST_SIMULATIONS = 200_000

_FEW_POURS = AtMost(MOST_POURS, "the surrogates are made for some hundreds of pours")
_FEW_SIMULATIONS = AtMost(MOST_SIMULATIONS, "at ten simulations a second these take six hours")

PourCount = Annotated[Count, _FEW_POURS]
"""Real pours, 0 or more."""

PositivePourCount = Annotated[PositiveCount, _FEW_POURS]
"""Real pours, 1 or more."""

SimulationCount = Annotated[Count, _FEW_SIMULATIONS]
"""Simulations, iterations or parameters that are tried, 0 or more."""

PositiveSimulationCount = Annotated[PositiveCount, _FEW_SIMULATIONS]
"""Simulations, iterations or parameters that are tried, 1 or more."""


LARGEST_SEED = 2**63 - 1
"""The largest integer that SQLite, NumPy and JSON readers with 64-bit integers can hold."""

Seed = Annotated[int, Strict(), Field(ge=0, le=LARGEST_SEED)]
"""The seed of random choices."""


def _count_form(value: Any) -> str | None:
    if value == "free":
        return "word"
    return "number" if isinstance(value, int | float) else None


CountOrFree = Annotated[
    Annotated[SimulationCount, Tag("number")] | Annotated[Literal["free"], Tag("word")],
    Discriminator(
        _count_form, custom_error_type="count_or_free", custom_error_message="should be a whole number, or 'free'"
    ),
]
"""A whole number, 0 or more, or 'free'."""

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
"""A plain number without a unit."""

Switch = Annotated[bool, Strict()]
"""true or false."""

Name = Annotated[str, Strict(), Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=60)]
"""A name that is also good as a part of a file's name."""

Text = Annotated[str, Strict(), Field(min_length=1)]


@dataclass(frozen=True)
class Choice:
    """One of some words that are known once a file is read, such as the names of what is installed.

    Attributes:
        words: gives them.
    """

    words: Callable[[], Sequence[str]]

    def _validate(self, value: Any) -> str:
        words = self.words()
        if value not in words:
            expected = " or ".join([", ".join(map(repr, words[:-1])), repr(words[-1])])
            raise PydanticKnownError("literal_error", {"expected": expected})
        return str(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"enum": list(self.words()), "type": "string"}


IN_FILE = FieldMark("a path, relative to the file that it is written in")


def in_home(text: str) -> str:
    """A path with the home directory for a leading `~`, as a shell writes it; other paths as they are.

    Raises:
        ValueError: `~name` and there is no such user, or `~` and this user has no home directory.
    """
    if not text.startswith("~"):
        return text
    try:
        return str(Path(text).expanduser())
    except RuntimeError:
        user = text.partition("/")[0]
        raise ValueError(
            f"'{user}' is not the home directory of any user; write the whole path, or './{text}' for a name with a ~"
        ) from None


def _in_home(text: str) -> str:
    try:
        return in_home(text)
    except ValueError as error:
        raise PydanticCustomError("home", "{text}", {"text": str(error)}) from None


FilePath = Annotated[Text, AfterValidator(_in_home), IN_FILE]
"""The path of a file or folder, relative to the file that names it; `~` is the home directory."""


class Problems(Protocol):
    """Takes what is wrong with settings, and knows where in the file they stand."""

    def add(self, text: str, *at: str | int, key: bool = False, of: str = "") -> None:
        """Note a problem, unless something is wrong there already.

        Args:
            text: what is wrong, and what would be right.
            at: keys from the section down to the place; none: the section itself.
            key: point at the key and not at its value.
            of: a key that it is about: nothing is noted if something is wrong with it, or below it.
        """

    @property
    def any(self) -> bool:
        """Whether something is wrong with these settings."""


class Section(BaseModel):
    """A mapping in a file.

    Every field is optional to pydantic, and the keys that must be there are named in `required`: so that a section
    with one bad value still takes part in the checks of the others, and all errors of a file come at once.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=False, use_attribute_docstrings=True, defer_build=True
    )

    required: ClassVar[dict[str, str]] = {}
    """Keys that must be given, each with an example."""

    retired: ClassVar[dict[str, str]] = {}
    """Keys, and values as 'key: value', of earlier versions, each with what to write instead."""

    recorded_as_given: ClassVar[bool] = False
    """Whether a run's record leaves out what was left out, because some keys may not stand beside others."""

    tag: ClassVar[str] = ""
    """Key that tells the variants of a tagged union apart; empty for a section without variants."""

    variant: ClassVar[str] = ""
    """What a section is a variant of that stands under a key of its own; so that keys of its siblings are known."""

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """Why no variant has this tag, if more can be said than which there are."""
        return ""

    @classmethod
    def written_keys(cls) -> dict[str, str]:
        """Keys as written in files, mapped to field names."""
        return {field.alias or name: name for name, field in cls.model_fields.items()}

    def completed(self) -> Self:
        """With what is meant by keys that are left out, for a run's record."""
        return self

    def value(self, key: str) -> Any:
        """Value of a key as written in files; None where it was not given."""
        return getattr(self, self.written_keys()[key])


MADE: dict[str, Any] = {"use_attribute_docstrings": False}
"""For sections that are made from tables: no source is searched for their keys' meanings, which takes a second."""

S = TypeVar("S", bound=Section)


def _form(value: Any) -> str:
    return "path" if isinstance(value, str) else "inline"


def tagged(variants: Mapping[str, type[Section]], *, default: str = "") -> Any:
    """One of several sections, told apart by the key that they call their `tag`: `{strategy: D3, …}`.

    Args:
        variants: by the word that the key has; two or more.
        default: the variant that is meant where the key is missing; with none the key must be given.
    """
    if not variants:
        raise RuntimeError("Decant's own entry points are not registered; install it again (pip install -e .)")
    key = next(iter(variants.values())).tag

    def word(value: Any) -> str | None:
        found = value.get(key, default) if isinstance(value, Mapping) else getattr(value, key, None)
        return found if isinstance(found, str) else ""

    union = functools.reduce(operator.or_, (Annotated[model, Tag(name)] for name, model in variants.items()))
    return Annotated[union, Discriminator(word)]


PathOr = Annotated[
    Annotated[Text, AfterValidator(_in_home), Tag("path")] | Annotated[S, Tag("inline")], Discriminator(_form)
]
"""The path of a file that holds the section (relative to the file that names it), or the section itself."""


class SchemaGenerator(GenerateJsonSchema):
    """JSON schema of sections: required keys as declared there, and no null (an empty value is an error)."""

    def nullable_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema without null."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema with defaults that are plain values; those of whole sections say nothing."""
        form = super().default_schema(schema)
        if isinstance(form.get("default"), (dict, list, type(None))):
            form.pop("default", None)
        return form

    def field_title_should_be_set(self, schema: Any) -> bool:
        """No titles: they only repeat the keys."""
        return False

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema with the keys that the section requires."""
        form = super().model_schema(schema)
        required = getattr(schema["cls"], "required", {})
        if required:
            form["required"] = list(required)
        return form
