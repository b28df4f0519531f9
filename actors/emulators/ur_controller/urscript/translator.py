"""The translator of URScript: from a syntax tree to Python generators, which yield once per control cycle.

Every name gets a prefix, every constant is written by repr, and the code runs without Python's built-in functions. A
program can therefore use nothing but its commands. Only functions that may wait (directly or by a function that they
call) become generators; the others stay plain functions, because they are called hundreds of times per second.

Scopes follow the manual: a name declared `global` anywhere is global, except where it is declared `local` or a
parameter. Any other name is local to the function that assigns it. Lists and poses are values: they are copied when
they are passed on.

`translate` runs in this process. Long programs are translated in a process of their own, with limits on time and memory
(`main`, `read_answer`).
"""

from __future__ import annotations

import json
import marshal
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType
from typing import Any

from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.parser import (
    Assign,
    Branch,
    CallNode,
    Evaluate,
    Expression,
    Function,
    Index,
    Items,
    Literal,
    Loop,
    NameNode,
    Operation,
    Simple,
    Statement,
    parse,
)

_OPERATORS = {"and": "and", "or": "or", "<": "<", ">": ">", "<=": "<=", ">=": ">="}
_HELPERS = {"+": "_add", "-": "_sub", "*": "_mul", "/": "_div", "%": "_mod", "xor": "_xor", "==": "_same"}


_CHUNK = 20
"""Number of consecutive statements whose work is counted at once."""


class Translation:
    """The Python code of one program.

    Args:
        program: the syntax tree.
        commands: the commands that a program can call; True for those that wait.

    Attributes:
        source: Python, defining `main`.
        lines: for each line of the source, from 0, the program's.

    Raises:
        ScriptError: an unknown function, a wrong use of one, or a name that is not a function.
    """

    def __init__(self, program: Function, commands: Mapping[str, bool]) -> None:
        self._commands = commands
        self._functions = {f.name: f for f in _functions(program.body)}
        self._globals = _names(s for s in _assignments(program) if s.scope == "global")
        self._waiting = self._find_waiting()
        self._out: list[str] = []
        self.lines: list[int] = []
        self._line = program.line
        self._define(program, "main", 0, main=True)
        self.source = "\n".join(self._out) + "\n"

    # ---- functions that wait

    def _find_waiting(self) -> set[str]:
        callers: dict[str, set[str]] = {}
        for name, function in self._functions.items():
            for called in _calls(function.body):
                callers.setdefault(called, set()).add(name)
        waiting = {name for name, f in self._functions.items() if f.kind == "thread" or _pauses(f.body)}
        waiting |= {name for name, waits in self._commands.items() if waits and name not in self._functions}
        fresh = list(waiting)
        while fresh:
            more = callers.get(fresh.pop(), set()) - waiting
            waiting |= more
            fresh += more
        return waiting

    # ---- statements

    def _emit(self, depth: int, text: str) -> None:
        self._out.append("    " * depth + text)
        self.lines.append(self._line)

    def _define(self, function: Function, python_name: str, depth: int, *, main: bool = False) -> None:
        self._line = function.line
        parameters = ", ".join(
            f"v_{name}" + ("" if default is None else f"={self._value(default)}")
            for name, default in function.parameters
        )
        if len({name for name, _ in function.parameters}) < len(function.parameters):
            raise ScriptError(f"two parameters of '{function.name}' have the same name", function.line)
        self._emit(depth, f"def {python_name}({parameters}):")
        own = {name for name, _ in function.parameters}
        own |= _names(s for s in _assignments(function, nested=False) if s.scope == "local")
        assigned = _names(_assignments(function, nested=False))
        shared = sorted((assigned & self._globals) - own)
        if shared:
            self._emit(depth + 1, "global " + ", ".join(f"v_{name}" for name in shared))
        changed = _changed_entries(function)
        for name, _ in function.parameters:
            if name in changed:
                self._emit(depth + 1, f"v_{name} = _copy(v_{name})")
        for inner in _own_functions(function.body):
            self._define(inner, f"f_{inner.name}", depth + 1)
        self._body(function.body, depth + 1)
        if main or function.name in self._waiting:
            self._emit(depth + 1, "return")
            self._emit(depth + 1, "yield")

    def _body(self, statements: tuple[Statement, ...], depth: int, more: int = 1) -> None:
        """Write a block; it begins with the work of its statements, plus `more`."""
        own = [s for s in statements if not isinstance(s, Function)]
        for first in range(0, max(len(own), 1), _CHUNK):
            chunk = own[first : first + _CHUNK]
            self._line = chunk[0].line if chunk else self._line
            self._emit(depth, f"_spend({more + sum(_work(s) for s in chunk)})")
            more = 0
            for statement in chunk:
                self._line = statement.line
                self._statement(statement, depth)

    def _statement(self, statement: Statement, depth: int) -> None:
        match statement:
            case Assign(NameNode(name), None):
                if statement.scope == "local":
                    self._emit(depth, f"v_{name} = 0")
            case Assign(target, value) if value is not None:
                given = self._value(value)
                if isinstance(value, NameNode | Index):
                    given = f"_copy({given})"
                if isinstance(target, Index):
                    given = f"_entry({given})"
                self._emit(depth, f"{self._target(target)} = {given}")
            case Evaluate(value):
                self._emit(depth, self._value(value))
            case Branch(cases):
                for number, (condition, body) in enumerate(cases):
                    if condition is None:
                        self._emit(depth, "else:")
                    else:
                        self._emit(depth, f"{'if' if number == 0 else 'elif'} {self._value(condition)}:")
                    self._body(body, depth + 1)
            case Loop(condition, body):
                self._emit(depth, f"while {self._value(condition)}:")
                self._body(body, depth + 1, 1 + _nodes(condition))
            case Simple():
                self._simple(statement, depth)

    def _simple(self, statement: Simple, depth: int) -> None:
        value = "" if statement.value is None else self._value(statement.value)
        match statement.word:
            case "return":
                returned = f"_copy({value})" if isinstance(statement.value, NameNode | Index) else value
                self._emit(depth, f"return {returned}")
            case "kill":
                self._emit(depth, f"_kill({value})")
            case "join":
                self._emit(depth, f"yield from _join({value})")
            case "halt":
                self._emit(depth, "_halt()")
            case "enter_critical" | "exit_critical":
                self._emit(depth, f"_{statement.word}()")
            case word:
                self._emit(depth, word)

    def _target(self, target: NameNode | Index) -> str:
        if isinstance(target, NameNode):
            return f"v_{target.name}"
        return self._entry(target)

    # ---- expressions

    def _value(self, expression: Expression) -> str:
        match expression:
            case Literal(value):
                return f"({value!r})" if isinstance(value, int | float) and not isinstance(value, bool) else repr(value)
            case NameNode(name):
                return f"v_{name}"
            case Items(items, pose):
                inner = ", ".join(
                    f"_copy({self._value(i)})" if isinstance(i, NameNode) else self._value(i) for i in items
                )
                return f"_pose([{inner}])" if pose else f"_list([{inner}])"
            case Index():
                return self._entry(expression)
            case Operation(operator, operands):
                return self._operation(operator, [self._value(o) for o in operands])
            case CallNode():
                return self._call(expression)

    def _entry(self, index: Index) -> str:
        text = self._value(index.value)
        for at in index.at:
            if isinstance(at, Literal) and type(at.value) is int and at.value >= 0:
                text += f"[{at.value}]"
            else:
                text += f"[_index({self._value(at)})]"
        return text

    def _operation(self, operator: str, operands: list[str]) -> str:
        if len(operands) == 1:
            return f"(not {operands[0]})" if operator == "not" else f"_neg({operands[0]})"
        if operator == "!=":
            return f"(not _same({operands[0]}, {operands[1]}))"
        if operator in _HELPERS:
            return f"{_HELPERS[operator]}({operands[0]}, {operands[1]})"
        return f"({operands[0]} {_OPERATORS[operator]} {operands[1]})"

    def _call(self, call: CallNode) -> str:
        function = self._functions.get(call.name)
        given = [self._value(a) for a in call.arguments]
        given += [f"{'' if function is None else 'v_'}{name}={self._value(value)}" for name, value in call.named]
        if call.thread:
            if function is None or function.kind != "thread":
                raise ScriptError(f"'{call.name}' is not a thread", call.line)
            return f"_run({', '.join([f'f_{call.name}', *given])})"
        if function is None and call.name not in self._commands:
            raise ScriptError(f"name '{call.name}' is not defined", call.line)
        if function is not None and function.kind == "thread":
            raise ScriptError(f"'{call.name}' is a thread: start it with run", call.line)
        name = f"f_{call.name}" if function is not None else f"c_{call.name}"
        text = f"{name}({', '.join(given)})"
        return f"(yield from {text})" if call.name in self._waiting else text


# ---- queries on a syntax tree


def _work(statement: Statement) -> int:
    """Return the work of a statement, without blocks within it."""
    return 1 + sum(_nodes(e) for e in _expressions(statement))


def _nodes(expression: Expression) -> int:
    return 1 + sum(_nodes(e) for e in _parts(expression))


def _parts(expression: Expression) -> tuple[Expression, ...]:
    match expression:
        case CallNode(_, arguments, named):
            return (*arguments, *(value for _, value in named))
        case Items(items):
            return items
        case Index(value, at):
            return (value, *at)
        case Operation(_, operands):
            return operands
    return ()


def _names(assignments: Iterable[Assign]) -> set[str]:
    return {s.target.name for s in assignments if isinstance(s.target, NameNode)}


def _inner(statement: Statement) -> Iterator[tuple[Statement, ...]]:
    match statement:
        case Branch(cases):
            for _, body in cases:
                yield body
        case Loop(_, body):
            yield body


def _walk(body: tuple[Statement, ...], *, nested: bool = True) -> Iterator[Statement]:
    for statement in body:
        yield statement
        if isinstance(statement, Function):
            if nested:
                yield from _walk(statement.body)
        else:
            for inner in _inner(statement):
                yield from _walk(inner, nested=nested)


def _functions(body: tuple[Statement, ...]) -> Iterator[Function]:
    return (s for s in _walk(body) if isinstance(s, Function))


def _own_functions(body: tuple[Statement, ...]) -> Iterator[Function]:
    return (s for s in _walk(body, nested=False) if isinstance(s, Function))


def _assignments(function: Function, *, nested: bool = True) -> Iterator[Assign]:
    return (s for s in _walk(function.body, nested=nested) if isinstance(s, Assign))


def _changed_entries(function: Function) -> set[str]:
    changed = set()
    for assignment in _assignments(function, nested=False):
        target: Expression = assignment.target
        while isinstance(target, Index):
            target = target.value
            if isinstance(target, NameNode):
                changed.add(target.name)
    return changed


def _pauses(body: tuple[Statement, ...]) -> bool:
    return any(isinstance(s, Simple) and s.word == "join" for s in _walk(body, nested=False))


def _calls(body: tuple[Statement, ...]) -> Iterator[str]:
    for statement in _walk(body, nested=False):
        for expression in _expressions(statement):
            yield from _called(expression)


def _expressions(statement: Statement) -> Iterator[Expression]:
    match statement:
        case Assign(target, value):
            yield target
            if value is not None:
                yield value
        case Evaluate(value):
            yield value
        case Branch(cases):
            yield from (condition for condition, _ in cases if condition is not None)
        case Loop(condition):
            yield condition
        case Simple(_, value) if value is not None:
            yield value


def _called(expression: Expression) -> Iterator[str]:
    if isinstance(expression, CallNode) and not expression.thread:
        yield expression.name
    for part in _parts(expression):
        yield from _called(part)


LONGEST_HERE = 60_000
"""Longest program that is translated between two control cycles [characters]. The 42,000 of a client's control program
take about 25 ms, and the clock catches up. Longer ones are translated in a separate process (`Uploads`)."""

_MEMORY = 2_000_000_000
"""Memory limit of a translation in a separate process [bytes]."""

_SECONDS = 20
"""Processor time limit of a translation in a separate process [s]."""

_NICENESS = 10
"""Niceness of a translation in a separate process, relative to the controller's clock."""


@dataclass(frozen=True)
class Translated:
    """An executable program.

    Attributes:
        name: from its first line.
        secondary: whether it was sent as `sec`.
        lines: for each line of the code, from 0, the program's.
        code: defines `main`.
    """

    name: str
    secondary: bool
    lines: list[int]
    code: CodeType


@lru_cache(maxsize=8)  # clients send the same program repeatedly
def translate(text: str, commands: frozenset[tuple[str, bool]]) -> Translated:
    """Translate a program.

    Args:
        text: the program.
        commands: the commands that it can call, and whether they yield (`waiting`).

    Raises:
        ScriptError: it cannot be translated.
    """
    try:
        tree = parse(text)
        translation = Translation(tree, dict(commands))
        with warnings.catch_warnings(action="ignore"):  # warnings about the generated code, e.g. `1[0]`
            code = compile(translation.source, "<program>", "exec")
    except RecursionError:
        raise ScriptError("nested too deeply") from None
    except (SyntaxError, ValueError, MemoryError) as error:
        raise ScriptError(f"can't be translated: {error}") from error
    return Translated(tree.name, tree.kind == "sec", translation.lines, code)


# ---- separate process


def question(text: str, commands: Iterable[tuple[str, bool]]) -> bytes:
    """Return the input for the translating process."""
    return json.dumps({"text": text, "commands": sorted(commands)}).encode()


def read_answer(data: bytes) -> Translated:
    """Decode the output of the translating process.

    Raises:
        ScriptError: the program is invalid, or its translation exceeded a limit.
    """
    try:
        answer = marshal.loads(data)
    except (EOFError, ValueError, TypeError):
        raise ScriptError("the program is too much to be translated") from None
    if len(answer) == 2:
        raise ScriptError(*answer)
    return Translated(*answer)


def main() -> None:
    """Translate the program on standard input: `python -m actors.emulators.ur_controller.urscript.translator`."""
    import os
    import resource

    os.nice(_NICENESS)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS))
    asked = json.loads(sys.stdin.buffer.read())
    try:
        done = translate(asked["text"], frozenset((name, waits) for name, waits in asked["commands"]))
        answer: tuple[Any, ...] = (done.name, done.secondary, done.lines, done.code)
    except ScriptError as error:
        answer = (error.text, error.line)
    sys.stdout.buffer.write(marshal.dumps(answer))


if __name__ == "__main__":
    main()
