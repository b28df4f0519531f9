"""The base of Decant's errors, and the errors of simulated pours. This module has no slow imports."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class DecantError(Exception):
    """Base of all errors that Decant's public functions raise deliberately; the text is for the user.

    Errors of files that cannot be opened, read or written remain Python's (`OSError`).

    Attributes:
        exit_code: of the command line: 1 failed, 2 bad input, 3 an answer of the operator is needed.
    """

    exit_code = 2


class InvalidArgumentError(DecantError, ValueError):
    """An argument of a public function is invalid; the text names it and a valid value."""


class InvalidSceneError(DecantError, ValueError):
    """The pour is impossible: the vessels touch, or the load does not fit. Nothing was simulated."""


class EngineError(DecantError, RuntimeError):
    """The package that compiles the solver cannot be used; the text gives the remedy."""


class WrongOutcomeError(EngineError):
    """The first pour of an engine differs from its stored outcome: every other outcome could be wrong, too."""

    exit_code = 1


class SimulationCancelled(Exception):  # noqa: N818 - a notification, not an error
    """The simulation was cancelled, because its result is not needed any more."""


def reason_of(error: BaseException) -> str:
    """The text of an error for the user: complete if it was raised deliberately; a defect's has its type before it."""
    name, text = type(error).__name__, str(error)
    return text if isinstance(error, DecantError) and text else f"{name}: {text}" if text else name


def did_you_mean(word: str, known: Iterable[str]) -> str | None:
    """The known word that is most similar to a misspelt one, if any is."""
    candidates = list(known)
    matches = difflib.get_close_matches(word, candidates, n=1, cutoff=0.6)
    if matches:
        return matches[0]
    lowered = {candidate.lower(): candidate for candidate in candidates}
    matches = difflib.get_close_matches(word.lower(), list(lowered), n=1, cutoff=0.6)
    return lowered[matches[0]] if matches else None


def shown_path(path: Path) -> str:
    """A path for messages: relative to the working directory if it lies below it."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
