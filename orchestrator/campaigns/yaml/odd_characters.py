"""Characters that look like a space or a quote and are none in YAML: pasted from web pages and word processors.

YAML accepts them inside of a text, so that the parser complains later and elsewhere, or takes a key for a value.
`in_plain_text` examines a key or value that was read, `before_error` the lines up to a syntax error.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

SPACES = "\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000"
HIDDEN = "\u00ad\u200b\u200e\u200f\u2060\ufeff\x85\u2028\u2029"
OPENING, CLOSING = "“”„«‘‚‹", "“”»’‘›"

_ENDS = re.compile(rf"^[{SPACES}{HIDDEN}\u200c\u200d]|[{SPACES}{HIDDEN}\u200c\u200d]$")
_HIDDEN = re.compile(rf"[{HIDDEN}]")
_AFTER_SIGN = re.compile(rf"^(?:[\w.-]+:|-)([{SPACES}])")
_QUOTED = re.compile(rf"[{OPENING}](.*[{CLOSING}]|[^{CLOSING}]*)", re.DOTALL)
"""A text in curly quotes, or the part before its first comma in a list."""
_WIDE_COLON = re.compile(r"^[\w.-]+(：)")

_IN_LINE = re.compile(
    rf"^ *[{SPACES}]|[{HIDDEN}]|^\s*-[{SPACES}]|\w['\"]?:[{SPACES}]|[:\[{{,-]\s+[{OPENING}]|^\s*[\w.-]+：|\w:\t"
)
"""Places in a line where YAML needs another character; the last character of a match is the odd one."""

_BREAKS = "\x85\u2028\u2029"
"""Line breaks of YAML 1.1, which end a comment for the parser and are no line break for editors."""


def in_plain_text(text: str, *, key: bool = False) -> tuple[int, str] | None:
    """Index and message of the first odd character in a key or value without quotes; None if there is none."""
    for pattern in (_AFTER_SIGN, *((_WIDE_COLON,) if key else ())):
        if match := pattern.match(text):
            return match.start(1), _message(match[1])
    if match := _ENDS.search(text) or _HIDDEN.search(text):
        return match.start(), _message(match[0])
    if _QUOTED.fullmatch(text):
        return 0, _message(text[0])
    return None


def before_error(lines: Sequence[str], last: int) -> tuple[int, int, str] | None:
    """Line and column from 1, and message, of the last odd character in the lines up to `last`; None without one."""
    for number in range(min(last, len(lines)), 0, -1):
        line = lines[number - 1]
        for match in _IN_LINE.finditer(line):
            at = match.end() - 1
            if line[at] in _BREAKS or not _is_text(line[:at]):
                return number, at + 1, _message(line[at])
    return None


def _is_text(before: str) -> bool:
    """Whether a place is in a comment or in quotes, roughly."""
    comment = re.search(r"(^|\s)#", before)
    return comment is not None or any(before.count(quote) % 2 for quote in "\"'")


def _message(character: str) -> str:
    name = unicodedata.name(character, "control character").lower()
    name = f"{'an' if name[0] in 'aeio' else 'a'} {name} (U+{ord(character):04X})"
    if character == "\t":
        return "a tab after the colon; write a space"
    if character in OPENING + CLOSING:
        return f"{name}: curly quotes do not quote; write straight ones, \" or '"
    if character == "：":
        return f"{name}; write ':' and a space"
    if re.match(f"[{SPACES}]", character):
        return f"{name} where a space belongs; write a space"
    return f"{name}, which is invisible; remove it"
