"""The base of Decant's errors, and why a pour can't be simulated. Light: importing this starts nothing."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class DecantError(Exception):
    """Base of all errors that Decant's public functions raise on purpose; the text is for the user.

    Errors of files that can't be opened, read or written remain Python's (`OSError`).
    """


class InvalidArgumentError(DecantError, ValueError):
    """An argument of a public function can't be used; the text says which, and what would be right."""


class InvalidSceneError(DecantError, ValueError):
    """The pour can't be made at all: the vessels touch, or the load does not fit. Nothing was simulated."""


class SimulationCancelled(Exception):  # noqa: N818 - a message, not a fault
    """Nobody waits for this simulation any more."""


def did_you_mean(word: str, known: Iterable[str]) -> str | None:
    """The known word that a misspelt one most resembles, if any does."""
    candidates = list(known)
    matches = difflib.get_close_matches(word, candidates, n=1, cutoff=0.6)
    if matches:
        return matches[0]
    lowered = {candidate.lower(): candidate for candidate in candidates}
    matches = difflib.get_close_matches(word.lower(), list(lowered), n=1, cutoff=0.6)
    return lowered[matches[0]] if matches else None
