"""Questions to the optimiser that are out, and what to do with their answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from actors.optimizer.questions import Suggestion, SuggestProblem
from orchestrator.requests import Failed, Outcome, Suggest, Suggested
from orchestrator.run_errors import LearningError
from orchestrator.strategies.trials import SeedStream


class OptimizerQueries:
    """Suggest requests with the continuation of each."""

    def __init__(self, seeds: SeedStream) -> None:
        self._seeds = seeds
        self._unissued: list[Suggest] = []
        self._then: dict[Suggest, Callable[[Suggestion], None]] = {}

    def put(self, problem: SuggestProblem, purpose: str, then: Callable[[Suggestion], None]) -> None:
        """Queue a question; its seed is drawn here."""
        request = Suggest(replace(problem, seed=self._seeds.next()), purpose)
        self._unissued.append(request)
        self._then[request] = then

    def issue(self) -> list[Suggest]:
        """The questions not asked yet."""
        issued, self._unissued = self._unissued, []
        return issued

    @property
    def out(self) -> bool:
        """Some answer is waited for."""
        return bool(self._then)

    def answer(self, request: Suggest, outcome: Outcome) -> None:
        """Go on with an answer.

        Raises:
            ValueError: it was not asked for.
            LearningError: there is no answer: without one there is nothing sensible to try.
        """
        then = self._then.pop(request, None)
        if then is None:
            raise ValueError(f"this question was not asked, or has been answered already (purpose {request.purpose!r})")
        if not isinstance(outcome, Suggested):
            reason = outcome.reason if isinstance(outcome, Failed) else f"unexpected outcome {type(outcome).__name__}"
            raise LearningError(f"the optimiser has no answer to {request.purpose!r}: {reason}")
        then(outcome.suggestion)
