"""Replay of a stage from the journal, to resume an interrupted run.

`read_history` reads a stage into a `StageHistory`. `replay` then repeats the recorded sequence of ask and tell on a new
strategy, which must make the recorded requests again. `replayed_events` repeats the events for subscribers. Nothing
here runs a request.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from orchestrator.journal.codec import (
    canonical,
    decode_outcome,
    decode_request,
    decode_result,
    encode_request,
    first_difference,
)
from orchestrator.journal.journal import JournalReader, Kind
from orchestrator.requests import Answered, Ask, Outcome, Request, Slots
from orchestrator.run_errors import RunError
from orchestrator.runs.events import RequestFinished
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Strategy


class ReplayError(RunError):
    """The strategy's requests differ from those in the journal."""


@dataclass(frozen=True)
class AskedStep:
    """A call of `ask` with these slots, which returned the requests with these ids."""

    slots: Slots
    ids: tuple[int, ...]


@dataclass(frozen=True)
class ToldStep:
    """A call of `tell` with the outcome of a request."""

    id: int


@dataclass
class StageHistory:
    """The journal's content for one stage.

    Attributes:
        seed: seed of the stage; None if the stage was never opened.
        steps: asks and tells in their order.
        requests: JSON of each request by id, in the order in which they were made.
        outcomes: outcome by id, in the order in which the requests finished.
        finished_at: time at which each request finished, by id (seconds since 1970).
        pour_attempts: how often each pour was begun.
        withdrawn: pours whose last attempt ended without pouring anything.
        decisions: number of decisions written.
        result: result of a closed stage.
    """

    seed: int | None = None
    steps: list[AskedStep | ToldStep] = field(default_factory=list)
    requests: dict[int, dict[str, Any]] = field(default_factory=dict)
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    finished_at: dict[int, float] = field(default_factory=dict)
    pour_attempts: dict[int, int] = field(default_factory=dict)
    withdrawn: set[int] = field(default_factory=set)
    decisions: int = 0
    result: StageResult | None = None

    @property
    def ask_is_due(self) -> bool:
        """Whether the next step is `ask`: the last step was a tell, or there is no step yet."""
        return not self.steps or isinstance(self.steps[-1], ToldStep)

    def request(self, key: int) -> Request:
        """The request with this id."""
        return decode_request(self.requests[key])

    def unknown_pours(self) -> list[int]:
        """Pours that had begun and have no outcome."""
        return [key for key in self.pour_attempts if key not in self.outcomes and key not in self.withdrawn]

    def open_questions(self) -> dict[int, Ask]:
        """Questions to the operator without an answer."""
        asked = {key: self.request(key) for key, body in self.requests.items() if body["type"] == Ask.__name__}
        return {key: ask for key, ask in asked.items() if isinstance(ask, Ask) and key not in self.outcomes}


def read_history(journal: JournalReader, stage: str) -> StageHistory:
    """Read all entries of a stage.

    Raises:
        RunError: an outcome or a result can't be decoded.
    """
    history = StageHistory()
    for entry in journal.entries(stage=stage):
        body = entry.body
        match entry.kind:
            case Kind.STAGE_OPENED:
                history.seed = body["seed"]
            case Kind.ASKED:
                history.steps.append(AskedStep(Slots(body["simulations"], body["pours"]), tuple(body["ids"])))
            case Kind.REQUESTED:
                history.requests[body["id"]] = body["request"]
            case Kind.POUR_STARTED:
                history.pour_attempts[body["id"]] = body["attempt"]
                history.withdrawn.discard(body["id"])
            case Kind.POUR_WITHDRAWN:
                history.withdrawn.add(body["id"])
            case Kind.FINISHED | Kind.POUR_FINISHED:
                history.outcomes[body["id"]] = decode_outcome(body["outcome"])
                history.finished_at[body["id"]] = entry.t
            case Kind.OPERATOR_ANSWERED if "outcome" in body:
                history.outcomes[body["id"]] = decode_outcome(body["outcome"])
            case Kind.TOLD:
                history.steps.append(ToldStep(body["id"]))
            case Kind.DECISION:
                history.decisions += 1
            case Kind.STAGE_CLOSED:
                history.result = decode_result(body["result"])
    return history


def replayed_events(history: StageHistory, stage: str) -> Iterator[RequestFinished]:
    """The finished requests of the interrupted run as events, for the subscribers of the resumed run."""
    for key, outcome in history.outcomes.items():
        if isinstance(outcome, Answered):  # not a request to the laboratory
            continue
        yield RequestFinished(
            time=history.finished_at[key],
            stage=stage,
            replayed=True,
            id=key,
            request=history.request(key),
            outcome=outcome,
        )


def replay(strategy: Strategy, history: StageHistory, stage: str) -> dict[int, Request]:
    """Bring a new strategy to the state at the end of the journal.

    Returns:
        The requests whose outcome the strategy has not received, by id, in the order in which they were made.

    Raises:
        ReplayError: the strategy's requests differ from those in the journal.
    """
    undelivered: dict[int, Request] = {}
    for step in history.steps:
        if isinstance(step, ToldStep):
            strategy.tell(undelivered.pop(step.id), history.outcomes[step.id])
            continue
        requests = strategy.ask(step.slots)
        for key, request in zip(step.ids, requests, strict=False):
            _check_same(history.requests[key], encode_request(request), key, stage)
            undelivered[key] = request
        if len(requests) != len(step.ids):
            raise ReplayError(
                f"stage {stage}: the journal has {len(step.ids)} request(s) from {step.ids[:1] or 'none'} on, "
                f"the replayed strategy asks for {len(requests)}. {_ADVICE}"
            )
    return undelivered


_ADVICE = (
    "The program or its numerical libraries have changed since the run began; go on with the versions written in "
    "versions.json beside the journal, or begin a new run"
)


def _check_same(written: dict[str, Any], now: dict[str, Any], key: int, stage: str) -> None:
    if canonical(written) == canonical(now):
        return
    # A field that was added later, with a default that changes nothing, does not make the request different.
    if canonical(encode_request(decode_request(written))) != canonical(now):
        raise ReplayError(
            f"stage {stage}: request {key} differs from the journal's at {first_difference(written, now)}. {_ADVICE}"
        )
