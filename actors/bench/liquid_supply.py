"""The source vessel and the spill sensor of a bench.

- `LiquidSupply` fills the source vessel with the refill device, by weight if a balance stands under it.
- `SpillWatch` runs a pour under the eyes of the spill sensor. While the table is wet, the operator has to wipe it, and
  nothing is poured.

The drivers are in `actors.liquid_devices`.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict, replace
from typing import Any

from actors.balance.balance_device import DeviceBalance
from actors.balance.scale_model import Load
from actors.bench.bench_operators import BenchContents, OperatorQuestions
from actors.interfaces import DoseSource, LaboratoryError, Notice, NotPouredError, OperatorQuestion
from actors.liquid_devices import PumpSettings, SourceSettings, SpillEvent, SpillSensorSettings
from actors.runtime.remote_object import Device
from sim_engine.outcome import PourMeasurement

ANSWER_DEADLINE = 60.0
"""Wall time within which a device must reply to a short call [s]; its process may still be starting."""

LOOK = 0.1
"""Wall time between two looks at the spill sensor during a pour [s]."""

PORTIONS = 3
"""Largest number of portions of a refill by weight."""


class PumpDevice:
    """A pump's driver behind a `Device`.

    Args:
        device: holds the driver.
        spec: its settings.
    """

    def __init__(self, device: Device, spec: PumpSettings) -> None:
        self.device, self.spec = device, spec

    async def connect(self) -> None:
        """Start the driver again if it was lost, and connect it."""
        await self.device.revive()
        await self.device.call("connect", deadline=ANSWER_DEADLINE)

    async def move(self, volume: float, seed: tuple[int, ...]) -> float:
        """Move a volume [m³]. Returns the true volume of a simulated pump; else 0.

        Args:
            volume: wanted [m³].
            seed: of a simulated pump's scatter.
        """
        method, amount = self.spec.request(volume)
        scale = self.spec.time_scale or math.inf
        if self.spec.simulates:
            await self.device.call("prepare", seed, deadline=ANSWER_DEADLINE)
        await self.device.call(method, amount, deadline=ANSWER_DEADLINE + 4.0 * volume / self.spec.flow / scale)
        return float(await self.device.call("moved", deadline=ANSWER_DEADLINE)) if self.spec.simulates else 0.0

    async def stop(self) -> None:
        """See `Pump.stop`."""
        await self.device.call("stop", deadline=ANSWER_DEADLINE, urgent=True)

    async def close(self) -> None:
        """See `Pump.close`."""
        with contextlib.suppress(LaboratoryError):
            await self.device.call("close", deadline=ANSWER_DEADLINE, urgent=True)


class LiquidSupply:
    """The source vessel of a bench.

    Args:
        spec: section `source` of the laboratory; None if it has none.
        balance: under the pourer where the refill device fills it; None if there is none.
        refill: fills the vessel; None if the operator does.
        contents: of a virtual bench; None on hardware.
        tell: receives notices.
    """

    def __init__(
        self,
        spec: SourceSettings | None,
        balance: DeviceBalance | None,
        refill: PumpDevice | None,
        contents: BenchContents | None,
        tell: Callable[[Notice], None],
    ) -> None:
        self._spec, self.balance, self._refill = spec or SourceSettings(), balance, refill
        self._contents, self._tell = contents, tell

    async def connect(self) -> None:
        """Connect the devices."""
        if self.balance is not None:
            await self.balance.device.revive()
            await self.balance.resume()
            await self.balance.connect()
        if self._refill is not None:
            await self._refill.connect()

    async def filled(self, source: DoseSource, density: float, seed: int) -> DoseSource | None:
        """Fill a source with the refill device. Returns the filled source; None if the operator has to fill it.

        The operator fills it if there is no refill device, or if the content of the vessel is unknown.

        Args:
            source: to be filled, to its `mass`.
            density: of the liquid [kg/m³].
            seed: of a simulated pump.

        Raises:
            LaboratoryError: the device has failed.
        """
        if self._refill is None:
            return None
        if source.before is None:
            return None
        missing = max(source.mass - source.before, 0.0)
        if missing > self._refill.spec.smallest * density:
            await self._move(missing, density, (seed, 61))
        self._tell(Notice("info", f"source {source.name}: refilled with {1e3 * missing:.0f} g"))
        deviation = math.hypot(source.deviation, self._spec.refill_error * missing)
        return replace(source, deviation=deviation, fill=False, before=None)

    async def top_up(self, mass: float, density: float, seed: int) -> bool:
        """Add a mass [kg] to the pourer under the outlet, by weight if a balance stands there.

        Returns whether there is a refill device for it.

        Raises:
            LaboratoryError: a device has failed.
        """
        if self._refill is None:
            return False
        await self.connect()
        smallest = self._refill.spec.smallest * density
        begin, missing = await self._weight(), mass
        for number in range(PORTIONS):
            await self._move(max(missing, smallest), density, (seed, 61, number) if number else (seed, 61))
            missing = 0.0 if begin is None else mass - (await self._weight() or 0.0) + begin
            if missing <= smallest:
                break
        return True

    async def _weight(self) -> float | None:
        """What the balance under the source shows [kg]; None if there is none."""
        if self.balance is None:
            return None
        if self._contents is not None:
            await self.balance.put(Load((0.0,), (self._contents.in_pourer,)))
        return (await self.balance.weigh()).mass

    async def _move(self, mass: float, density: float, seed: tuple[int, ...]) -> None:
        assert self._refill is not None
        moved = await self._refill.move(mass / density, seed)
        if self._contents is not None:
            self._contents.in_pourer += density * moved

    async def interrupt(self) -> None:
        """Stop the refill device and end a weighing; errors are suppressed."""
        with contextlib.suppress(LaboratoryError):
            if self._refill is not None:
                await self._refill.stop()
        with contextlib.suppress(LaboratoryError):
            if self.balance is not None:
                await self.balance.interrupt()

    async def close(self) -> None:
        """Release the devices."""
        if self._refill is not None:
            await self._refill.close()
        with contextlib.suppress(LaboratoryError):
            if self.balance is not None:
                await self.balance.release()


class SpillWatch:
    """Pours while a spill sensor watches the table.

    Args:
        device: holds the driver of the sensor.
        spec: its settings.
        questions: to the operator.
        tell: receives notices.
    """

    def __init__(
        self, device: Device, spec: SpillSensorSettings, questions: OperatorQuestions, tell: Callable[[Notice], None]
    ) -> None:
        self._device, self._spec, self._questions, self._tell = device, spec, questions, tell
        self._connected = False
        self._seen: list[SpillEvent] = []
        self.wet: dict[str, SpillEvent] = {}
        """Wet places by name, as far as they are known."""

    async def watched(
        self,
        pour: Callable[[], Awaitable[PourMeasurement]],
        safe: Callable[[], Awaitable[Any]],
    ) -> PourMeasurement:
        """Make a pour once the table is dry. Its notes get the events since the pour before as `spills`.

        A table that the pour has made wet is wiped before the next one, so that the outcome waits for nobody.

        Args:
            pour: makes it.
            safe: makes sure that nothing can move, before the operator reaches into the cell.

        Raises:
            NotPouredError: the table is not dry, or the sensor cannot be read; nothing was poured.
        """
        self._seen = []
        try:
            await self.look()
            await self._wiped(safe)
        except LaboratoryError as error:
            raise NotPouredError(f"{error}. Nothing was poured") from error
        async with self._following():
            measured = await pour()
        with contextlib.suppress(LaboratoryError):  # the pour counts; the next one begins with another look
            if self._spec.simulates:
                await self._device.call("spill", measured.spilled, deadline=ANSWER_DEADLINE)
            await self.look()
        if not self._seen:
            return measured
        return replace(measured, notes={**measured.notes, "spills": [asdict(event) for event in self._seen]})

    async def look(self) -> None:
        """Read the sensor now; also connects it.

        Raises:
            LaboratoryError: it cannot be read.
        """
        if not self._connected or await self._device.revive():
            await self._device.call("connect", deadline=ANSWER_DEADLINE)
            self._connected = True
        events: list[SpillEvent] = await self._device.call("events", deadline=ANSWER_DEADLINE, urgent=True)
        self._seen += events
        for event in events:
            if event.wet:
                self.wet[event.place] = event
                self._tell(Notice("warning", f"spill sensor: {event.place} is wet"))
            else:
                self.wet.pop(event.place, None)
                self._tell(Notice("note", f"spill sensor: {event.place} is dry"))

    async def _wiped(self, safe: Callable[[], Awaitable[Any]]) -> None:
        """Ask the operator to wipe what is wet, until the sensor reports that it is dry."""
        problem = ""
        while self.wet:
            places = ", ".join(self.wet)
            await safe()
            await self._questions.ask(
                OperatorQuestion(
                    f"The table is wet: {places}. Find out where the liquid comes from, and wipe it dry. Nothing is "
                    "poured before that.",
                    "done",
                    problem,
                    about="table_wet",
                    details={"places": places},
                )
            )
            if self._spec.simulates:
                await self._device.call("wipe", deadline=ANSWER_DEADLINE)
            await self.look()
            problem = f"the spill sensor still reports liquid: {', '.join(self.wet)}" if self.wet else ""

    @contextlib.asynccontextmanager
    async def _following(self) -> AsyncIterator[None]:
        over = asyncio.Event()

        async def follow() -> None:
            failed = False
            while not over.is_set():
                try:
                    await self.look()
                    failed = False
                except LaboratoryError as error:
                    if not failed:
                        self._tell(Notice("warning", f"spill sensor: {error}"))
                    failed = True
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(LOOK):
                        await over.wait()

        task = asyncio.create_task(follow())
        try:
            yield
        finally:
            over.set()  # not cancelled: events that were read would be lost
            await asyncio.gather(task, return_exceptions=True)

    async def close(self) -> None:
        """Release the sensor."""
        with contextlib.suppress(LaboratoryError):
            await self._device.call("close", deadline=ANSWER_DEADLINE, urgent=True)
