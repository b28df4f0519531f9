"""Lines of the form `command status value unit`, which KCP and MT-SICS share.

Sources: Mettler-Toledo AL/AB and AT operating instructions (`S S`, `S I`, `S +`, `S -`, commands I0 … TAC); Kern
CKE-BA-e-2132 and KIB-TM-ZB-e-1913 for the same of KCP; `S D`, `T S`, `Z A`, `TAC A` as drivers for such balances meet
them. Whether every KCP balance answers `T` with a weight (`T S`) or with `T A` could not be found out: both are
understood.
"""

from __future__ import annotations

import re

from actors.balance.dialects.dialect import END, number_in, text_of
from actors.balance.reading import Acknowledgement, Answer, FrameError, Reading, Reply, Status

WEIGHTS = {"S": Status.STABLE, "D": Status.UNSTABLE}
STATES = {"I": Status.BUSY, "+": Status.OVER, "-": Status.UNDER, "L": Status.ERROR}
_LETTERS = {Status.STABLE: "S", Status.UNSTABLE: "D", Status.BUSY: "I", Status.OVER: "+", Status.UNDER: "-"}
ANSWERS = {"A": Answer.DONE, "S": Answer.DONE, "D": Answer.DONE, "I": Answer.BUSY, "+": Answer.OVER,
           "-": Answer.UNDER, "L": Answer.REFUSED}  # fmt: skip
REFUSALS = {
    "ES": "syntax error: it does not know the command",
    "ET": "transmission error: it received damaged characters",
    "EL": "logical error: it can't carry the command out",
}

UNIT = re.compile(r"[A-Za-z%µ]{1,5}")
COMMAND = re.compile(r"(?:T|TI|TA|TAC|Z|ZI|I[0-9]{1,2}|@|MM|U)")


def decode(line: bytes) -> Reply:
    """Understand one line.

    Args:
        line: without its CR LF.

    Raises:
        FrameError: it is no such line.
    """
    text = text_of(line)
    if text is None:
        raise FrameError("not printable ASCII")
    words = text.split()
    if not words:
        raise FrameError("empty")
    if words[0] in REFUSALS and len(words) == 1:
        return Acknowledgement("", Answer.REFUSED, REFUSALS[words[0]])
    if words[0] == "S":
        return _weight(words)
    if not COMMAND.fullmatch(words[0]) or len(words) < 2 or (words[1] not in ANSWERS and words[1] != "B"):
        raise FrameError("neither a weight nor an answer to a command")
    if words[1] in WEIGHTS and len(words) > 2 and (len(words) != 4 or number_in(words[2]) is None):
        raise FrameError("the weight is damaged")
    return Acknowledgement(words[0], ANSWERS.get(words[1], Answer.BUSY), " ".join(words[2:]))


def _weight(words: list[str]) -> Reading:
    match words:
        case ["S", state] if state in STATES:
            return Reading(STATES[state], detail="it can't carry out the question" if state == "L" else "")
        case ["S", "S" | "D", "Error", number]:
            return Reading(Status.ERROR, detail=f"error {number}")
        case ["S", state, value, unit] if state in WEIGHTS:
            weight = number_in(value)
            if weight is not None and UNIT.fullmatch(unit):
                return Reading(WEIGHTS[state], weight, unit)
    raise FrameError("not a weight")


def encode(reading: Reading) -> bytes:
    """The line for a reading; the value right-aligned in ten characters.

    Raises:
        ValueError: these dialects have no such line.
    """
    if reading.status in _LETTERS:
        letter = _LETTERS[reading.status]
        weight = f" {reading.value!s:>10} {reading.unit}" if letter in WEIGHTS else ""
        return f"S {letter}{weight}".encode("ascii") + END
    if reading.status is Status.ERROR:
        return f"S S Error {reading.detail.removeprefix('error ') or '1b'}".encode("ascii") + END
    raise ValueError(f"no line says '{reading.status}'")
