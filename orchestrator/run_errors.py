"""The base of what may end a run, and the exit codes that people and scripts see."""

from __future__ import annotations

from sim_engine.errors import DecantError


class RunError(DecantError):
    """A run can't begin or go on. The text is for the person who can mend it.

    Attributes:
        exit_code: of the command line: 1 failed, 3 an answer of a person is needed.
    """

    exit_code = 1


class LearningError(RunError):
    """What was weighed and simulated is not enough to learn from; the text says what is missing."""
