"""Declaration of settings: a `Settings` class is both the mapping in a file and the value that the program uses.

- A field without default is a required key. `Annotated[float, Quantity(…)]` converts units; types such as `Count`,
  `Name` and `FilePath` validate single values; `tagged` and `Choice` make variants.
- `Settings.check_values` holds the rules between keys. `Problems` collects their errors with positions in the file.
- A file is validated with the context `FROM_FILE`: units are mandatory. Missing keys become None, so that all errors
  are found in one pass (`orchestrator.campaigns.yaml.section_validation`).
- `FieldMark`s state how a field enters files and a run's fingerprint: `Annotated[Path, NOT_IN_FINGERPRINT]` on a field
  of a dataclass or a pydantic model. `marks_of` returns them.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import operator
import sys
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
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, PydanticKnownError, core_schema

from sim_engine.settings.quantity import FROM_FILE, Quantity


@dataclass(frozen=True)
class FieldMark:
    """The role of a field in a run's fingerprint."""

    meaning: str


WRITTEN_IF_SET = {"written": "if set"}
"""Metadata of a field that journal and events leave out while it has its default."""

NOT_IN_FINGERPRINT = FieldMark("decides no request")
"""The field may change when a run is resumed: no request depends on it."""

SET_BY_PROGRAM = FieldMark("set by the program")
"""The field is no key of files; a program sets it from other settings. It is not part of the fingerprint."""

BY_CONTENT = FieldMark("a file that matters by its content")
"""The field is the path of a file, which may move; the file's content matters."""


@dataclass(frozen=True)
class Example:
    """Pydantic annotation: a valid value of a required key, for the message about a missing one.

    A field without this annotation has the example of its `Quantity`.
    """

    text: str


@functools.cache
def marks_of(cls: type[Any]) -> dict[str, FieldMark | None]:
    """The fields of a dataclass or a pydantic model, in order, each with its mark."""
    if issubclass(cls, BaseModel):
        marks = {name: info.metadata for name, info in cls.model_fields.items()}
    else:
        hints = typing.get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls)]
        marks = {name: list(getattr(hints[name], "__metadata__", ())) for name in names}
    return {name: next((m for m in metadata if isinstance(m, FieldMark)), None) for name, metadata in marks.items()}


Count = Annotated[int, Strict(), Field(ge=0)]
"""A whole number, 0 or more."""

PositiveCount = Annotated[int, Strict(), Field(ge=1)]
"""A whole number, 1 or more."""


@dataclass(frozen=True)
class AtMost:
    """Pydantic annotation: an upper bound of a whole number, with the reason for it.

    Attributes:
        le: largest allowed value.
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
"""Number of simulations, iterations or parameters to try, 0 or more."""

PositiveSimulationCount = Annotated[PositiveCount, _FEW_SIMULATIONS]
"""Number of simulations, iterations or parameters to try, 1 or more."""


LARGEST_SEED = 2**63 - 1
"""The largest integer that SQLite, NumPy and JSON readers with 64-bit integers can hold."""

Seed = Annotated[int, Strict(), Field(ge=0, le=LARGEST_SEED)]
"""The seed of random choices."""


def _number_or(word: str) -> Callable[[Any], str | None]:
    def form(value: Any) -> str | None:
        if value == word:
            return "word"
        return "number" if isinstance(value, int | float) else None

    return form


CountOrAuto = Annotated[
    Annotated[PositiveSimulationCount, Tag("number")] | Annotated[Literal["auto"], Tag("word")],
    Discriminator(
        _number_or("auto"),
        custom_error_type="count_or_auto",
        custom_error_message="should be a whole number, or 'auto'",
    ),
]
"""A whole number, 1 or more, or 'auto'."""

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
"""A plain number without a unit."""

Switch = Annotated[bool, Strict()]
"""true or false."""

Name = Annotated[str, Strict(), Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=60)]
"""A name that is also valid as a part of a file name."""

Text = Annotated[str, Strict(), Field(min_length=1)]


@dataclass(frozen=True)
class Choice:
    """One of a set of words that is known when a file is read, such as the names of installed plug-ins.

    Attributes:
        words: returns them.
        similar: whether an error may suggest a similar word. If not, it lists all words: 'ur6' is no misspelt 'ur5'.
    """

    words: Callable[[], Sequence[str]]
    similar: bool = True

    def _validate(self, value: Any) -> str:
        words = self.words()
        if value not in words:
            expected = " or ".join([", ".join(map(repr, words[:-1])), repr(words[-1])])
            if not self.similar:
                raise PydanticCustomError(
                    "not_supported",
                    "{value} is not supported; supported are {words}",
                    {"value": repr(value), "words": ", ".join(words)},
                )
            raise PydanticKnownError("literal_error", {"expected": expected})
        return str(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"enum": list(self.words()), "type": "string"}


IN_FILE = FieldMark("a path, relative to the file that it is written in")


def in_home(text: str) -> str:
    """Replace a leading `~` in a path by the home directory, as a shell does; other paths are unchanged.

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
    """Collects problems of settings, with their positions in the file."""

    def add(self, text: str, *at: str | int, key: bool = False, of: str = "", more: bool = False) -> None:
        """Add a problem, unless its position already has one.

        Args:
            text: the problem and its remedy.
            at: keys from the section down to the position; none: the section itself.
            key: point at the key and not at its value.
            of: a key on which the problem depends: nothing is added if that key, or one below it, already has a
                problem.
            more: add it even if its position already has a problem.
        """

    @property
    def any(self) -> bool:
        """Whether these settings have a problem."""

    def valid(self, *keys: str) -> bool:
        """Whether none of these keys, or keys below them, has a problem; a missing required key has one."""

    def within(self, *at: str | int) -> Problems:
        """The same collection for the settings at a position, given by keys from these settings down to it."""


class Settings(BaseModel):
    """A mapping in a file, and the frozen value that the program uses.

    A file's mapping is first a draft: required keys that are missing, and invalid ones, are None. Drafts take part in
    `check_values`, so that all errors of a file are reported at once. The program receives it only without problems.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=False, defer_build=True)

    required: ClassVar[dict[str, str]] = {}
    """Keys that are mandatory in files although their fields have defaults, each with an example."""

    recorded_as_given: ClassVar[bool] = False
    """Whether a run's record omits keys that were omitted, because some keys exclude others."""

    tag: ClassVar[str] = ""
    """Key that distinguishes the variants of a tagged union; empty for settings without variants."""

    default_tag: ClassVar[str] = ""
    """The variant that is meant if that key is missing; empty if the key is required."""

    plugins: ClassVar[str] = ""
    """Entry-point group of the variants, if installed packages may add some."""

    variant: ClassVar[str] = ""
    """For a variant under its own key: the name of the group of variants, so that keys of its siblings are known."""

    @classmethod
    def tag_word(cls) -> str:
        """The word that selects this variant."""
        return cls.variant or str(cls.model_fields[cls.tag].default)

    @classmethod
    def written_keys(cls) -> dict[str, str]:
        """Keys as written in files, mapped to field names."""
        marks = marks_of(cls)
        return {field.alias or name: name for name, field in cls.model_fields.items() if marks[name] != SET_BY_PROGRAM}

    @classmethod
    def required_keys(cls) -> dict[str, str]:
        """Keys that are mandatory in files, each with an example."""
        needed = dict(cls.required)
        if cls.tag in cls.model_fields and not cls.variant and (word := cls.tag_word()) != cls.default_tag:
            needed.setdefault(cls.tag, word)
        for key, name in cls.written_keys().items():
            if (field := cls.model_fields[name]).is_required():
                needed.setdefault(key, _example(field.metadata))
        return needed

    def check_values(self, problems: Problems) -> None:
        """Add a problem for each combination of values in a file that is invalid.

        Values that are invalid by themselves have been reported. The settings are a draft: ask `problems.valid` for a
        key before you use the value of a required key.
        """

    def completed(self) -> Self:
        """A copy with the implied values of omitted keys, for a run's record."""
        return self

    def value(self, key: str) -> Any:
        """Value of a key as written in files; None if it was not given."""
        return getattr(self, self.written_keys()[key])

    def with_values(self, **changes: Any) -> Self:
        """A copy with other values of some fields, which are not validated."""
        return self.model_copy(update=changes)

    @model_validator(mode="before")
    @classmethod
    def _as_draft(cls, data: Any, info: ValidationInfo) -> Any:
        """The data of a file with `MISSING` for required keys that it lacks."""
        if info.context is not FROM_FILE or not isinstance(data, Mapping):
            return data
        keys = {field.alias or name for name, field in cls.model_fields.items() if field.is_required()}
        return dict.fromkeys(keys - data.keys(), MISSING) | dict(data)

    @field_validator("*", mode="wrap")
    @classmethod
    def _in_file(cls, value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        """Let `MISSING` pass as None, and refuse keys that only a program sets."""
        if info.context is FROM_FILE:
            if value is MISSING:
                return None
            if marks_of(cls)[str(info.field_name)] == SET_BY_PROGRAM:
                raise PydanticKnownError("extra_forbidden")
        return handler(value)


MISSING = object()
"""Stands for the value of a missing required key while a draft is validated."""


def _example(metadata: Sequence[Any]) -> str:
    given = next((m.text for m in metadata if isinstance(m, Example)), None)
    return given or next((m.example for m in metadata if isinstance(m, Quantity)), "…")


S = TypeVar("S", bound=Settings)


def _form(value: Any) -> str:
    return "path" if isinstance(value, str) else "inline"


def tagged(variants: Mapping[str, type[Settings]]) -> Any:
    """One of several kinds of settings, distinguished by their `tag` key: `{strategy: D3, …}`.

    Args:
        variants: by the value of that key. If it is missing, their `default_tag` is meant.
    """
    if not variants:
        raise RuntimeError("Decant's own entry points are not registered; install it again (pip install -e .)")
    first = next(iter(variants.values()))
    if len(variants) == 1:
        return first
    key, default = first.tag, first.default_tag

    def word(value: Any) -> str | None:
        text = value.get(key, default) if isinstance(value, Mapping) else getattr(value, key, None)
        return text if isinstance(text, str) else ""

    union = functools.reduce(operator.or_, (Annotated[model, Tag(name)] for name, model in variants.items()))
    return Annotated[union, Discriminator(word)]


@dataclass(frozen=True)
class OneOf:
    """Pydantic annotation of a base class of settings: one of its kinds, as `tagged`.

    The kinds are read when the first value is validated, so that plug-ins can import what declares the field.

    Attributes:
        kinds: returns them by the value of their tag.
    """

    kinds: Callable[[], Mapping[str, type[Settings]]]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler.generate_schema(tagged(self.kinds()))


PathOr = Annotated[
    Annotated[Text, AfterValidator(_in_home), Tag("path")] | Annotated[S, Tag("inline")], Discriminator(_form)
]
"""The path of a file that holds the section (relative to the file that names it), or the section itself."""


@functools.cache
def meanings(model: type[BaseModel]) -> dict[str, str]:
    """The texts below the fields of a model at the top of a module, by field; '' for a field without one.

    Schemas and tables need them. Pydantic's `use_attribute_docstrings` would read and parse the source of every model
    whenever a program starts, which takes a quarter of its start.
    """
    texts: dict[str, str] = {}
    for each in reversed(model.__mro__):
        if issubclass(each, BaseModel) and each is not BaseModel:
            texts |= _texts(each)
    own = {name: field.description for name, field in model.model_fields.items() if field.description}
    return {name: inspect.cleandoc(own.get(name) or texts.get(name, "")) for name in model.model_fields}


def _texts(model: type) -> dict[str, str]:
    """The texts below the fields that a class itself declares; none if a program has made the class."""
    node = _classes(model.__module__).get(model.__qualname__)
    body = [] if node is None else node.body
    texts = {}
    for each, after in itertools.zip_longest(body, body[1:]):
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name):
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            value = after.value.value if is_text else ""  # type: ignore[union-attr]
            texts[each.target.id] = value if isinstance(value, str) else ""
    return texts


@functools.cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """The classes of a module's source; none if it has no source."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (KeyError, OSError, TypeError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


class DescribedSchema(GenerateJsonSchema):
    """JSON schema with the meanings of fields, and without titles, which only repeat the keys."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Always false."""
        return False

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema with the meaning of each field."""
        form = super().model_schema(schema)
        texts = meanings(schema["cls"])
        for name, field in schema["cls"].model_fields.items():
            form_field = form.get("properties", {}).get(field.alias or name)
            if texts[name] and form_field is not None:
                form_field["description"] = texts[name]
        return form


class SchemaGenerator(DescribedSchema):
    """JSON schema of sections: required keys as declared there, and no null (an empty value is an error)."""

    def nullable_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema without null."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema with plain default values; defaults that are whole sections are left out."""
        form = super().default_schema(schema)
        if isinstance(form.get("default"), (dict, list, type(None))):
            form.pop("default", None)
        return form

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema with the keys that the section requires."""
        form = super().model_schema(schema)
        model = schema["cls"]
        if issubclass(model, Settings) and (required := model.required_keys()):
            form["required"] = list(required)
        for name in [name for name, mark in marks_of(model).items() if mark == SET_BY_PROGRAM]:
            form["properties"].pop(name, None)
        return form
