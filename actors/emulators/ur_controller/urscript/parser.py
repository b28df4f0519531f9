"""The parser of URScript: from tokens to a syntax tree.

The node classes are values without behaviour; `parse` creates them, and `translator` reads them. Line ends terminate
statements only where they must, because text injected into a program may join lines.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite

from actors.emulators.ur_controller.urscript.lexer import ScriptError, ScriptToken, words


@dataclass(frozen=True, slots=True)
class Literal:
    """A number, a string, a truth value."""

    value: int | float | str | bool


@dataclass(frozen=True, slots=True)
class NameNode:
    """A variable's value."""

    name: str
    line: int


@dataclass(frozen=True, slots=True)
class Items:
    """A list [...] or, with six entries after a p, a pose."""

    items: tuple[Expression, ...]
    pose: bool


@dataclass(frozen=True, slots=True)
class Index:
    """One entry: x[i] or x[i, j]."""

    value: Expression
    at: tuple[Expression, ...]


@dataclass(frozen=True, slots=True)
class CallNode:
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


Expression = Literal | NameNode | Items | Index | CallNode | Operation


@dataclass(frozen=True, slots=True)
class Assign:
    """x = …, x[i] = …; `scope` is '', 'global' or 'local'."""

    target: NameNode | Index
    value: Expression | None
    scope: str
    line: int


@dataclass(frozen=True, slots=True)
class Evaluate:
    """An expression used as a statement."""

    value: Expression
    line: int


@dataclass(frozen=True, slots=True)
class Branch:
    """if, elif … else: conditions with their blocks; the last condition is None for else."""

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


DEEPEST = 60
"""Maximum nesting depth of a program, of blocks and of brackets."""

_LEVELS: tuple[frozenset[str], ...] = (
    frozenset({"or", "xor"}),
    frozenset({"and"}),
    frozenset({"==", "!=", "<", ">", "<=", ">="}),
    frozenset({"+", "-"}),
    frozenset({"*", "/", "%"}),
)
"""Operators with two operands, lowest precedence first; `not` is between `and` and the comparisons."""

_COMPARISON = 2


def parse(text: str) -> Function:
    """Parse one program.

    Args:
        text: a complete `def` or `sec`, or loose statements, which become a program of their own.

    Raises:
        ScriptError: a syntax error, with its line.
    """
    return _Parser(words(text)).program()


class _Parser:
    def __init__(self, given: list[ScriptToken]) -> None:
        self._words = given
        self._at = 0
        self._depth = 0
        self._brackets = 0

    # ---- tokens

    @property
    def _word(self) -> ScriptToken:
        return self._words[self._at]

    def _next(self) -> ScriptToken:
        word = self._words[self._at]
        if word.kind != "end of text":
            self._at += 1
        return word

    def _is(self, *texts: str) -> bool:
        return self._word.kind in ("op", "keyword") and self._word.text in texts

    def _take(self, text: str) -> ScriptToken:
        if not self._is(text):
            raise self._unexpected(f"'{text}'")
        return self._next()

    def _name(self) -> str:
        if self._word.kind != "name":
            raise self._unexpected("a name")
        return self._next().text

    def _unexpected(self, wanted: str) -> ScriptError:
        word = self._word
        found = "the end of the text" if word.kind == "end of text" else f"'{word.text}'"
        return ScriptError(f"expected {wanted}, found {found}", word.line)

    def _deeper(self) -> None:
        self._depth += 1
        if self._depth > DEEPEST:
            raise ScriptError("nested too deeply", self._word.line)

    # ---- statements

    def program(self) -> Function:
        if self._is("def", "sec"):
            function = self._function()
            if self._word.kind != "end of text":
                raise self._unexpected("nothing more")
            if function.parameters:
                raise ScriptError(f"program '{function.name}' must not have parameters", function.line)
            return function
        body, line = [], self._word.line
        while self._word.kind != "end of text":
            body.append(self._statement())
        return Function("def", "unnamed", (), tuple(body), line)

    def _function(self) -> Function:
        word = self._next()
        name = self._name()
        parameters: list[tuple[str, Expression | None]] = []
        self._take("(")
        while not self._is(")"):
            parameter = self._name()
            default = None
            if self._is("="):
                self._next()
                default = self._inside()
            parameters.append((parameter, default))
            if not self._is(")"):
                self._take(",")
        self._take(")")
        self._take(":")
        body = self._block("end")
        self._take("end")
        return Function(word.text, name, tuple(parameters), body, word.line)

    def _block(self, *ends: str) -> tuple[Statement, ...]:
        self._deeper()
        statements: list[Statement] = []
        while not self._is(*ends):
            if self._word.kind == "end of text":
                raise self._unexpected(f"'{ends[0]}'")
            statements.append(self._statement())
        self._depth -= 1
        return tuple(statements)

    def _statement(self) -> Statement:
        word = self._word
        if word.kind == "keyword":
            match word.text:
                case "def" | "thread":
                    return self._function()
                case "if":
                    return self._branch()
                case "while":
                    self._next()
                    condition = self._expression()
                    self._take(":")
                    body = self._block("end")
                    self._take("end")
                    return Loop(condition, body, word.line)
                case "global" | "local":
                    self._next()
                    target = NameNode(self._name(), word.line)
                    value = None
                    if self._is("="):
                        self._next()
                        value = self._expression()
                    return Assign(target, value, word.text, word.line)
                case "break" | "continue" | "halt" | "pass" | "enter_critical" | "exit_critical":
                    self._next()
                    return Simple(word.text, None, word.line)
                case "kill" | "join":
                    self._next()
                    return Simple(word.text, self._expression(), word.line)
                case "return":
                    self._next()
                    bare = self._word.fresh or self._word.kind == "end of text" or self._is("end", ";")
                    return Simple("return", None if bare else self._expression(), word.line)
        if self._is(";"):
            self._next()
            return Simple("pass", None, word.line)
        expression = self._expression()
        if self._is("="):
            self._next()
            if not isinstance(expression, NameNode | Index):
                raise ScriptError("only a variable or its entry can be assigned to", word.line)
            return Assign(expression, self._expression(), "", word.line)
        return Evaluate(expression, word.line)

    def _branch(self) -> Branch:
        line = self._word.line
        cases: list[tuple[Expression | None, tuple[Statement, ...]]] = []
        while True:
            word = self._next()
            condition = None if word.text == "else" else self._expression()
            self._take(":")
            cases.append((condition, self._block("end") if condition is None else self._block("end", "elif", "else")))
            if self._is("end"):
                self._next()
                return Branch(tuple(cases), line)

    # ---- expressions

    def _inside(self) -> Expression:
        """Parse within brackets, where line ends have no meaning."""
        self._brackets += 1
        expression = self._expression()
        self._brackets -= 1
        return expression

    def _continues(self) -> bool:
        return self._brackets > 0 or not self._word.fresh

    def _expression(self, level: int = 0) -> Expression:
        self._deeper()
        result = self._binary(level)
        self._depth -= 1
        return result

    def _binary(self, level: int) -> Expression:
        if level == len(_LEVELS):
            return self._unary()
        if level == _COMPARISON and self._is("not"):
            self._next()
            self._deeper()
            operand = self._binary(level)
            self._depth -= 1
            return Operation("not", (operand,))
        left = self._binary(level + 1)
        while self._is(*_LEVELS[level]) and self._continues():
            operator = self._next().text
            left = Operation(operator, (left, self._binary(level + 1)))
        return left

    def _unary(self) -> Expression:
        if self._is("-", "+", "not"):
            self._deeper()
            operator = self._next().text
            operand = self._unary()
            self._depth -= 1
            if isinstance(operand, Literal) and operator == "-" and type(operand.value) in (int, float):
                return Literal(-operand.value)  # type: ignore[operator]
            return operand if operator == "+" else Operation(operator, (operand,))
        return self._postfix(self._primary())

    def _postfix(self, value: Expression) -> Expression:
        while self._is("[") and self._continues():
            self._next()
            at = self._list("]")
            if not 1 <= len(at) <= 2:
                raise ScriptError("an entry has one index or two", self._word.line)
            value = Index(value, at)
        return value

    def _list(self, closing: str) -> tuple[Expression, ...]:
        items: list[Expression] = []
        while not self._is(closing):
            items.append(self._inside())
            if not self._is(closing):
                self._take(",")
        self._take(closing)
        return tuple(items)

    def _primary(self) -> Expression:
        word = self._next()
        if word.kind == "number":
            return Literal(_number(word))
        if word.kind == "string":
            return Literal(word.text)
        if word.kind == "keyword" and word.text in ("True", "true", "TRUE", "False", "false", "FALSE"):
            return Literal(word.text.lower() == "true")
        if word.kind == "keyword" and word.text == "run":
            line, name = self._word.line, self._name()
            self._take("(")
            return CallNode(name, self._list(")"), (), True, line)
        if word.kind == "op" and word.text == "(":
            expression = self._inside()
            self._take(")")
            return expression
        if word.kind == "op" and word.text == "[":
            return Items(self._list("]"), pose=False)
        if word.kind == "name":
            if self._is("(") and not self._word.fresh:
                return self._call(word)
            if word.text == "p" and self._is("[") and not self._word.fresh:
                return self._pose(word)
            return NameNode(word.text, word.line)
        self._at -= word.kind != "end of text"
        raise self._unexpected("a value")

    def _pose(self, word: ScriptToken) -> Expression:
        # p[…] with six entries is a pose; with fewer it is an entry of a variable named p.
        self._take("[")
        items = self._list("]")
        if len(items) == 6:
            return Items(items, pose=True)
        if not 1 <= len(items) <= 2:
            raise ScriptError("a pose has six entries", word.line)
        return Index(NameNode("p", word.line), items)

    def _call(self, word: ScriptToken) -> CallNode:
        self._take("(")
        arguments: list[Expression] = []
        named: list[tuple[str, Expression]] = []
        while not self._is(")"):
            following = self._words[min(self._at + 1, len(self._words) - 1)]
            if self._word.kind == "name" and following.kind == "op" and following.text == "=":
                name = self._name()
                self._next()
                named.append((name, self._inside()))
            elif named:
                raise ScriptError("a value without a name can't follow one with a name", self._word.line)
            else:
                arguments.append(self._inside())
            if not self._is(")"):
                self._take(",")
        self._take(")")
        return CallNode(word.text, tuple(arguments), tuple(named), False, word.line)


def _number(word: ScriptToken) -> int | float:
    hexadecimal = word.text[:2] in ("0x", "0X")
    if hexadecimal or word.text.isdigit():
        if len(word.text) > 18:
            raise ScriptError("a number with too many digits", word.line)
        return int(word.text, 16 if hexadecimal else 10)
    value = float(word.text)
    if not isfinite(value):
        raise ScriptError("a number that is too large", word.line)
    return value
