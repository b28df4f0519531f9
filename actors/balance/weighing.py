"""The weighings of one pour, step by step, each asked for: what a bench calls before and after its arm moves."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping

from actors.balance.actor import DeviceBalance
from actors.balance.errors import (
    BalanceError,
    CommandError,
    NotStableError,
    OutOfRangeError,
    ReferenceLostError,
    UnitError,
)
from actors.balance.placement import Step, Weighed, measurement, weighing_uncertainty, weighings
from actors.balance.spec import BalanceSpec
from actors.balance.typed import typed_weight
from actors.operator import Question
from sim_engine.outcome import PourMeasurement

MENDABLE = (NotStableError, OutOfRangeError, CommandError, UnitError)
"""Errors that a person beside the balance can mend and have tried again; nothing is lost by it."""


Ask = Callable[[Question], Awaitable[str]]
"""Asks a person and awaits the answer; raises `LaboratoryError` where none comes, or the pour is given up."""


class Weighings:
    """Of one pour.

    Args:
        spec: where the balance stands.
        balance: None where the operator types all weights.
        ask: asks the operator.
        known: weighings of an earlier pour with the same vessels that still hold, see `lasting`.
    """

    def __init__(
        self, spec: BalanceSpec, balance: DeviceBalance | None, ask: Ask, known: Mapping[str, Weighed] | None = None
    ) -> None:
        self._spec, self._balance, self._ask = spec, balance, ask
        self._known = dict(known or {})
        self._steps = weighings(spec.placement, known=self._known, pourer_elsewhere=spec.pourer_elsewhere)
        self._weighed: dict[str, Weighed] = {}

    @property
    def lasting(self) -> dict[str, Weighed]:
        """Weighings that hold for later pours with the same vessels."""
        once = {step.key: self._weighed[step.key] for step in self._steps if self._lasts(step)}
        return self._known | once

    async def before(self) -> None:
        """All steps before the pour.

        Raises:
            BalanceError: what nobody beside the balance can mend, e.g. no connection.
            LaboratoryError: whatever `ask` raises.
        """
        for step in self._steps[: self._pour]:
            await self._do(step)

    async def after(self) -> None:
        """All steps after the pour; raises as `before`."""
        for step in self._steps[self._pour + 1 :]:
            await self._do(step)

    def measurement(self, nominal: float | None = None) -> PourMeasurement:
        """What the weighings say.

        Args:
            nominal: load that was asked for [kg].

        Raises:
            WeighingError: they are incomplete, or can't all be right.
        """
        return measurement(
            self._spec.placement, self._known | self._weighed, nominal=nominal, tolerance=self._spec.load_tolerance
        )

    @property
    def _pour(self) -> int:
        return next(i for i, step in enumerate(self._steps) if step.do == "pour")

    def _lasts(self, step: Step) -> bool:
        return step.when == "once" and step.key in self._weighed

    async def _do(self, step: Step) -> None:
        """One step; asked for where hands are needed, and again until it is done."""
        problem, typed = "", step.by == "operator"
        while True:
            answer = ""
            if step.hands or problem:
                answer = await self._ask(
                    Question(step.put, "weight" if typed else "done", problem, about=step.key or step.do)
                )
            try:
                if typed:
                    self._weighed[step.key] = self._typed(answer)
                else:
                    await self._read(step)
                return
            except (*MENDABLE, ValueError) as error:
                problem = str(error)

    def _typed(self, answer: str) -> Weighed:
        typed = typed_weight(answer)
        return Weighed(typed.mass, weighing_uncertainty(typed.step, self._repeatability, tared=False))

    async def _read(self, step: Step) -> None:
        """Tare or weigh on the balance here."""
        if self._balance is None:
            raise BalanceError(f"'{step.put}' needs a balance, and none is connected")
        if step.do == "tare":
            await self._balance.tare()
            return
        try:
            weight = await self._balance.weigh()
        except ReferenceLostError as error:
            question = Question(
                "Did the balance stay switched on, and does it still show this weight?",
                "yes or no",
                str(error),
                about="reference",
                hands=False,
            )
            if (await self._ask(question)).strip().lower() not in ("yes", "y"):
                raise
            await self._balance.keep_reference()
            weight = await self._balance.weigh()
        self._weighed[step.key] = Weighed(weight.mass, weighing_uncertainty(weight.step, self._repeatability))

    @property
    def _repeatability(self) -> float:
        return 0.0 if self._spec.serial is None else self._spec.serial.repeatability
