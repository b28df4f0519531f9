"""The bench: an arm, a balance and somebody beside them, be they hardware, virtual or numbers. One pour at a time."""

from __future__ import annotations

import asyncio
from typing import Any

from actors.arm.protocol import PlannedPour
from actors.balance.masses import Weighed
from actors.bench.consent import Setup
from actors.bench.procedure import PourProcedure
from actors.protocols import InvalidActionError, ProgressCallback
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement
from sim_engine.task import Scene


class PouringBench:
    """`Bench`. Nothing moves before everything was checked, weighed and confirmed.

    Args:
        setup: arm, balance, operator, and what happens around them.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.arm, self.balance, self.nature = setup.arm, setup.balance, setup.nature
        self._known: dict[str, dict[str, Weighed]] = {}
        self._one_at_a_time = asyncio.Lock()

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'."""
        return self._setup.mode

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None
    ) -> PourMeasurement:
        """See `Bench.pour`. Cancelling stops the arm.

        Raises:
            InvalidActionError: refused before anything moved, and before anybody was asked.
            NotPouredError: it did not begin.
            UnknownPourError: it began, and did not go as it should.
        """
        async with self._one_at_a_time:
            path = await asyncio.to_thread(self._checked, scene, action)
            pour = PourProcedure(
                self._setup, scene, action, path, seed=seed, known=self._known.get(scene.pourer.name), progress=progress
            )
            try:
                return await pour.run()
            finally:
                self._known[scene.pourer.name] = pour.lasting

    def _checked(self, scene: Scene, action: Action) -> PlannedPour:
        try:
            return self._setup.spec.plan(scene, action)
        except ValueError as error:
            raise InvalidActionError(str(error)) from error
