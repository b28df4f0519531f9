"""What a program consists of. Values without behaviour; `parser` makes them, `translator` reads them."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Literal:
    """A number, a string, a truth value."""

    value: int | float | str | bool


@dataclass(frozen=True, slots=True)
class Name:
    """A variable's value."""

    name: str
    line: int


@dataclass(frozen=True, slots=True)
class Items:
    """A list [...] or, with six entries behind a p, a pose."""

    items: tuple[Expression, ...]
    pose: bool


@dataclass(frozen=True, slots=True)
class Index:
    """One entry: x[i] or x[i, j]."""

    value: Expression
    at: tuple[Expression, ...]


@dataclass(frozen=True, slots=True)
class Call:
    """A call, or with `thread` the start of a thread."""

    name: str
    arguments: tuple[Expression, ...]
    named: tuple[tuple[str, Expression], ...]
    thread: bool
    line: int


@dataclass(frozen=True, slots=True)
class Operation:
    """An operator with one operand or two."""

    operator: str
    operands: tuple[Expression, ...]


Expression = Literal | Name | Items | Index | Call | Operation


@dataclass(frozen=True, slots=True)
class Assign:
    """x = …, x[i] = …; `scope` is '', 'global' or 'local'."""

    target: Name | Index
    value: Expression | None
    scope: str
    line: int


@dataclass(frozen=True, slots=True)
class Evaluate:
    """An expression for what it does."""

    value: Expression
    line: int


@dataclass(frozen=True, slots=True)
class Branch:
    """if, elif … else: conditions with what to do; the last condition is None for else."""

    cases: tuple[tuple[Expression | None, tuple[Statement, ...]], ...]
    line: int


@dataclass(frozen=True, slots=True)
class Loop:
    """while."""

    condition: Expression
    body: tuple[Statement, ...]
    line: int


@dataclass(frozen=True, slots=True)
class Simple:
    """break, continue, halt, pass, enter_critical, exit_critical; kill, join and return with a value."""

    word: str
    value: Expression | None
    line: int


@dataclass(frozen=True, slots=True)
class Function:
    """def, thread or sec."""

    kind: str
    name: str
    parameters: tuple[tuple[str, Expression | None], ...]
    body: tuple[Statement, ...]
    line: int
    functions: dict[str, Function] = field(default_factory=dict, compare=False)


Statement = Assign | Evaluate | Branch | Loop | Simple | Function
