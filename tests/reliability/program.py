"""The program itself, struck at every write of its journal. The bench is one of numbers; so are the simulators."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from actors.optimizer_actor import Proposer
from sim_engine.outcome import PourMeasurement
from tests.reliability.case import AHEAD, BACK, FULL, KILLED, KILLED_AFTER, STOPPED, Case, every
from tests.reliability.rig import Life, Rig
from tests.support.toy_campaign import ToyBench, ToyLaboratory


class LoggingBench(ToyBench):
    """Writes down every pour that it makes, whoever dies afterwards."""

    def __init__(self, life: Life) -> None:
        super().__init__()
        self._life = life

    async def pour(self, *arguments: Any, **named: Any) -> Any:
        measured = as_shown(await super().pour(*arguments, **named))
        with (self._life.place / "poured").open("a", encoding="utf-8") as file:
            file.write(f"{named['seed']}\n")
        return measured


def as_shown(measured: PourMeasurement) -> PourMeasurement:
    """Masses as a balance shows them, to a tenth of a gram: one that is typed is the same to the last bit."""
    loaded, spilled, retained = (
        float(f"{1e3 * mass:.1f}") * 1e-3 for mass in (measured.loaded, measured.spilled, measured.retained)
    )
    return PourMeasurement(loaded, spilled, retained, measured.notes)


class Optimizer:
    """The optimiser itself, in this process."""

    async def suggest(self, problem: Any) -> Any:
        return Proposer().suggest(problem)


class ProgramRig(Rig):
    """C4 on weighed pours, then D3, with the real strategies, optimiser, scheduler and journal."""

    target = "program"

    def cases(self) -> list[Case]:
        faults = (KILLED, KILLED_AFTER, STOPPED, FULL, AHEAD, BACK)
        return [case for fault in faults for case in every(self.target, fault, self.points)]

    @contextlib.asynccontextmanager
    async def laboratory(self, life: Life) -> AsyncIterator[Any]:
        yield ToyLaboratory(bench=LoggingBench(life), optimizer=Optimizer())  # type: ignore[arg-type]
