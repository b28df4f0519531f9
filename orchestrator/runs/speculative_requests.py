"""What later stages will ask to be simulated, found by acting them out beforehand.

A strategy is a pure object behind ask and tell, so it can be played through before its turn comes. Where a stage needs
what is not known yet, something made up stands in for it: pours that are still to be made, θ* that is still to be
found. Then only what comes first is foreseen, which depends on seeds and actions alone: initial designs, rivals of θ*
on the weighed pours. A later receiver's prior needs nothing that is unknown, and is played through to its first pour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from orchestrator.journal.stage_results import Results
from orchestrator.requests import Ask, Outcome, Pour, Poured, Request, Simulate, Slots, Suggest
from orchestrator.runs.request_executor import RequestExecutor
from orchestrator.runs.stages import StageDefinition, calibrated_theta, stage_seed
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Strategy
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement

MANY = 1000
"""Simulations that a stage may ask for at once where only its first requests are looked for."""

POURS_MADE_UP = 500
"""Pours after which a stage that is acted out with made-up ones is given up."""


@dataclass(frozen=True)
class RequestForecast:
    """Acts out the stages of a campaign from one of them on.

    Args:
        stages: the one that is running, then all later ones.
        results: of the stages before.
        seed: of the campaign.
        capacity: logical slots for simulations.
    """

    stages: Sequence[StageDefinition]
    results: Results
    seed: int
    capacity: int
    lanes: RequestExecutor

    async def run(self) -> None:
        """Have everything made that is foreseen; returns when there is nothing more to find out."""
        now, *later = self.stages
        results: dict[str, StageResult] = dict(self.results)
        made_up = self._acted_out(now)
        guessed = made_up is not None
        unknown: list[SimulationParameters] = []
        if made_up is not None:
            results[now.name] = made_up
        for stage in later:
            strategy = self._built(stage, results)
            if strategy is None:
                continue
            if guessed or stage.order == "completion":
                await self._first(strategy, unknown)
            else:
                await self._until_a_pour(strategy)
            if stage.stand_in is not None:
                results[stage.name], guessed = stage.stand_in, True
                unknown.append(calibrated_theta(results).theta)

    def _built(self, stage: StageDefinition, results: Results) -> Strategy | None:
        try:
            return stage.build(results, stage_seed(self.seed, stage.name))
        except Exception:  # it needs what nobody can know yet: whatever is wrong is reported when its turn comes
            return None

    def _acted_out(self, stage: StageDefinition) -> StageResult | None:
        """What a stage of nothing but pours comes to if they go somehow; None if it is no such stage."""
        strategy = self._built(stage, self.results)
        if strategy is None:
            return None
        for number in range(POURS_MADE_UP):
            if strategy.finished:
                return strategy.result()
            requests = strategy.ask(Slots(0, 1))
            if not requests or not all(isinstance(request, Pour) for request in requests):
                return None
            for request in requests:
                strategy.tell(request, _made_up_pour(number))
        return None

    async def _first(self, strategy: Strategy, unknown: Sequence[SimulationParameters]) -> None:
        """All that a strategy asks to be simulated before it is told of any, but for θ that are not known yet."""
        slots = self.capacity  # a strategy may take its width from the first slots that it is shown
        while not strategy.finished:
            requests = strategy.ask(Slots(slots, 0))
            for request in requests:
                if isinstance(request, Simulate) and request.parameters not in unknown:
                    self.lanes.ahead.foresee(request)
            questions = [request for request in requests if isinstance(request, Suggest)]
            if not questions and slots == MANY:
                return
            slots = MANY
            for question in questions:
                strategy.tell(question, await self._answer(question))

    async def _until_a_pour(self, strategy: Strategy) -> None:
        """All that comes before the first pour, told in logical order as it will be."""
        open_: list[Request] = []
        while not strategy.finished:
            simulations = sum(isinstance(request, Simulate) for request in open_)
            asked = strategy.ask(Slots(max(self.capacity - simulations, 0), 1))
            if any(isinstance(request, Pour | Ask) for request in asked):
                return
            open_ += asked
            for request in asked:
                if isinstance(request, Simulate):
                    self.lanes.ahead.foresee(request)
            if not open_:
                return
            request = min(open_, key=lambda request: isinstance(request, Simulate))
            open_.remove(request)
            if isinstance(request, Suggest):
                strategy.tell(request, await self._answer(request))
            elif isinstance(request, Simulate):
                outcome = await self.lanes.ahead.outcome(request)
                if outcome is None:
                    return
                strategy.tell(request, outcome)

    async def _answer(self, question: Suggest) -> Outcome:
        return await self.lanes.suggest(question, started=lambda: None, retrying=lambda text: None)


def _made_up_pour(number: int) -> Outcome:
    """A pour that went somehow, and not twice the same way: a regression has to make something of them."""
    return Poured(PourMeasurement(loaded=0.2, spilled=0.2 * (0.05 + 0.1 * (number % 7)), retained=0.002))
