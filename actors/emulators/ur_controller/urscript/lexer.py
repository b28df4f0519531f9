"""The lexer of URScript: splits a program into tokens, and a stream of text into programs.

`words` returns the tokens of a program, and `Splitter` finds the programs in a stream. `ScriptError` is the error of
all stages, with the line in the program's text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass


class ScriptError(Exception):
    """A program cannot be parsed or cannot continue.

    Args:
        text: the error.
        line: in the program's text, from 1; 0 if unknown.
    """

    def __init__(self, text: str, line: int = 0) -> None:
        super().__init__(f"line {line}: {text}" if line else text)
        self.text = text
        self.line = line


LONGEST = 1_000_000
"""Maximum length of a program [characters]."""

KEYWORDS = frozenset(
    (
        *("def", "thread", "sec", "end", "if", "elif", "else", "while", "return", "break", "continue", "halt", "pass"),
        *("global", "local", "run", "kill", "join", "enter_critical", "exit_critical", "and", "or", "xor", "not"),
        *("True", "False", "true", "false", "TRUE", "FALSE"),
    )
)

OPENERS = frozenset({"def", "thread", "sec", "if", "while"})
"""Keywords that are closed by an `end`."""

_DECIMAL = r"-?\d{1,15}(?:\.\d{0,15})?"

_WORD = re.compile(
    rf"""(?P<space>[ \t\r\f\v]+)
      | (?P<newline>[\n;])
      | (?P<comment>\#[^\n]*)
      | (?P<number>(?:0[xX][0-9A-Fa-f]+)|(?:\d+\.?\d*(?:[eE][+-]?\d+)?)|(?:\.\d+(?:[eE][+-]?\d+)?))
      | (?P<name>[A-Za-z_][A-Za-z_0-9]*)
      | (?P<string>"[^"\n]*"|'[^'\n]*')
      | (?P<numbers>\[{_DECIMAL}(?:,\ {_DECIMAL})+\])
      | (?P<op><=|>=|==|!=|[-+*/%<>=()\[\],:])
      """,
    re.VERBOSE,
)


@dataclass(frozen=True, slots=True)
class ScriptToken:
    """One token of a program.

    Attributes:
        kind: 'number', 'numbers', 'name', 'keyword', 'string', 'op', or 'end of text'. A list of plain numbers is one
            token, 'numbers': a path has thousands of them, and time is short on a busy machine.
        text: as written; of a string, without its quotes.
        line: from 1.
        fresh: whether it is the first of its line, or after a semicolon.
    """

    kind: str
    text: str
    line: int
    fresh: bool


def words(text: str) -> list[ScriptToken]:
    """Return all tokens of a program, ended by one of the kind 'end of text'.

    Raises:
        ScriptError: a character that starts no token.
    """
    tokens: list[ScriptToken] = []
    line, fresh, place = 1, True, 0
    while place < len(text):
        match = _WORD.match(text, place)
        if match is None:
            raise ScriptError(f"{text[place]!r} means nothing here", line)
        kind, word = match.lastgroup or "", match.group()
        if kind == "numbers" and not fresh and (tokens[-1].kind == "name" or tokens[-1].text in (")", "]")):
            kind, word = "op", "["  # it begins an index
        place += len(word)
        if kind == "newline":
            line, fresh = line + (word == "\n"), True
        elif kind not in ("space", "comment"):
            if kind == "name" and word in KEYWORDS:
                kind = "keyword"
            if kind == "string":
                word = word[1:-1]
            tokens.append(ScriptToken(kind, word, line, fresh))
            fresh = False
    tokens.append(ScriptToken("end of text", "", line, True))
    return tokens


_STRUCTURE = re.compile(r"""\#[^\n]*|"[^"\n]*"|'[^'\n]*'|[A-Za-z_][A-Za-z_0-9]*""")


class Splitter:
    """Splits a stream of text into programs: from `def`, `sec` to their `end`; other lines are programs of their own.

    Args:
        limit: longest text without an end that is kept [characters].
    """

    def __init__(self, limit: int = LONGEST) -> None:
        self._limit = limit
        self._rest = ""
        self._lines: list[str] = []
        self._size = 0
        self._depth = 0

    def feed(self, text: str) -> list[str]:
        """Add the next piece of the stream.

        Returns:
            Programs that are complete now.

        Raises:
            ScriptError: too much text without an end; the kept text is dropped.
        """
        *lines, self._rest = (self._rest + text).split("\n")
        programs = []
        for line in lines:
            opened = self._depth > 0
            for match in _STRUCTURE.finditer(line):
                if match.group() in OPENERS:
                    self._depth += 1
                    opened = True
                elif match.group() == "end" and self._depth:
                    self._depth -= 1
            if opened or line.strip():
                self._lines.append(line)
                self._size += len(line) + 1
            if self._depth == 0 and self._lines:
                programs.append("\n".join(self._lines) + "\n")
                self._lines, self._size = [], 0
        if self._size + len(self._rest) > self._limit:
            self._lines, self._size, self._depth, self._rest = [], 0, 0, ""
            raise ScriptError(f"more than {self._limit} characters without an end")
        return programs
