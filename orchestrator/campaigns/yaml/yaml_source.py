"""YAML files as plain values with their places, and the collection of problems.

`Document` is a parsed file, `Place` a location in it, `Report` collects problems. `kind_of` recognises the kind of a
file by its keys, so that a file of another kind gives one error instead of one per key.

The parser's node graph is converted to plain data here instead of by its constructor, so that all duplicate keys and
tags are reported together with their places. The keys of a merge (`<<: *base`) keep the places where they are written.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLStreamError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from orchestrator.campaigns.yaml.file_access import UnreadableError, read_text
from orchestrator.campaigns.yaml.odd_characters import before_error, in_plain_text
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem, dotted
from sim_engine.vessel.shapes import VESSELS

Loc = tuple[str | int, ...]

NODE_LIMIT = 20_000
"""Maximum number of nodes after aliases are followed. A campaign has a few hundred; cyclic or exponential aliases
exceed it."""

DEPTH_LIMIT = 30
"""Maximum nesting of mappings and lists: a campaign has eight levels."""


_LINE_BREAK = re.compile(r"\r\n|\r|\n")
"""Line breaks that the parser counts."""


@dataclass(frozen=True)
class SourcePosition:
    """Position of a value, from 1: its key (or list item) and its value; `inline` if the value is on one line."""

    key: tuple[int, int]
    value: tuple[int, int]
    inline: bool


@lru_cache(maxsize=16)
def _known(text: str, path: Path) -> Document:
    """Cached, because many files name the same vessels and laboratories. A document is not changed after reading."""
    return Document.parse(text, path)


@dataclass
class Document:
    """One YAML file.

    Attributes:
        path: the file.
        lines: its text, to display source lines.
        data: plain dicts, lists, strings, numbers, booleans and None.
        marks: place of every value in `data`.
        problems: problems that do not prevent reading (duplicate keys, tags).
        _refused: problems after which nothing else is reported, as after a syntax error.
    """

    path: Path
    lines: list[str] = field(default_factory=list)
    data: Any = None
    marks: dict[Loc, SourcePosition] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    _nodes: int = 0
    _refused: list[Problem] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> Document:
        """Read a file.

        Raises:
            ConfigError: it can't be read, is not YAML, or is empty.
        """
        try:
            return _known(read_text(path), path)
        except UnreadableError as error:
            raise ConfigError([Problem(path, 0, 0, "", str(error))]) from None

    @classmethod
    def of(cls, data: dict[str, Any], path: Path) -> Document:
        """Values that a program has made, as if they were in this file; problems have their keys but no lines."""
        document = cls(path, data=data)
        waiting: list[tuple[Loc, Any]] = [((), data)]
        while waiting:
            loc, value = waiting.pop()
            document.marks[loc] = SourcePosition((0, 0), (0, 0), True)
            inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
            waiting += [((*loc, key), item) for key, item in inner]
        return document

    @classmethod
    def parse(cls, text: str, path: Path) -> Document:
        """Parse a text as the content of the file.

        Raises:
            ConfigError: it is not YAML, or is empty.
        """
        document = cls(path, _LINE_BREAK.split(text))
        try:
            root = _parser().compose(text)
        except MaxDepthExceededError as error:
            raise ConfigError([document._too_deep(_start_of(error.problem_mark))]) from None
        except _TooManyNodesError as error:
            raise ConfigError([document._too_many(_start_of(error.problem_mark), ())]) from None
        except MarkedYAMLError as error:
            raise ConfigError([document._syntax_problem(error)]) from None
        except ReaderError as error:
            # The parser counts characters of the text; messages need lines.
            before = text[: error.position]
            line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
            message = f"not YAML: an unprintable character (code {ord(text[error.position])}); is this a text file?"
            raise ConfigError([Problem(path, line, column, "", message)]) from None
        except (YAMLError, YAMLStreamError) as error:
            raise ConfigError([Problem(path, 0, 0, "", f"is not YAML: {error}")]) from None
        if root is None:
            raise ConfigError([Problem(path, 1, 1, "", "the file is empty", document.line(1))])
        document.marks[()] = SourcePosition((1, 1), _start(root), False)
        document.data = document._plain(root, ())
        if document._refused:
            raise ConfigError(dict.fromkeys(document._refused))
        return document

    def line(self, number: int) -> str:
        """Text of a line, from 1; empty beyond the end."""
        return self.lines[number - 1] if 1 <= number <= len(self.lines) else ""

    def get(self, loc: Loc) -> Any:
        """Plain data at a location."""
        node = self.data
        for key in loc:
            node = node[key]
        return node

    def known_loc(self, loc: Loc) -> Loc:
        """The location without the parts that the file does not have (union tags, filled-in keys)."""
        known: Loc = ()
        for key in loc:
            if (*known, key) in self.marks:
                known = (*known, key)
        return known

    def problem(self, loc: Loc, message: str, *, key: bool = False) -> Problem:
        """A problem at a location. It points at the value if that fits on a line, else (or with `key`) at the key."""
        mark = self.marks[self.known_loc(loc)]
        line, column = mark.value if mark.inline and not key else mark.key
        return Problem(self.path, line, column, dotted(loc), message, self.line(line))

    def _plain(self, node: Node, loc: Loc, active: frozenset[int] = frozenset()) -> Any:
        self._nodes += 1
        if len(loc) > DEPTH_LIMIT:  # through nested aliases
            raise ConfigError([self._too_deep(_start(node))])
        if self._nodes > NODE_LIMIT:
            raise ConfigError([self._too_many(_start(node), loc)])
        if id(node) in active:
            raise ConfigError([self._contains_itself(node, loc)])
        inside = active | {id(node)}
        match node:
            case MappingNode():
                return self._mapping(node, loc, inside)
            case SequenceNode():
                items = []
                for i, child in enumerate(node.value):
                    self.marks[(*loc, i)] = SourcePosition(_start(child), _start(child), True)
                    items.append(self._plain(child, (*loc, i), inside))
                return items
            case _:
                if isinstance(node, ScalarNode):
                    self._check_characters(node, loc)
                return self._scalar(node, loc)

    def _mapping(self, node: MappingNode, loc: Loc, active: frozenset[int]) -> dict[str, Any]:
        table: dict[str, Any] = {}
        for key_node, value_node in self._entries(node, loc, active):
            (line, column), key = _start(key_node), str(key_node.value)
            self._check_characters(key_node, loc, key=True)
            inner: Loc = (*loc, key)
            inline = isinstance(value_node, ScalarNode) or bool(value_node.flow_style)
            value_place = _start(value_node) if not _is_empty(value_node) else (line, column)
            self.marks[inner] = SourcePosition((line, column), value_place, inline)
            table[key] = self._plain(value_node, inner, active)
        return table

    def _entries(self, node: MappingNode, loc: Loc, active: frozenset[int]) -> Iterator[tuple[ScalarNode, Any]]:
        """Keys and values of a mapping: its own, then those that it merges and does not have itself.

        Source: https://yaml.org/type/merge.html; the first of several merged mappings has priority.
        """
        local: dict[str, ScalarNode] = {}
        merged: ScalarNode | None = None
        sources: list[Node] = []
        for key_node, value_node in node.value:
            line, column = _start(key_node)
            if not isinstance(key_node, ScalarNode):
                self._add(line, column, loc, "keys are plain words; composed keys are not supported")
            elif str(key_node.tag).endswith(":merge"):
                if merged is not None:
                    text = f"'<<' stands in line {_start(merged)[0]} already; write one list: '<<: [*first, *second]'"
                    self._refused.append(Problem(self.path, line, column, dotted(loc), text, self.line(line)))
                    continue
                merged = key_node
                sources = value_node.value if isinstance(value_node, SequenceNode) else [value_node]
            elif (key := str(key_node.value)) in local:
                text = f"duplicate key; it stands in line {_start(local[key])[0]} already, keep one of them"
                self._add(line, column, (*loc, key), text)
            else:
                local[key] = key_node
                yield key_node, value_node
        have = set(local)
        for source in sources:
            line, column = _start(source)
            if not isinstance(source, MappingNode):
                text = "'<<' needs a mapping or a list of mappings, for example '<<: *base'"
                self._refused.append(Problem(self.path, line, column, dotted(loc), text, self.line(line)))
                continue
            if id(source) in active:
                raise ConfigError([self._contains_itself(source, loc)])
            for key_node, value_node in self._entries(source, loc, active | {id(source)}):
                self._nodes += 1
                if self._nodes > NODE_LIMIT:
                    raise ConfigError([self._too_many((line, column), loc)])
                if str(key_node.value) not in have:
                    have.add(str(key_node.value))
                    yield key_node, value_node

    def _contains_itself(self, node: Node, loc: Loc) -> Problem:
        line, column = _start(node)
        return Problem(self.path, line, column, dotted(loc), "an anchor that contains itself", self.line(line))

    def _check_characters(self, node: ScalarNode, loc: Loc, *, key: bool = False) -> None:
        """Note a character in a text without quotes that looks like a space or a quote."""
        if node.style is not None or (odd := in_plain_text(str(node.value), key=key)) is None:
            return
        (line, column), (index, message) = _start(node), odd
        character, source = str(node.value)[index], self.line(line)
        at = source.find(character, column - 1)
        self._refused.append(Problem(self.path, line, at + 1 if at >= 0 else column, dotted(loc), message, source))

    def _scalar(self, node: Node, loc: Loc) -> Any:
        tag, text = str(node.tag), str(node.value)
        try:
            match tag.rsplit(":", 1)[-1]:
                case "null":
                    return None
                case "bool":
                    return text.lower() in ("true", "yes", "on")
                case "int":
                    return int(text, 0) if text.lstrip("+-")[:2].lower() in ("0x", "0o") else int(text)
                case "float":
                    return float(text.replace("_", "").replace(".inf", "inf").replace(".nan", "nan"))
                case "str" | "timestamp":
                    return text
        except ValueError:
            pass  # e.g. 0123: a number for the resolver, but not a valid one; the text is kept
        if tag.startswith("tag:yaml.org,2002:") and tag.rsplit(":", 1)[-1] in ("int", "float"):
            return text
        line, column = _start(node)
        self._add(line, column, loc, f"tag {tag!r} is not supported; write a plain value")
        return text

    def _add(self, line: int, column: int, loc: Loc, message: str) -> None:
        self.problems.append(Problem(self.path, line, column, dotted(loc), message, self.line(line)))

    def _too_deep(self, start: tuple[int, int]) -> Problem:
        message = f"is nested more than {DEPTH_LIMIT} deep; is a bracket not closed, or is this another kind of file?"
        return Problem(self.path, *start, "", message, self.line(start[0]))

    def _too_many(self, start: tuple[int, int], loc: Loc) -> Problem:
        message = f"more than {NODE_LIMIT} values; a campaign has some hundreds. Is this the right file?"
        return Problem(self.path, *start, dotted(loc), message, self.line(start[0]))

    def _syntax_problem(self, error: MarkedYAMLError) -> Problem:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark is not None else (1, 1)
        if (odd := before_error(self.lines, line)) is not None:
            return Problem(self.path, odd[0], odd[1], "", f"not YAML: {odd[2]}", self.line(odd[0]))
        problem = (error.problem or "unreadable").replace("<", "").replace(">", "")
        source = self.line(line)
        if "another document" in problem:
            hint = "a file holds one document; remove the '---' line"
        elif "'\\t'" in problem or source[: len(source) - len(source.lstrip())].count("\t"):
            problem, hint = "a tab", "YAML is indented with spaces"
        elif "mapping values are not allowed" in problem:
            hint = (
                "is the line indented further than the one above, or is there a second ':' in it (then quote the text)?"
            )
        elif "end of stream" in problem or "expected ',' or" in problem:
            hint = "is a bracket, brace or quote still open?"
        elif "block end" in problem:
            hint = "is the line indented like its neighbours?"
        elif "cannot start any token" in problem:
            hint = "put text that begins with such a character in quotes"
        else:
            hint = (error.context or "check brackets, quotes and indentation").strip()
        return Problem(self.path, line, column, "", f"not YAML: {problem}; {hint}", source)


@dataclass(frozen=True)
class Place:
    """A location in a document; the same for referenced files and inline mappings."""

    document: Document
    loc: Loc = ()

    def at(self, *parts: str | int) -> Place:
        """A place further down."""
        return Place(self.document, (*self.loc, *parts))

    @property
    def directory(self) -> Path:
        """Directory that relative paths in this document start from."""
        return self.document.path.parent


@dataclass
class Report:
    """Collects the problems of a campaign file and of all files that it refers to."""

    problems: list[Problem] = field(default_factory=list)
    broken: set[tuple[Path, Loc]] = field(default_factory=set)

    def add(self, place: Place, message: str, *, key: bool = False) -> None:
        """Add a problem; its place then counts as invalid."""
        self.problems.append(place.document.problem(place.loc, message, key=key))
        self.broken.add((place.document.path, place.document.known_loc(place.loc)))

    def is_broken(self, place: Place) -> bool:
        """Whether a problem was reported at exactly this place."""
        return (place.document.path, place.loc) in self.broken

    def is_broken_within(self, place: Place) -> bool:
        """Whether a problem was reported at this place or inside it."""
        size = len(place.loc)
        return any(path == place.document.path and loc[:size] == place.loc for path, loc in self.broken)

    def raise_if_any(self) -> None:
        """Raise all collected problems, sorted by file and line.

        Raises:
            ConfigError: there are problems.
        """
        if not self.problems:
            return
        order = {problem.path: i for i, problem in reversed(list(enumerate(self.problems)))}
        unique: dict[object, Problem] = {}
        for problem in self.problems:  # what an alias or a merge repeats is written once
            place = (problem.path, problem.line, problem.column, problem.message) if problem.line else problem
            if place not in unique or len(problem.where) < len(unique[place].where):
                unique[place] = problem
        raise ConfigError(sorted(unique.values(), key=lambda p: (order[p.path], p.line, p.column)))


class _TooManyNodesError(MarkedYAMLError):
    """Raised during parsing, before the whole file is read."""


class _Composer(Composer):
    nodes = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.nodes += 1
        if self.nodes > NODE_LIMIT:
            raise _TooManyNodesError(problem_mark=self.parser.peek_event().start_mark)
        return super().compose_node(parent, index)


def _parser() -> YAML:
    """A parser without comments: a round-trip parser needs a minute for a million comments."""
    parser = YAML(typ="safe", pure=True)
    parser.Composer = _Composer
    parser.max_depth = DEPTH_LIMIT
    parser.composer.warn_double_anchors = False
    return parser


def _start(node: Node) -> tuple[int, int]:
    return _start_of(node.start_mark)


def _start_of(mark: Any) -> tuple[int, int]:
    return mark.line + 1, mark.column + 1


def _is_empty(node: Node) -> bool:
    return isinstance(node, ScalarNode) and node.value == "" and node.style is None


TELLING = {
    "recording": {"recorded", "series", "fill_deviation"},
    "study": {"mismatch", "compared", "campaign"},
    "campaign": {"calibration", "deployment", "seed", "liquid", "pourer", "receiver", "laboratory"},
    "vessel": {"profile", "mesh", "inner", "wall", "up"},
    "daemon": {"state", "listen", "rigs", "roots", "recordings", "live", "notify", "keep_free", "events"},
    "laboratory": {"bench", "mode", "simulators", "arm", "cell"},
}
"""Top-level keys that identify one kind of file, including wrong keys with a clear meaning; checked in this order."""

NEEDED = {
    "recording": "a recorded pour has keys such as recorded, pourer, receiver, liquid",
    "study": "a study has keys such as campaign, mismatch, calibration, deployment",
    "campaign": "a campaign has keys such as laboratory, liquid, calibration, deployment",
    "vessel": "a vessel has a name and a profile or mesh",
    "daemon": "the settings of a daemon have keys such as state, listen, rigs",
    "laboratory": "a laboratory has keys such as mode, simulators, arm, bench",
}


def kind_of(data: Any) -> str | None:
    """'recording', 'study', 'campaign', 'vessel', 'daemon' or 'laboratory'; None if no key identifies it."""
    keys = set(data) if isinstance(data, dict) else set()
    return next((kind for kind in TELLING if keys & telling(kind)), None)


def telling(kind: str) -> set[str]:
    """Keys that identify a kind of file, including keys that packages add."""
    return TELLING[kind] | (set(VESSELS.names) if kind == "vessel" else set())


def wrong_kind(document: Document, wanted: str) -> Problem | None:
    """The problem of a file that is clearly of another kind than the wanted one; None otherwise."""
    kind = kind_of(document.data)
    keys = set(document.data) if isinstance(document.data, dict) else set()
    if kind is None or kind == wanted or keys & telling(wanted):
        return None
    return Problem(document.path, 0, 0, "", f"describes a {kind}, but a {wanted} is needed here ({NEEDED[wanted]})")
