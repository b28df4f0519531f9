"""The weighings of one pour, step by step, as a bench calls them before and after its arm moves.

`Weighings` carries out the steps of `actors.balance.weighing_plan`, asks the operator where hands are needed, and
repeats a step after a fixable error.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Mapping

from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_interface import (
    BalanceError,
    CommandError,
    NotStableError,
    OutOfRangeError,
    ReferenceLostError,
    UnitError,
)
from actors.balance.balance_settings import BalanceSettings
from actors.balance.readings import typed_weight
from actors.balance.weighing_plan import (
    SURE,
    Weighing,
    WeighingStep,
    loaded_mass,
    measurement,
    weighing_uncertainty,
    weighings,
)
from actors.interfaces import OperatorQuestion
from sim_engine.outcome import PourMeasurement

MENDABLE = (NotStableError, OutOfRangeError, CommandError, UnitError)
"""Errors that the operator can fix at the balance before a retry; no data is lost."""

AGAIN = "The balance can't be used as it is. Fix it, and leave what is on it. Is it fixed, to be tried again?"


AskOperator = Callable[[OperatorQuestion], Awaitable[str]]
"""Asks the operator and awaits the answer; raises `LaboratoryError` if none comes, or if the pour is aborted."""


class Weighings:
    """The weighings of one pour.

    Args:
        spec: placement and device of the balance.
        balance: None if the operator types all weights.
        ask: asks the operator.
        known: weighings of an earlier pour with the same vessels that are still valid, see `lasting`.
        weighed: called at once for each weighing, with its key, so that no later failure can lose it.
        nominal: requested load [kg]; a pourer with another load is refilled before the pour.
    """

    def __init__(
        self,
        spec: BalanceSettings,
        balance: DeviceBalance | None,
        ask: AskOperator,
        known: Mapping[str, Weighing] | None = None,
        weighed: Callable[[str, Weighing], None] = lambda key, weight: None,
        nominal: float | None = None,
    ) -> None:
        self._spec, self._balance, self._ask, self._notify, self._nominal = spec, balance, ask, weighed, nominal
        self._known = dict(known or {})
        self._steps = weighings(spec.position, known=self._known, pourer_elsewhere=spec.pourer == "elsewhere")
        self._weighed: dict[str, Weighing] = {}

    @property
    def lasting(self) -> dict[str, Weighing]:
        """Weighings that remain valid for later pours with the same vessels."""
        once = {step.key: self._weighed[step.key] for step in self._steps if self._lasts(step)}
        return self._known | once

    @property
    def weighed(self) -> dict[str, Weighing]:
        """All weighings so far, including valid ones of earlier pours."""
        return self._known | self._weighed

    async def before(self, masses: Mapping[str, Weighing] | None = None) -> None:
        """Carry out all steps before the pour.

        Args:
            masses: weighings made otherwise; the steps up to the last of them are left out.

        Raises:
            BalanceError: an error that the operator could not fix, e.g. no connection.
            LaboratoryError: any error of `ask`.
        """
        for key, weighed in (masses or {}).items():
            self._note(key, weighed)
        first = max((i + 1 for i, step in enumerate(self._steps) if masses and step.key in masses), default=0)
        for step in self._steps[first : self._pour]:
            await self._do(step)

    async def at_once(self) -> None:
        """Carry out the weighings after the pour that need no hands, once and without questions.

        Used for an aborted pour, so that a weight is kept that may be lost later.

        Raises:
            BalanceError: the first weighing that failed.
        """
        for step in self._steps[self._pour + 1 :]:
            if step.do != "weigh" or step.hands:
                return
            if step.key not in self._weighed:
                await self._read(step)

    async def after(self) -> None:
        """Carry out all steps after the pour; raises as `before`."""
        for step in self._steps[self._pour + 1 :]:
            await self._do(step)

    def measurement(self, nominal: float | None = None) -> PourMeasurement:
        """Return the result of the weighings.

        Args:
            nominal: requested load [kg].

        Raises:
            BalanceError: the weighings are incomplete or inconsistent.
        """
        return measurement(self._spec.position, self.weighed, nominal=nominal, tolerance=self._spec.load_tolerance)

    @property
    def _pour(self) -> int:
        return next(i for i, step in enumerate(self._steps) if step.do == "pour")

    def _lasts(self, step: WeighingStep) -> bool:
        return step.when == "once" and step.key in self._weighed

    async def _do(self, step: WeighingStep) -> None:
        """Carry out one step. If hands are needed, ask the operator first; repeat until it succeeds.

        A typed weight that can hardly be right is asked for again; the same text confirms it.
        """
        problem, doubted, typed = "", "", step.by == "operator"
        while True:
            answer = ""
            if step.hands or problem:
                answer = await self._ask(
                    OperatorQuestion(step.put, "weight" if typed else "done", problem, about=step.key or step.about)
                )
            try:
                if typed:
                    self._note(step.key, self._typed(answer))
                else:
                    await self._read(step)
                problem = self._misfilled(step)
                if not problem and typed and answer != doubted:
                    problem, doubted = self._doubt(step, answer), answer
                if not problem:
                    return
            except (*MENDABLE, ValueError) as error:
                problem = str(error)
            except ReferenceLostError:
                raise  # the operator was already asked
            except BalanceError as error:
                question = OperatorQuestion(AGAIN, "yes or no", str(error), about="balance")
                if self._balance is None or not _is_yes(await self._ask(question)):
                    raise
                problem = ""

    def _misfilled(self, step: WeighingStep) -> str:
        """Return the problem with the load that was just weighed; '' if there is none."""
        if step.key != "pourer_full" or self._nominal is None:
            return ""
        loaded = loaded_mass(self._spec.position, self.weighed)
        if abs(loaded - self._nominal) <= self._spec.load_tolerance:
            return ""
        allowed = f"{1e3 * self._nominal:g} ± {1e3 * self._spec.load_tolerance:g} g"
        return f"{1e3 * loaded:.2f} g are in the pourer, but {allowed} are asked for; fill anew"

    def _doubt(self, step: WeighingStep, answer: str) -> str:
        """Return the reason why a weight that was just typed can hardly be right; '' if there is none."""
        before = self.weighed.get({"tray_after": "tray_before", "pourer_after": "pourer_empty"}.get(step.key, ""))
        typed = self.weighed[step.key]
        if before is None:
            return f"'{answer}' is not above 0 g" if step.key == "pourer_empty" and typed.mass <= 0.0 else ""
        loaded = loaded_mass(self._spec.position, self.weighed)
        slack = SURE * math.hypot(before.uncertainty, typed.uncertainty)
        if -slack <= typed.mass - before.mass <= loaded + slack:
            return ""
        load, when = ("tray", "before the pour") if step.key == "tray_after" else ("pourer", "when it was empty")
        least, most = 1e3 * before.mass, 1e3 * (before.mass + loaded)
        return (
            f"'{answer}' is {1e3 * typed.mass:g} g. The {load} was {least:g} g {when}, and {most - least:g} g were "
            f"loaded: {least:g} to {most:g} g are possible. Read it again; type the same text to keep it"
        )

    def _note(self, key: str, weighed: Weighing) -> None:
        self._weighed[key] = weighed
        self._notify(key, weighed)

    def _typed(self, answer: str) -> Weighing:
        typed = typed_weight(answer)
        return Weighing(typed.mass, weighing_uncertainty(typed.step, self._repeatability, tared=False))

    async def _read(self, step: WeighingStep) -> None:
        """Tare or weigh on the connected balance."""
        if self._balance is None:
            raise BalanceError(f"'{step.put}' needs a balance, and none is connected")
        if step.do == "tare":
            await self._balance.tare()
            return
        try:
            weight = await self._balance.weigh()
        except ReferenceLostError as error:
            question = OperatorQuestion(
                "Did the balance stay switched on, and does it still show this weight?",
                "yes or no",
                str(error),
                about="reference",
                hands=False,
            )
            if not _is_yes(await self._ask(question)):
                raise
            await self._balance.keep_reference()
            weight = await self._balance.weigh()
        self._note(step.key, Weighing(weight.mass, weighing_uncertainty(weight.step, self._repeatability)))

    @property
    def _repeatability(self) -> float:
        return self._spec.deviation


def _is_yes(answer: str) -> bool:
    return answer.strip().lower() in ("yes", "y")
