"""A bench whose arm and balance are reached over their wires, be they hardware or virtual: one pour after the other."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from actors.arm.joint_path import PourPath
from actors.arm.spec import UrArmSpec
from actors.balance.actor import DeviceBalance
from actors.balance.placement import Weighed
from actors.balance.spec import BalanceSpec
from actors.bench.questions import Questions
from actors.bench.reality import Reality
from actors.bench.wired_arm import WiredArm
from actors.bench.wired_pour import Rooms, WiredPour
from actors.protocols import InvalidActionError, Notice, ProgressCallback
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement
from sim_engine.task import Scene

Plan = Callable[[Scene, Action], PourPath]
"""Checks a pour and plans its whole path; raises `InvalidActionError`."""


@dataclass(frozen=True)
class WiredSpec:
    """What of a laboratory's settings a pour needs.

    Attributes:
        mode: 'virtual' or 'hardware'.
        operator_time: that the operator is expected to take for one pour [s of bench time], for the progress bar.
    """

    mode: str
    arm: UrArmSpec
    balance: BalanceSpec
    operator_time: float


class WiredBench:
    """`Bench` over wires. Nothing moves before everything was checked, weighed and confirmed.

    Args:
        spec: settings.
        arm: its driver.
        balance: its driver; None where the operator types all weights.
        questions: to the operator.
        plan: checks and plans.
        reality: what becomes of the liquid on a virtual bench; None where that is nature's affair.
        tell: takes notices.
    """

    def __init__(
        self,
        spec: WiredSpec,
        arm: WiredArm,
        balance: DeviceBalance | None,
        questions: Questions,
        *,
        plan: Plan,
        reality: Reality | None = None,
        tell: Callable[[Notice], None] = lambda notice: None,
    ) -> None:
        self._rooms = Rooms(
            spec.mode, spec.arm, spec.balance, spec.operator_time, arm, balance, questions, reality, tell
        )
        self.arm, self.balance, self.reality = arm, balance, reality
        self._plan = plan
        self._known: dict[str, dict[str, Weighed]] = {}
        self._one_pour = asyncio.Lock()

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'."""
        return self._rooms.mode

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None
    ) -> PourMeasurement:
        """See `Bench.pour`. Cancelling stops the arm.

        Raises:
            InvalidActionError: refused before anything moved, and before anybody was asked.
            NotPouredError: it did not begin.
            UnknownPourError: it began, and did not go as it should.
        """
        async with self._one_pour:
            path = await asyncio.to_thread(self._checked, scene, action)
            pour = WiredPour(
                self._rooms, scene, action, path, seed=seed, known=self._known.get(scene.pourer.name), progress=progress
            )
            try:
                return await pour.run()
            finally:
                self._known[scene.pourer.name] = pour.lasting

    def _checked(self, scene: Scene, action: Action) -> PourPath:
        try:
            return self._plan(scene, action)
        except ValueError as error:
            raise InvalidActionError(str(error)) from error
