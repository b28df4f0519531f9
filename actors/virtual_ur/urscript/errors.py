"""What is wrong with a program, and where in its text."""

from __future__ import annotations


class ScriptError(Exception):
    """A program can't be read or can't go on.

    Args:
        text: what is wrong.
        line: in the program's text, from 1; 0 where unknown.
    """

    def __init__(self, text: str, line: int = 0) -> None:
        super().__init__(f"line {line}: {text}" if line else text)
        self.text = text
        self.line = line
