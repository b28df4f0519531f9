"""Forecast of the simulations that later stages will request, so that they can run while the arm pours.

A strategy is a pure object with `ask` and `tell`, so it can be executed before its stage begins. Unknown inputs (pours
that are not made yet, θ* that is not found yet) are replaced by placeholders. With placeholders, only a stage's first
simulations are predicted, since these depend on seeds and actions alone: initial designs, and rivals of θ* on the
weighed pours. The prior of a later receiver needs no unknown input, and is executed up to its first pour.

No decision depends on a forecast: `request_executor.SpeculativeExecution` runs the simulations and discards those that
nobody requests, and the journal contains only what strategies requested.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from orchestrator.learning.requests import Ask, Outcome, Pour, Poured, Request, Simulate, Slots, Suggest
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import Results
from orchestrator.runs.request_executor import SpeculativeExecution
from orchestrator.runs.stages import StageDefinition, calibrated_theta, stage_seed
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement

MANY = 1000
"""Simulation slots offered to a stage when only its first requests are of interest."""

POURS_MADE_UP = 500
"""Maximum number of placeholder pours; a stage that needs more is not predicted."""


@dataclass(frozen=True)
class RequestForecast:
    """Executes the stages of a campaign speculatively, from a given stage on.

    Args:
        stages: the running stage, then all later ones.
        results: results of the earlier stages.
        seed: seed of the campaign.
        capacity: logical slots for simulations.
        speculation: runs the predicted simulations.
        suggest: queries the optimiser.
    """

    stages: Sequence[StageDefinition]
    results: Results
    seed: int
    capacity: int
    speculation: SpeculativeExecution
    suggest: Callable[[Suggest], Awaitable[Outcome]]

    async def run(self) -> None:
        """Queue all predicted simulations; returns when nothing more can be predicted."""
        now, *later = self.stages
        results: dict[str, StageResult] = dict(self.results)
        placeholder = await self._placeholder_result(now)
        guessed = placeholder is not None
        unknown: list[SimulationParameters] = []
        if placeholder is not None:
            results[now.name] = placeholder
        for stage in later:
            strategy = await self._built(stage, results)
            if strategy is None:
                continue
            if guessed:
                await self._first(strategy, unknown)
            else:
                await self._until_a_pour(strategy)
            if stage.stand_in is not None:
                results[stage.name], guessed = stage.stand_in, True
                unknown.append(calibrated_theta(results).theta)

    async def _built(self, stage: StageDefinition, results: Results) -> Strategy | None:
        try:
            return await asyncio.to_thread(stage.build, results, stage_seed(self.seed, stage.name))
        except Exception:  # its input is unknown yet; a real problem is reported when the stage runs
            return None

    async def _placeholder_result(self, stage: StageDefinition) -> StageResult | None:
        """Result of a stage that only pours, with placeholder outcomes; None for any other stage."""
        strategy = await self._built(stage, self.results)
        if strategy is None:
            return None
        for number in range(POURS_MADE_UP):
            if strategy.finished:
                return strategy.result()
            requests = strategy.ask(Slots(0, 1))
            if not requests or not all(isinstance(request, Pour) for request in requests):
                return None
            for request in requests:
                strategy.tell(request, _placeholder_pour(number))
        return None

    async def _first(self, strategy: Strategy, unknown: Sequence[SimulationParameters]) -> None:
        """Queue all simulations that a strategy requests before its first outcome, except those with an unknown θ."""
        slots = self.capacity  # a strategy may choose its number of parallel simulations from its first slots
        while not strategy.finished:
            requests = strategy.ask(Slots(slots, 0))
            for request in requests:
                if isinstance(request, Simulate) and request.parameters not in unknown:
                    self.speculation.predict(request)
            questions = [request for request in requests if isinstance(request, Suggest)]
            if not questions and slots == MANY:
                return
            slots = MANY
            for question in questions:
                strategy.tell(question, await self.suggest(question))

    async def _until_a_pour(self, strategy: Strategy) -> None:
        """Queue all simulations before the first pour; outcomes are delivered in logical order, as in the stage."""
        pending: list[Request] = []
        while not strategy.finished:
            simulations = sum(isinstance(request, Simulate) for request in pending)
            requests = strategy.ask(Slots(max(self.capacity - simulations, 0), 1))
            if any(isinstance(request, Pour | Ask) for request in requests):
                return
            pending += requests
            for request in requests:
                if isinstance(request, Simulate):
                    self.speculation.predict(request)
            if not pending:
                return
            request = min(pending, key=lambda request: isinstance(request, Simulate))
            pending.remove(request)
            if isinstance(request, Suggest):
                strategy.tell(request, await self.suggest(request))
            elif isinstance(request, Simulate):
                outcome = await self.speculation.outcome(request)
                if outcome is None:
                    return
                strategy.tell(request, outcome)


def _placeholder_pour(number: int) -> Outcome:
    """An arbitrary outcome that varies with the number, because a regression needs different values."""
    return Poured(PourMeasurement(loaded=0.2, spilled=0.2 * (0.05 + 0.1 * (number % 7)), retained=0.002))
