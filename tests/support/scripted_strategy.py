"""A strategy that asks for what a test tells it to, and short ways to run it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, Literal

from orchestrator.learning.requests import Outcome, Pour, Request, Simulate, Slots
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Progress
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.records.states import State, check_transition
from orchestrator.runs.stages import StageDefinition
from tests.support.toy_campaign import SCENE, SPACE, THETA, ToyLaboratory, run_toy


def run(directory: Path, laboratory: ToyLaboratory | None = None, **arguments: Any) -> Any:
    return asyncio.run(run_toy(directory, laboratory, **arguments))


def states(directory: Path) -> list[str]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        entries = [entry.body for entry in journal.entries(kinds=[Kind.CAMPAIGN_STATE])]
    for body in entries:
        check_transition(State(body["before"]), State(body["after"]))
    return [body["after"] for body in entries]


def one_stage(strategy: Any) -> tuple[StageDefinition, ...]:
    return (StageDefinition("only", lambda results, seed: strategy, pours=True),)


class Scripted(StageResult):
    """What a script was told."""

    kind: Literal["scripted"] = "scripted"
    told: tuple[str, ...] = ()


class Script:
    """Asks for fixed requests as far as slots allow and remembers what it was told."""

    def __init__(self, *requests: Request) -> None:
        self.requests = list(requests)
        self.told: list[tuple[Request, Outcome]] = []
        self.count = len(requests)
        self.decisions: list[Any] = []

    @property
    def finished(self) -> bool:
        return len(self.told) == self.count

    def ask(self, slots: Slots) -> list[Request]:
        left = {Simulate: slots.simulations, Pour: slots.pours}
        asked = []
        while self.requests and left.get(type(self.requests[0]), 1) > 0:
            request = self.requests.pop(0)
            left[type(request)] = left.get(type(request), 1) - 1
            asked.append(request)
        return asked

    def tell(self, request: Request, outcome: Outcome) -> None:
        self.told.append((request, outcome))

    def progress(self) -> Progress:
        return Progress(len(self.told), self.count)

    def result(self) -> Scripted:
        return Scripted(told=tuple(type(outcome).__name__ for _, outcome in self.told))


def simulate(seed: int) -> Simulate:
    return Simulate("cup", SCENE.action(SPACE.decode([0.5, 0.5])), THETA, seed)


def pour(number: int = 1, scene: str = "cup") -> Pour:
    return Pour(scene, SCENE.action(SPACE.decode([0.5, 0.5])), number, seed=100 + number)
