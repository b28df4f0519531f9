"""A bench that pours wanted amounts with a pump or a tap; a balance stands under the receiver.

A dose is a large portion and a few small ones, each weighed. The first portion is so small that, with the doubt about
the pump's flow, an excess beyond the tolerance has a probability of 1 %. Each weight corrects the estimate of the flow,
which passes to the next dose. `PortionPlanner` decides the portions, `predict_pump_dose` predicts a dose, and
`PumpBench` is the bench.

Limitations: no pump was tried. The liquid in the tube behind a valve counts as delivered when the weight is stable.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceSettings
from actors.balance.scale_model import Load
from actors.bench.bench_operators import Hands, OperatorQuestions
from actors.bench.liquid_supply import LiquidSupply, PumpDevice, SpillWatch
from actors.dosing.dose_controller import DoseEnd
from actors.dosing.dose_series import DoseForecast, check_dose, source_of
from actors.dosing_settings import DosingSettings
from actors.interfaces import (
    DoseKnowledge,
    DoseProgress,
    DoseSource,
    DoseTarget,
    InvalidActionError,
    LaboratoryError,
    Notice,
    NotPouredError,
    OperatorQuestion,
    PourProgress,
    ProgressCallback,
    UnknownPourError,
)
from actors.liquid_devices import PumpSettings
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene

PRIOR = 0.1
"""Standard deviation of the logarithm of true over nominal flow of an unknown pump."""

DRIFT = 0.01
"""Standard deviation of its change from dose to dose."""

SCATTER = 0.01
"""Standard deviation of a portion, relative to it."""

SURE = 2.33
"""Standard deviations for a probability of 1 %."""

WEIGHING = 3.0
"""Time until the weight of a portion is stable, as predictions assume it [s]."""

LIGHTEST_RECEIVER = 5e-3
"""Smallest rise of the weight that counts as a receiver [kg]."""


@dataclass
class PortionPlanner:
    """Portions of a dose, and the estimate of the pump's flow.

    Attributes:
        mean, variance: of the logarithm of true over nominal flow.
        doses: number of doses that the estimate rests on.
    """

    mean: float = 0.0
    variance: float = PRIOR**2
    doses: int = 0

    @classmethod
    def after(cls, knowledge: DoseKnowledge | None) -> PortionPlanner:
        """The planner of the next dose of a series."""
        if knowledge is None:
            return cls()
        return cls(knowledge.onset_flow[1], knowledge.covariance[3] + DRIFT**2, knowledge.doses)

    def portion(self, missing: float, limit: float) -> float:
        """Nominal mass of the next portion [kg].

        Args:
            missing: mass that is missing [kg].
            limit: excess that may be exceeded with a probability of 1 % [kg].
        """
        doubt = math.sqrt(self.variance + SCATTER**2)
        return min(missing, (missing + limit) / (1.0 + SURE * doubt)) / math.exp(self.mean)

    def learn(self, nominal: float, weighed: float, deviation: float) -> None:
        """A portion was weighed.

        Args:
            nominal: mass of the portion at the nominal flow [kg].
            weighed: its weight [kg].
            deviation: standard deviation of the weight [kg].
        """
        if weighed <= 3.0 * deviation:
            return
        error = (deviation / weighed) ** 2 + SCATTER**2
        gain = self.variance / (self.variance + error)
        self.mean += gain * (math.log(weighed / nominal) - self.mean)
        self.variance *= 1.0 - gain

    def knowledge(self) -> DoseKnowledge:
        """For the next dose of the series: a flow factor, and no onset."""
        return DoseKnowledge((0.0, self.mean), (0.0, 0.0, 0.0, self.variance), None, 0.0, self.doses + 1)


def smallest_shortage(pump: PumpSettings, density: float, limit: float) -> float:
    """Shortage that is not topped up [kg].

    Args:
        pump: its settings.
        density: of the liquid [kg/m³].
        limit: accepted excess [kg].
    """
    return max(pump.smallest * density, 0.5 * limit)


def predict_pump_dose(
    scene: Scene,
    dose: DoseTarget,
    seed: int,
    pump: PumpSettings,
    dosing: DosingSettings,
    deviation: float,
    count: int = 200,
) -> DoseForecast:
    """Predict a dose of a pump whose flow is as uncertain as it is known.

    Args:
        scene: source vessel, receiver and liquid.
        dose: wanted amount.
        seed: of the prediction.
        pump: its settings.
        dosing: how often a dose is topped up.
        deviation: standard deviation of a weight [kg].
        count: number of simulated doses.

    Raises:
        InvalidActionError: see `check_dose`.
    """
    check_dose(scene, dose)
    source, density = source_of(scene, dose), scene.liquid.density
    rng = np.random.default_rng((seed, 33))
    enough = smallest_shortage(pump, density, dose.limit)
    amounts, durations, ends = np.zeros(count), np.zeros(count), Counter[DoseEnd]()
    for number in range(count):
        planner = PortionPlanner.after(source.knowledge)
        factor = math.exp(rng.normal(planner.mean, math.sqrt(planner.variance)))
        received = weighed = seconds = 0.0
        for _ in range(dosing.most_top_ups + 1):
            nominal = max(planner.portion(dose.amount - weighed, dose.limit), pump.smallest * density)
            moved = nominal * factor * rng.normal(1.0, SCATTER)
            received += moved
            seconds += nominal / (pump.flow * density) + WEIGHING
            before, weighed = weighed, received + rng.normal(0.0, deviation)
            planner.learn(nominal, weighed - before, math.sqrt(2.0) * deviation)
            if dose.amount - weighed <= enough:
                break
        amounts[number], durations[number] = received, seconds
        ends[DoseEnd.REACHED if dose.amount - weighed <= enough else DoseEnd.SHORT] += 1
    low, high = np.quantile(amounts, (0.05, 0.95))
    content = rng.normal(source.mass, source.deviation, count)
    return DoseForecast(
        float(amounts.mean()),
        (float(low), float(high)),
        float(durations.mean()),
        float(np.quantile(durations, 0.95)),
        float(np.mean(content >= dose.amount)),
        pump.flow * density,
        0.0,
        dict(ends),
    )


class PumpBench:
    """The `Bench` interface of a pump. One dose runs at a time.

    Args:
        mode: 'virtual' or 'hardware'.
        pump: pours.
        balance: under the receiver.
        balance_spec: its settings.
        questions: to the operator.
        supply: the source vessel.
        watch: the spill sensor; None if there is none.
        dosing: how often a dose is topped up.
        hands: move the things of a virtual bench; None on hardware.
        tell: receives notices.
    """

    def __init__(
        self,
        mode: str,
        pump: PumpDevice,
        balance: DeviceBalance,
        balance_spec: BalanceSettings,
        questions: OperatorQuestions,
        supply: LiquidSupply,
        watch: SpillWatch | None,
        dosing: DosingSettings,
        hands: Hands | None,
        tell: Callable[[Notice], None],
    ) -> None:
        self._mode, self._pump, self.balance, self._balance_spec = mode, pump, balance, balance_spec
        self._questions, self._supply, self._watch = questions, supply, watch
        self._dosing, self._hands, self._tell = dosing, hands, tell
        self._one_at_a_time = asyncio.Lock()
        self._stopped = self._begun = False
        self._zero = 0.0

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'."""
        return self._mode

    async def stop(self) -> None:
        """Stop the pump, and the dose with it."""
        self._stopped = True
        await self._pump.stop()
        await self._supply.interrupt()

    async def close(self) -> None:
        """Release all devices."""
        await self._pump.close()
        await self._supply.close()
        if self._watch is not None:
            await self._watch.close()
        with contextlib.suppress(LaboratoryError):
            await self.balance.release()

    async def pour(
        self,
        scene: Scene,
        action: Any,
        *,
        seed: int,
        progress: ProgressCallback | None = None,
        dose: DoseTarget | None = None,
    ) -> PourMeasurement:
        """See `Bench.pour`; only wanted amounts, and the action is not used. Cancelling stops the pump.

        Raises:
            InvalidActionError: no amount is wanted, or the dose is impossible.
            NotPouredError: nothing was poured.
            UnknownPourError: the amount in the receiver is unknown.
        """
        if dose is None:
            raise InvalidActionError("a pump pours wanted amounts only; write a 'dispense' section")
        check_dose(scene, dose)
        async with self._one_at_a_time:
            self._stopped = self._begun = False

            async def pour() -> PourMeasurement:
                return await self._guarded(scene, dose, seed, progress)

            return await (
                pour() if self._watch is None else self._watch.watched(pour, self._pump.stop, self._pump.stop)
            )

    async def _guarded(
        self, scene: Scene, dose: DoseTarget, seed: int, progress: ProgressCallback | None
    ) -> PourMeasurement:
        self._questions.take_log()
        try:
            return await self._dose(scene, dose, seed, progress)
        except asyncio.CancelledError as error:
            await self._halt()
            if self._begun:
                self._tell(Notice("warning", f"the dose was given up after it had begun; {await self._remaining()}"))
                raise
            raise NotPouredError("the dose was given up before it began; nothing was poured") from error
        except InvalidActionError:
            raise
        except LaboratoryError as error:
            await self._halt()
            text = f"{error}. Nothing was poured"
            if self._begun:
                text = f"{error}. It was not the dose that was asked for: {await self._remaining()}"
            raise (UnknownPourError if self._begun else NotPouredError)(text) from error

    async def _halt(self) -> None:
        """Stop pump and supply after any failure, also while this task is being cancelled."""

        async def halt() -> None:
            with contextlib.suppress(LaboratoryError):
                await self._pump.stop()
            await self._supply.interrupt()

        halting = asyncio.ensure_future(halt())
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.shield(halting)

    async def _remaining(self) -> str:
        with contextlib.suppress(LaboratoryError):
            await self._arrived()  # of a simulated pump that was lost nobody knows what it had moved
            await self.balance.device.revive()
            await self.balance.resume()
            weight = await self.balance.weigh()
            return f"the balance shows {1e3 * (weight.mass - self._zero):.2f} g in the receiver"
        return "the amount in the receiver is UNKNOWN"

    # ---- steps in order

    async def _dose(
        self, scene: Scene, dose: DoseTarget, seed: int, progress: ProgressCallback | None
    ) -> PourMeasurement:
        self._density = scene.liquid.density
        self._show(progress, "operator", dose, 0.0)
        await self.balance.device.revive()
        await self.balance.resume()
        await self.balance.connect()
        await self._pump.connect()
        await self._supply.connect()
        source = await self._prepared(scene, dose, seed)
        deviation = max(self._balance_spec.deviation, self._step)
        planner = PortionPlanner.after(source.knowledge)
        enough = smallest_shortage(self._pump.spec, self._density, dose.limit)
        received, portions, wet = 0.0, list[tuple[float, float]](), list[str]()
        begun = time.monotonic()
        while (missing := dose.amount - received) > enough and len(portions) <= self._dosing.most_top_ups and not wet:
            if self._stopped:
                raise LaboratoryError("the pump was stopped")
            self._show(progress, "dose", dose, received)
            nominal = max(planner.portion(missing, dose.limit), self._pump.spec.smallest * self._density)
            wet = await self._portion(nominal, (seed, len(portions)))
            before, received = received, (await self.balance.weigh()).mass - self._zero
            portions.append((nominal, received - before))
            if not wet:
                planner.learn(nominal, received - before, math.sqrt(2.0) * deviation)
        end = DoseEnd.REACHED.value if missing <= enough else DoseEnd.SHORT.value
        if wet:
            end = f"the table became wet: {', '.join(wet)}"
        elif -missing > dose.limit:
            end = "more than the tolerance"
        self._show(progress, "record", dose, received)
        left = replace(
            source, mass=max(source.mass - received, 0.0), deviation=math.hypot(source.deviation, deviation), fill=False
        )
        left = await self._supply.weighed(left) or left
        about: dict[str, Any] = {
            "wanted": dose.amount,
            "received": received,
            "spilled": None,  # nothing outside the receiver is weighed
            "end": end,
            "top_ups": max(len(portions) - 1, 0),
            "duration": (time.monotonic() - begun) * self._scale,
            "left": [left.mass, left.deviation],
            "knowledge": asdict(planner.knowledge()),
            "portions_g": [[round(1e3 * part, 4) for part in one] for one in portions],
        }
        spilled = 0.0
        if self._hands is not None:
            about["true"] = self._hands.contents.in_receiver
            spilled = self._hands.contents.on_tray
        notes = {"mode": self._mode, "dose": about, "operator": self._questions.take_log()}
        return PourMeasurement(source.mass, spilled, max(source.mass - received - spilled, 0.0), notes)

    async def _prepared(self, scene: Scene, dose: DoseTarget, seed: int) -> DoseSource:
        """Fill the source, and weigh the empty receiver. Returns the source with its present content."""
        source, hands = source_of(scene, dose), self._hands
        if hands is not None:
            if not source.fill and hands.contents.in_pourer <= 0.0:  # as an earlier run has left it
                hands.contents.in_pourer = source.mass
            hands.contents.on_tray = 0.0
        ready = None if source.fill else await self._supply.weighed(source) or source
        if ready is not None and ready.mass <= dose.amount + dose.limit:
            source, ready = replace(source, fill=True, mass=scene.liquid.mass, before=ready.mass), None
        if hands is not None:
            hands.prepare(source.mass, (seed, 52))
        clear = OperatorQuestion("Take everything off the balance, and wipe its pan.", "done", about="dose_cleared")
        if ready is None:
            ready = await self._supply.filled(source, self._density, seed)
        if ready is None:
            text = (
                f"Fill '{source.name}' with {1e3 * source.mass:.0f} g of {scene.liquid.name}, weighed, and put it at "
                "the inlet of the pump, its tube filled. Take everything off the balance."
            )
            clear = OperatorQuestion(text, "done", about="dose_source")
        await self._questions.ask(clear)
        if ready is None:
            ready = await self._supply.weighed(source) or source
        if ready.mass <= dose.amount:
            raise LaboratoryError(
                f"source {source.name} holds {1e3 * ready.mass:.1f} g after it was filled, and {1e3 * dose.amount:g} g "
                "are wanted; look at the balance under it"
            )
        empty = (await self.balance.weigh()).mass
        place, problem = f" {dose.position}" if dose.position else "", ""
        while True:
            text = f"Put the empty receiver{place} on the balance, under the outlet of the pump. Then take hands away."
            await self._questions.ask(OperatorQuestion(text, "done", problem, about="dose_receiver"))
            weight = await self.balance.weigh()
            if weight.mass - empty >= LIGHTEST_RECEIVER:
                self._zero, self._step = weight.mass, weight.step
                return ready
            problem = (
                f"the balance shows {1e3 * (weight.mass - empty):.2f} g more than before; a receiver weighs at least "
                f"{1e3 * LIGHTEST_RECEIVER:g} g"
            )

    async def _portion(self, mass: float, seed: tuple[int, ...]) -> list[str]:
        """Pump a nominal mass [kg]. Returns the places that the spill sensor has reported as wet meanwhile."""
        self._begun = True
        try:
            moved = await self._pump.move(mass / self._density, seed)
        except LaboratoryError:
            await self._arrived()
            if self._watch is None or not self._watch.wet or self._stopped:
                raise
        else:
            await self._arrived(moved)
        if self._watch is None:
            return []
        await self._watch.look()
        return list(self._watch.wet)

    async def _arrived(self, moved: float = 0.0) -> None:
        """Put what a simulated pump has moved [m³] into the receiver, and on the balance."""
        if self._hands is None:
            return
        contents, mass = self._hands.contents, self._density * (moved + await self._pump.moved())
        if mass <= 0.0:
            return
        missed = min(getattr(self._pump.spec, "missed", 0.0), mass) if contents.on_tray == 0.0 else 0.0
        contents.in_pourer -= mass
        contents.in_receiver += mass - missed
        contents.on_tray += missed
        await self.balance.put(Load((0.0,), (contents.carried,)))

    @property
    def _scale(self) -> float:
        return self._pump.spec.time_scale or 1.0

    def _show(self, progress: ProgressCallback | None, checkpoint: str, dose: DoseTarget, received: float) -> None:
        if progress is None:
            return
        share = {"operator": 0.0, "record": 1.0}.get(checkpoint, 0.2 + 0.7 * min(received / dose.amount, 1.0))
        phase = {"operator": "check", "record": "done"}.get(checkpoint, "pour")
        shown = DoseProgress(phase, dose.amount, received, 0.0, 0.0, received)
        progress(PourProgress(checkpoint, share, balance=received, stable=True, dose=shown))
