"""From a program's text to code that can be run: here, or where it is long in a process of its own, bounded in all."""

from __future__ import annotations

import json
import marshal
import sys
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType
from typing import Any

from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.parser import parse
from actors.virtual_ur.urscript.translator import Translation

LONGEST_HERE = 60_000
"""Characters of a program that is translated between two control cycles: with some 25 ms for the 42,000 of a client's
control program the clock catches up. Longer ones are translated apart (`Uploads`)."""

_MEMORY = 2_000_000_000
"""Memory that a translation apart may take [bytes]."""

_SECONDS = 20
"""Processor time that a translation apart may take [s]."""

_NICENESS = 10
"""How far a translation apart gives way to the controller's clock [nice]."""


@dataclass(frozen=True)
class Translated:
    """A program that can be run.

    Attributes:
        name: from its first line.
        secondary: it was sent as `sec`.
        lines: for each line of the code, from 0, the program's.
        code: defines `main`.
    """

    name: str
    secondary: bool
    lines: list[int]
    code: CodeType


@lru_cache(maxsize=8)  # clients send the same program again and again
def translate(text: str, commands: frozenset[tuple[str, bool]]) -> Translated:
    """Translate a program.

    Args:
        text: the program.
        commands: what it may call, and whether it gives way (`waiting`).

    Raises:
        ScriptError: it can't be read.
    """
    try:
        tree = parse(text)
        translation = Translation(tree, dict(commands))
        with warnings.catch_warnings(action="ignore"):  # of the code's own making: `1[0]`, say
            code = compile(translation.source, "<program>", "exec")
    except RecursionError:
        raise ScriptError("nested too deeply") from None
    except (SyntaxError, ValueError, MemoryError) as error:
        raise ScriptError(f"can't be translated: {error}") from error
    return Translated(tree.name, tree.kind == "sec", translation.lines, code)


# ---- apart


def question(text: str, commands: Iterable[tuple[str, bool]]) -> bytes:
    """What the process that translates is given on its standard input."""
    return json.dumps({"text": text, "commands": sorted(commands)}).encode()


def read_answer(data: bytes) -> Translated:
    """What the process that translates has answered on its standard output.

    Raises:
        ScriptError: the program can't be read, or its translation took too much.
    """
    try:
        answer = marshal.loads(data)
    except (EOFError, ValueError, TypeError):
        raise ScriptError("the program is too much to be translated") from None
    if len(answer) == 2:
        raise ScriptError(*answer)
    return Translated(*answer)


def main() -> None:
    """Translate what stands on standard input: `python -m actors.virtual_ur.urscript`."""
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
