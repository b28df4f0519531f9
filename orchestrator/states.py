"""The states of a campaign and the only ways from one to another."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """What a campaign is doing."""

    QUEUED = "queued"
    """Written down; nothing started."""
    PREPARING = "preparing"
    """The laboratory is being opened; a resumed strategy is being replayed."""
    RUNNING = "running"
    """Strategies ask and are told."""
    PAUSING = "pausing"
    """Asked to pause: simulations are dropped, a pour that has begun is finished and weighed."""
    PAUSED = "paused"
    """At rest with nothing lost; may be resumed."""
    WAITING_FOR_OPERATOR = "waiting for operator"
    """A question to a person is open."""
    STOPPING = "stopping"
    """Asked twice: everything is dropped at once, the running pour too."""
    FINISHED = "finished"
    """All stages are closed."""
    FAILED = "failed"
    """Something that software can't mend; may be resumed once it is mended."""
    UNKNOWN = "unknown"
    """A pour had started and nobody knows what came of it; resuming asks."""


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
"""From each state, where it may go. RUNNING → PAUSED or UNKNOWN directly is what the next process writes when it finds
a run whose own process died without a word."""

RESTING = frozenset({State.QUEUED, State.PAUSED, State.UNKNOWN, State.FAILED, State.FINISHED})
"""States in which a run may be left: any other, found in a journal that nobody writes, means that its process died."""


class TransitionError(RuntimeError):
    """A change of state that the table does not allow: a defect in the program."""


def check_transition(before: State, after: State) -> None:
    """Raises TransitionError unless the table allows the change."""
    if after not in TRANSITIONS[before]:
        allowed = ", ".join(sorted(TRANSITIONS[before])) or "nothing"
        raise TransitionError(f"a campaign can't go from {before} to {after}; from {before} it may go to {allowed}")
