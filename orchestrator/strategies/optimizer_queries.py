"""Pending queries to the optimiser and the continuation of each. It keeps no data and does not contact the
optimiser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from actors.optimizer.questions import Suggestion, SuggestionQuery
from orchestrator.requests import Failed, Outcome, Suggest, Suggested
from orchestrator.run_errors import LearningError
from orchestrator.strategies.trials import SeedStream


class OptimizerQueries:
    """Suggest requests, each with a function that handles its answer."""

    def __init__(self, seeds: SeedStream) -> None:
        self._seeds = seeds
        self._unissued: list[Suggest] = []
        self._then: dict[Suggest, Callable[[Suggestion], None]] = {}

    def put(self, query: SuggestionQuery, purpose: str, then: Callable[[Suggestion], None]) -> None:
        """Queue a query and draw its seed."""
        request = Suggest(replace(query, seed=self._seeds.next()), purpose)
        self._unissued.append(request)
        self._then[request] = then

    def issue(self) -> list[Suggest]:
        """Return the queries that have not been issued yet."""
        issued, self._unissued = self._unissued, []
        return issued

    @property
    def out(self) -> bool:
        """Whether an answer is pending."""
        return bool(self._then)

    def answer(self, request: Suggest, outcome: Outcome) -> None:
        """Pass an answer to the continuation of its request.

        Raises:
            ValueError: the request was not made or has been answered already.
            LearningError: the optimiser returned no suggestion, so that there is no next point to try.
        """
        then = self._then.pop(request, None)
        if then is None:
            raise ValueError(f"this query was not made, or has been answered already (purpose {request.purpose!r})")
        if not isinstance(outcome, Suggested):
            reason = outcome.reason if isinstance(outcome, Failed) else f"unexpected outcome {type(outcome).__name__}"
            raise LearningError(f"the optimiser has no answer to {request.purpose!r}: {reason}")
        then(outcome.suggestion)
