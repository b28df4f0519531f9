"""The states of a campaign and the allowed transitions."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of a campaign."""

    QUEUED = "queued"
    """Created; nothing started."""
    PREPARING = "preparing"
    """The laboratory is being opened; a resumed strategy is being replayed."""
    RUNNING = "running"
    """Stages are running."""
    PAUSING = "pausing"
    """A pause was requested: simulations are dropped, a pour that has begun is finished and weighed."""
    PAUSED = "paused"
    """Paused without loss; can be resumed."""
    WAITING_FOR_OPERATOR = "waiting for operator"
    """A question to the operator is open."""
    STOPPING = "stopping"
    """A second stop was requested: everything is dropped at once, including the running pour."""
    FINISHED = "finished"
    """All stages are closed."""
    FAILED = "failed"
    """An error that software can't fix; can be resumed after the cause is fixed."""
    UNKNOWN = "unknown"
    """A pour had started and its outcome is unknown; the operator reports it on resume."""


TRANSITIONS: dict[State, frozenset[State]] = {
    State.QUEUED: frozenset({State.PREPARING}),
    State.PREPARING: frozenset({State.RUNNING, State.WAITING_FOR_OPERATOR, State.PAUSED, State.FAILED, State.UNKNOWN}),
    State.RUNNING: frozenset({State.PAUSING, State.FINISHED, State.FAILED, State.UNKNOWN, State.PAUSED}),
    State.PAUSING: frozenset({State.PAUSED, State.STOPPING, State.FAILED, State.UNKNOWN}),
    State.STOPPING: frozenset({State.PAUSED, State.FAILED, State.UNKNOWN}),
    State.WAITING_FOR_OPERATOR: frozenset({State.PREPARING, State.PAUSED, State.FAILED, State.UNKNOWN}),
    State.PAUSED: frozenset({State.PREPARING}),
    State.UNKNOWN: frozenset({State.PREPARING}),
    State.FAILED: frozenset({State.PREPARING}),
    State.FINISHED: frozenset(),
}
"""Allowed transitions from each state.

RUNNING → PAUSED or UNKNOWN is written by the next process if it finds a run whose process died.
"""

RESTING = frozenset({State.QUEUED, State.PAUSED, State.UNKNOWN, State.FAILED, State.FINISHED})
"""States in which a run may be left. Any other state in a journal without a writer means that its process died."""


def check_transition(before: State, after: State) -> None:
    """Raises RuntimeError unless the table allows the change."""
    if after not in TRANSITIONS[before]:
        allowed = ", ".join(sorted(TRANSITIONS[before])) or "nothing"
        raise RuntimeError(f"a campaign can't go from {before} to {after}; from {before} it may go to {allowed}")
