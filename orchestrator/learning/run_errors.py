"""Base classes of errors that end a run, with the exit codes of the command line."""

from __future__ import annotations

from sim_engine.errors import DecantError


class RunError(DecantError):
    """A run can't begin or continue. The text is for the user who can fix the cause."""

    exit_code = 1


class LearningError(RunError):
    """There are too few measurements or simulations to learn from; the text names the missing data."""
