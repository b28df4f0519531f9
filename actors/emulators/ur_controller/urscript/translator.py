"""The translator of URScript: to Python generators, which yield once per control cycle.

URScript differs from Python in its blocks, its declarations, and in lists, which are values. `_PythonText` therefore
rewrites the tokens of a program as lines of Python, Python's own parser makes a syntax tree of them, and `_Translation`
changes the tree where the meaning differs: it copies lists, and calls the functions of `script_values` for arithmetic.

Every name gets a prefix, only some kinds of nodes are accepted, and the code runs without Python's built-in functions.
A program can therefore use nothing but its commands. Only functions that may wait (directly or by a function that they
call) become generators; the others stay plain functions, because they are called hundreds of times per second.

Scopes follow the manual: a name declared `global` anywhere is global, except where it is declared `local` or a
parameter. Any other name is local to the function that assigns it.

Limitations: no `xor` and `join`, no chains of comparisons. Programs that use them are refused.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from types import CodeType
from typing import Any

from actors.emulators.ur_controller.urscript.lexer import ScriptError, ScriptToken, words

_HEADERS = frozenset({"def", "thread", "sec", "if", "elif", "else", "while"})
_TRUTH = frozenset({"True", "true", "TRUE", "False", "false", "FALSE"})
_IN_EXPRESSIONS = _TRUTH | {"and", "or", "not", "xor", "run"}
_WORDS = {"halt": "_halt()", "enter_critical": "_enter_critical()", "exit_critical": "_exit_critical()"}
"""Statements of one word that are calls in Python."""

_ARITHMETIC: dict[type[ast.operator], str] = {
    ast.Add: "_add",
    ast.Sub: "_sub",
    ast.Mult: "_mul",
    ast.Div: "_div",
    ast.Mod: "_mod",
}
_ACCEPTED = (
    *(ast.Module, ast.FunctionDef, ast.arguments, ast.arg, ast.Assign, ast.AnnAssign, ast.Expr, ast.If, ast.While),
    *(ast.Return, ast.Break, ast.Continue, ast.Pass, ast.Call, ast.keyword, ast.Name, ast.Constant, ast.List),
    *(ast.Subscript, ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.expr_context, ast.operator, ast.unaryop),
    *(ast.boolop, ast.cmpop),
)


class _PythonText:
    """The Python text of a program, before the tree of it is changed.

    Variables are `v_x`, functions `f_x` and threads `t_x`; `run x(…)` is `r_x(…)`, and declarations are annotations:
    `v_x: _global = …`.

    Args:
        tokens: of the program.

    Attributes:
        lines: of Python.
        numbers: of the program's lines, for each line of Python.
    """

    def __init__(self, tokens: list[ScriptToken]) -> None:
        self.lines: list[str] = []
        self.numbers: list[int] = []
        self._depth = 0
        self._brackets = 0
        self._statement: list[str] = []
        self._keyword = ""
        self._line = 1
        self._ends_value = False
        for token in tokens:
            self._add(token)
        if self._depth:
            raise ScriptError("expected 'end', found the end of the text", tokens[-1].line)

    def _add(self, token: ScriptToken) -> None:
        word = token.text if token.kind == "keyword" else ""
        operator = token.text if token.kind == "op" else ""
        begins = bool(word) and word not in _IN_EXPRESSIONS
        if begins and self._brackets:
            raise ScriptError(f"expected ')' or ']', found '{word}'", token.line)
        is_value = token.kind in ("number", "numbers", "string", "name") or word in _TRUTH or word == "run"
        follows = token.fresh or (is_value and self._statement != ["return"])
        if token.kind == "end of text" or begins or (self._ends_value and follows and not self._brackets):
            self._finish(token)
        if begins:
            self._begin(token)
        elif token.kind != "end of text":
            self._line = self._line if self._statement else token.line
            self._statement.append(self._python(token))
            self._ends_value = (is_value and word != "run") or operator in (")", "]")
            if operator == ":":
                self._write()
                self._depth += 1

    def _begin(self, token: ScriptToken) -> None:
        """Begin a statement with a keyword."""
        text, self._line = token.text, token.line
        if text == "join":
            raise ScriptError("join is not supported by this virtual controller", token.line)
        if text in ("end", "elif", "else"):
            if not self._depth:
                raise ScriptError(f"'{text}' without a block", token.line)
            self._statement = ["pass"]  # a block may be empty
            self._write()
            self._depth -= 1
        if text != "end":
            self._keyword = text
            self._statement = {
                "kill": ["_kill("], "global": [], "local": [], "def": ["def"], "sec": ["def"], "thread": ["def"]
            }.get(text, [_WORDS.get(text, text)])  # fmt: skip
        self._ends_value = text in ("return", "break", "continue", "pass", *_WORDS)

    def _python(self, token: ScriptToken) -> str:
        text = token.text
        match token.kind:
            case "number":
                return repr(_number(token))
            case "numbers":
                return f"b'{text[1:-1]}'"  # see `_Translation.visit_Constant`
            case "string":
                return repr(text)
            case "name":
                if self._statement == ["def"]:
                    return f"{'t' if self._keyword == 'thread' else 'f'}_{text}"
                if self._statement and self._statement[-1] == "run":
                    self._statement.pop()
                    return f"r_{text}"
                declared = self._keyword in ("global", "local") and not self._statement
                return f"v_{text}: _{self._keyword}" if declared else f"v_{text}"
        if text == "xor":
            raise ScriptError("xor is not supported by this virtual controller", token.line)
        self._brackets += (text in ("(", "[")) - (text in (")", "]"))
        if self._brackets < 0:
            raise ScriptError(f"'{text}' closes nothing", token.line)
        if text == ":" and (self._brackets or self._keyword not in _HEADERS):
            raise ScriptError("':' means nothing here", token.line)
        return text.capitalize() if text in _TRUTH else text

    def _finish(self, token: ScriptToken) -> None:
        if self._statement and self._keyword in _HEADERS:
            raise ScriptError(f"expected ':', found '{token.text}'", token.line)
        if self._keyword == "kill":
            self._statement.append(")")
        self._write()

    def _write(self) -> None:
        if self._statement:
            self.lines.append(" " * self._depth + " ".join(self._statement))
            self.numbers.append(self._line)
        self._statement, self._keyword, self._ends_value = [], "", False


def _number(token: ScriptToken) -> int | float:
    hexadecimal = token.text[:2] in ("0x", "0X")
    if hexadecimal or token.text.isdigit():
        if len(token.text) > 18:
            raise ScriptError("a number with too many digits", token.line)
        return int(token.text, 16 if hexadecimal else 10)
    value = float(token.text)
    if not isfinite(value):
        raise ScriptError("a number that is too large", token.line)
    return value


class _Translation(ast.NodeTransformer):
    """Changes the tree of a program where the meaning of Python differs.

    Args:
        program: its function.
        nodes: of the tree.
        commands: the commands that the program can call, and whether they wait.
    """

    def __init__(self, program: ast.FunctionDef, nodes: Iterable[ast.AST], commands: dict[str, bool]) -> None:
        self._main = program
        self._commands = commands
        functions = (node for node in nodes if isinstance(node, ast.FunctionDef) and node is not program)
        self._functions = {node.name[2:]: node for node in functions}
        self._globals = {_declared(node) for node in nodes if isinstance(node, ast.AnnAssign)}
        callers: dict[str, set[str]] = {}
        for name, function in self._functions.items():
            for node in ast.walk(function):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id[:2] == "v_":
                    callers.setdefault(node.func.id[2:], set()).add(name)
        self._waiting = {name for name, waits in commands.items() if waits and name not in self._functions}
        self._waiting |= {name for name, function in self._functions.items() if function.name[:2] == "t_"}
        fresh = list(self._waiting)
        while fresh:
            more = callers.get(fresh.pop(), set()) - self._waiting
            self._waiting |= more
            fresh += more

    def visit(self, node: ast.AST) -> Any:
        """Refuse what URScript lacks."""
        if not isinstance(node, _ACCEPTED):
            raise ScriptError("this means nothing in URScript", getattr(node, "lineno", 0))
        return super().visit(node)

    # ---- statements

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        """Functions come first, since they can be called before they are written."""
        if node.args.posonlyargs or node.args.kwonlyargs or node.args.vararg or node.args.kwarg:
            raise ScriptError("a parameter is a name", node.lineno)
        parameters = {parameter.arg for parameter in node.args.args}
        statements = list(_statements(node.body))
        targets = [_target(statement) for statement in statements if isinstance(statement, ast.Assign | ast.AnnAssign)]
        assigned = {target.id for target in targets if isinstance(target, ast.Name)}
        local = parameters | {_declared(node, "_local") for node in statements if isinstance(node, ast.AnnAssign)}
        changed = {_base(target) for target in targets if isinstance(target, ast.Subscript)}
        inner = [statement for statement in statements if isinstance(statement, ast.FunctionDef)]
        for function in inner:
            self.visit(function)
        self.generic_visit(node.args)
        first: list[ast.stmt] = [ast.Global(sorted(shared))] if (shared := (assigned & self._globals) - local) else []
        for name in sorted(parameters & changed):
            first.append(ast.Assign([_name(name, ast.Store())], _called("_copy", _name(name))))
        node.body = [*first, *inner, *self._block(node.body, counted=node is not self._main)]
        if node is self._main or node.name[2:] in self._waiting:
            node.body += [ast.Return(None), ast.Expr(ast.Yield(None))]
        return node

    def _block(self, statements: Iterable[ast.stmt], *, counted: bool = True, more: int = 1) -> list[ast.stmt]:
        """Translate a block, which begins with the count of its work; `more` is added."""
        own = [statement for statement in statements if not isinstance(statement, ast.FunctionDef)]
        parts = (statement.test if isinstance(statement, ast.If | ast.While) else statement for statement in own)
        count = ast.Expr(_called("_spend", ast.Constant(more + sum(map(_nodes, parts))))) if counted else ast.Pass()
        block: list[ast.stmt] = [self.visit(statement) for statement in own]
        return [ast.copy_location(count, block[0]), *block] if block else block

    def visit_If(self, node: ast.If) -> ast.If:
        """Blocks of their own."""
        node.test = self.visit(node.test)
        node.body = self._block(node.body)
        is_elif = len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If)
        node.orelse = self._block(node.orelse, counted=not is_elif) if node.orelse else []
        return node

    def visit_While(self, node: ast.While) -> ast.While:
        """A block of its own, which counts its condition."""
        node.body = self._block(node.body, more=1 + _nodes(node.test))
        node.test = self.visit(node.test)
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        """Lists are values."""
        return self._assignment(node.targets, node.value, node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.stmt:
        """A declaration; a local variable without a value is 0."""
        if node.value is None and _declared(node):
            return ast.copy_location(ast.Pass(), node)
        if not (_declared(node) or _declared(node, "_local")):
            raise ScriptError("only a variable can be declared", node.lineno)
        return self._assignment([node.target], node.value or ast.Constant(0), node)

    def _assignment(self, targets: list[ast.expr], value: ast.expr, node: ast.stmt) -> ast.Assign:
        if len(targets) > 1 or not isinstance(targets[0], ast.Name | ast.Subscript):
            raise ScriptError("only a variable or its entry can be assigned to", node.lineno)
        return ast.copy_location(ast.Assign([self.visit(targets[0])], self._copied(value)), node)

    def visit_Return(self, node: ast.Return) -> ast.Return:
        """Lists are values."""
        node.value = None if node.value is None else self._copied(node.value)
        return node

    # ---- expressions

    def _copied(self, node: ast.expr) -> ast.expr:
        value: ast.expr = self.visit(node)
        return _called("_copy", value) if isinstance(node, ast.Name | ast.Subscript) else value

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Arithmetic of 32 bits."""
        return _called(_ARITHMETIC[type(node.op)], self.visit(node.left), self.visit(node.right))

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        """A negative number is a constant."""
        operand: ast.expr = self.visit(node.operand)
        if isinstance(node.op, ast.Not):
            return ast.UnaryOp(node.op, operand)
        if isinstance(node.op, ast.UAdd):
            return operand
        if isinstance(operand, ast.Constant) and type(operand.value) in (int, float):
            return ast.Constant(-operand.value)  # type: ignore[operator]
        return _called("_neg", operand)

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """Bytes are the numbers of a list."""
        if not isinstance(node.value, bytes):
            return node
        numbers: Any = tuple(float(n) if "." in n else int(n) for n in node.value.decode().split(","))
        return ast.List([ast.Starred(ast.Constant(numbers), ast.Load())], ast.Load())

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """One operator."""
        if len(node.ops) > 1:
            raise ScriptError("comparisons in a chain are not supported by this virtual controller", node.lineno)
        return self.generic_visit(node)

    def visit_List(self, node: ast.List) -> ast.List:
        """Lists are values."""
        node.elts = [self._copied(item) if isinstance(item, ast.Name) else self.visit(item) for item in node.elts]
        return node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """An entry x[i] or x[i, j], or a pose: p[…] with six entries."""
        at = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        is_p = isinstance(node.value, ast.Name) and node.value.id == "v_p"
        if is_p and len(at) == 6 and isinstance(node.ctx, ast.Load):
            return _called("_pose", self.visit(ast.List(at, ast.Load())))
        if len(at) > 2:
            raise ScriptError("a pose has six entries" if is_p else "an entry has one index or two", node.lineno)
        value: ast.expr = self.visit(node.value)
        index: ast.expr
        for item in at:
            plain = isinstance(item, ast.Constant) and type(item.value) is int
            index = item if plain else _called("_index", self.visit(item))
            value = ast.Subscript(value, index, node.ctx if item is at[-1] else ast.Load())
        return value

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """A function, a thread that starts, or a command."""
        if not isinstance(node.func, ast.Name):
            raise ScriptError("only a function can be called", node.lineno)
        kind, name = node.func.id[:2], node.func.id[2:]
        function = self._functions.get(name)
        given = [self.visit(argument) for argument in node.args]
        named = [ast.keyword((key.arg or "")[0 if function else 2 :], self.visit(key.value)) for key in node.keywords]
        call = ast.Call(node.func, given, named)
        if kind.startswith("_"):
            return call
        if kind == "r_":
            if function is None or function.name[:2] != "t_":
                raise ScriptError(f"'{name}' is not a thread", node.lineno)
            call.func, call.args = _name("_run"), [_name(function.name), *given]
            return call
        if function is None and name not in self._commands:
            raise ScriptError(f"name '{name}' is not defined in this virtual controller", node.lineno)
        if function is not None and function.name[:2] == "t_":
            raise ScriptError(f"'{name}' is a thread: start it with run", node.lineno)
        call.func = _name(f"c_{name}" if function is None else function.name)
        return ast.YieldFrom(call) if name in self._waiting else call


def _name(name: str, context: ast.expr_context | None = None) -> ast.Name:
    return ast.Name(name, context or ast.Load())


def _called(function: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(_name(function), list(arguments), [])


def _nodes(node: ast.AST) -> int:
    return sum(isinstance(inner, ast.expr | ast.stmt) for inner in ast.walk(node))


def _statements(block: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """All statements of a function, without those of functions within it."""
    for statement in block:
        yield statement
        if isinstance(statement, ast.If | ast.While):
            yield from _statements([*statement.body, *statement.orelse])


def _target(statement: ast.Assign | ast.AnnAssign) -> ast.expr:
    return statement.targets[0] if isinstance(statement, ast.Assign) else statement.target


def _base(target: ast.expr) -> str:
    while isinstance(target, ast.Subscript):
        target = target.value
    return target.id if isinstance(target, ast.Name) else ""


def _declared(statement: ast.AnnAssign, scope: str = "_global") -> str:
    """The name that a declaration declares, if it is in this scope; otherwise ''."""
    annotation = statement.annotation
    return _base(statement.target) if isinstance(annotation, ast.Name) and annotation.id == scope else ""


@dataclass(frozen=True)
class Translated:
    """An executable program.

    Attributes:
        name: from its first line.
        secondary: whether it was sent as `sec`.
        code: defines `main`; its lines are those of the program.
    """

    name: str
    secondary: bool
    code: CodeType


@lru_cache(maxsize=8)  # clients send the same program repeatedly
def translate(text: str, commands: frozenset[tuple[str, bool]]) -> Translated:
    """Translate a program.

    Args:
        text: a complete `def` or `sec`, or loose statements, which become a program of their own.
        commands: the commands that it can call, and whether they yield (`waiting`).

    Raises:
        ScriptError: it cannot be translated.
    """
    tokens = words(text)
    python = _PythonText(tokens)
    try:
        module = ast.parse("\n".join(python.lines) + "\n")
        nodes = list(ast.walk(module))
        for node in nodes:
            if isinstance(node, ast.stmt | ast.expr | ast.arg | ast.keyword):
                node.lineno = node.end_lineno = python.numbers[node.lineno - 1]
        program = _program(module, tokens[0])
        module.body = [_Translation(program, nodes, dict(commands)).visit(program)]
        name, program.name = program.name[2:], "main"
        with warnings.catch_warnings(action="ignore"):  # warnings about the generated code, e.g. `1[0]`
            code = compile(ast.fix_missing_locations(module), "<program>", "exec")
    except RecursionError:
        raise ScriptError("nested too deeply") from None
    except SyntaxError as error:
        at = min(error.lineno or 1, len(python.numbers)) - 1
        raise ScriptError(f"syntax error: {error.msg}".replace("v_", ""), python.numbers[at]) from None
    except (ValueError, MemoryError) as error:
        raise ScriptError(f"can't be translated: {error}") from error
    return Translated(name, tokens[0].text == "sec", code)


def _program(module: ast.Module, first: ScriptToken) -> ast.FunctionDef:
    """The function of a program; loose statements become one."""
    if first.kind != "keyword" or first.text not in ("def", "sec"):
        empty = ast.arguments([], [], None, [], [], None, [])
        return ast.FunctionDef("f_unnamed", empty, module.body, [], lineno=first.line, end_lineno=first.line)
    program, *others = module.body
    assert isinstance(program, ast.FunctionDef)
    if others:
        raise ScriptError("expected nothing after the program's end", others[0].lineno)
    if program.args.args:
        raise ScriptError(f"program '{program.name[2:]}' must not have parameters", program.lineno)
    return program
