"""Any PyLabRobot scale as a balance: a plug-in for the group `decant.balances`. It needs PyLabRobot 0.2.

In the laboratory file:

    balance: {kind: pylabrobot, scale: "my_lab.devices:lvk_scale"}

where `lvk_scale` is a function without arguments that returns a `pylabrobot.scales.Scale`. A PyLabRobot scale returns
a bare number, without a flag of stability and a time. A thread therefore reads it all the time, and a weight counts
when the readings of one `span` agree. A scale whose filter is slower than that may be taken for settled too early: set
a larger `span`.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import math
import threading
import time
from collections import deque
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

from decant.plugins import BalanceKind, BalanceSettings, LaboratoryError, Quantity, ReferenceLostError, Text, Weight

ANSWER = 5.0
"""Longest time for one call to the scale [s]; then the connection is lost."""

PAUSE = 0.05
"""Time between two readings [s]."""


class PylabrobotSettings(BalanceSettings):
    """A scale of PyLabRobot."""

    kind: Literal["pylabrobot"] = "pylabrobot"
    """A scale of PyLabRobot."""

    scale: Text = "my_lab.devices:scale"
    """Function that returns the scale: module:function."""

    step: Annotated[float, Quantity("kg", "0.01 g", 0.0, 0.01, positive=True)] = 1e-5
    """Step of its display."""

    span: Annotated[float, Quantity("s", "1 s", 0.1, 60.0)] = 1.0
    """Time in which readings must agree."""

    deadline: Annotated[float, Quantity("s", "20 s", 1.0, 600.0)] = 20.0
    """Longest wait for a stable weight."""


class PylabrobotKind(BalanceKind[PylabrobotSettings]):
    """Scales of PyLabRobot."""

    settings = PylabrobotSettings

    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """See `BalanceSettings.driver`."""
        return PylabrobotScale, (self.spec, name)


class PylabrobotScale:
    """The driver; see `decant.plugins.BalanceDriver`."""

    def __init__(self, spec: PylabrobotSettings, name: str = "pylabrobot") -> None:
        self._spec, self._name = spec, name
        self._scale: Any = None
        self._now: dict[str, Any] = {}
        self._readings: deque[tuple[float, float]] = deque(maxlen=1000)
        self._changed = threading.Condition()
        self._interrupted = threading.Event()
        self._lost, self._problem = False, "not connected yet"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._reading: asyncio.Task[None] | None = None

    def connect(self) -> str:
        """See `BalanceDriver.connect`."""
        self._settled("connect", kept=True, still=False)
        return f"{self._name}: {type(self._scale.backend).__name__} of PyLabRobot"

    def tare(self) -> None:
        """See `BalanceDriver.tare`."""
        self._settled("tare", kept=True)
        assert self._loop is not None
        try:
            asyncio.run_coroutine_threadsafe(self._tare(), self._loop).result(2.0 * ANSWER)
        except Exception as error:
            raise LaboratoryError(f"balance {self._name}: tare: {_text(error)}") from error
        rest = self._settled("tare", kept=True).mass
        if abs(rest) > 2.0 * self._spec.step:
            raise LaboratoryError(f"balance {self._name}: the tare had no effect, it shows {1e3 * rest:g} g")
        self._lost = False

    def weigh(self) -> Weight:
        """See `BalanceDriver.weigh`."""
        return self._settled("weigh", kept=False)

    def read(self) -> Weight:
        """See `BalanceDriver.read`."""
        with self._changed:
            if not self._readings:
                return Weight(math.nan, False, time.monotonic(), "lost", self._spec.step)
            moment, mass = self._readings[-1]
            stable = self._stable(since=-math.inf) is not None
        return Weight(mass, stable, moment, "stable" if stable else "unstable", self._spec.step, f"{1e3 * mass:g} g")

    def keep_reference(self) -> None:
        """See `BalanceDriver.keep_reference`."""
        self._lost = False

    def interrupt(self) -> None:
        """See `BalanceDriver.interrupt`."""
        self._interrupted.set()
        with self._changed:
            self._changed.notify_all()

    def resume(self) -> None:
        """See `BalanceDriver.resume`."""
        self._interrupted.clear()

    def close(self) -> None:
        """See `BalanceDriver.close`."""
        loop, thread, self._loop, self._thread = self._loop, self._thread, None, None
        if loop is not None and thread is not None and self._reading is not None:
            loop.call_soon_threadsafe(self._reading.cancel)
            thread.join(2.0 * ANSWER)

    # ---- waiting, in the caller's thread

    def _settled(self, what: str, *, kept: bool, still: bool = True) -> Weight:
        """Wait for a stable weight of readings from now on, or any reading; `kept`: also after a lost connection."""
        self._start()
        since, problem = time.monotonic(), ""
        with self._changed:
            while True:
                if self._interrupted.is_set():
                    raise LaboratoryError(f"balance {self._name}: interrupted")
                if self._lost and not kept:
                    raise ReferenceLostError(
                        f"balance {self._name}: the connection was lost since the last tare ({self._problem}). If it "
                        "stayed switched on, look whether it still shows the weight, and confirm; else tare it"
                    )
                found = self._stable(since) if still else next((r for r in self._readings if r[0] > since), None)
                if found is not None:
                    return Weight(found[1], still, found[0], "stable", self._spec.step, f"{1e3 * found[1]:g} g")
                problem = self._problem or "the weight does not settle; is something touching the tray?"
                waited = time.monotonic() - since
                if waited > self._spec.deadline or (self._scale is None and waited > ANSWER):
                    raise LaboratoryError(f"balance {self._name}: {what}: {problem}")
                self._changed.wait(0.1)

    def _stable(self, since: float) -> tuple[float, float] | None:
        """Time and median of the last readings, if they span the wanted time and agree within one step."""
        window: list[float] = []
        for moment, mass in reversed(self._readings):
            if moment <= since:
                return None
            window.append(mass)
            if max(window) - min(window) > self._spec.step * (1.0 + 1e-6):
                return None
            if len(window) >= 4 and self._readings[-1][0] - moment >= self._spec.span:
                return self._readings[-1][0], sorted(window)[len(window) // 2]
        return None

    # ---- reading, in a thread with an event loop

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name=self._name, daemon=True)
            self._thread.start()

    async def _run(self) -> None:
        self._loop, self._turn = asyncio.get_running_loop(), asyncio.Lock()
        self._reading = asyncio.create_task(self._read_on())
        with contextlib.suppress(asyncio.CancelledError):
            await self._reading
        await self._drop()

    async def _read_on(self) -> None:
        while True:
            try:
                if self._scale is None:
                    await self._open()
                async with self._turn:
                    grams = await asyncio.wait_for(self._scale.read_weight(**self._now), ANSWER)
                self._note((time.monotonic(), 1e-3 * grams), "")
            except (OSError, TimeoutError, EOFError) as error:
                self._lost = self._lost or self._scale is not None
                self._note(None, f"no connection: {_text(error)}")
                await self._drop()
            except Exception as error:  # overload, a damaged line: each backend has errors of its own
                self._note(None, _text(error))
            await asyncio.sleep(PAUSE)

    async def _open(self) -> None:
        scale = resolve_name(self._spec.scale)()
        await asyncio.wait_for(scale.setup(), ANSWER)
        # Without it, some backends wait for rest, and the display would stand still meanwhile.
        at_once = "timeout" in inspect.signature(scale.backend.read_weight).parameters
        self._now = {"timeout": 0} if at_once else {}
        self._scale = scale

    async def _tare(self) -> None:
        async with self._turn:
            await asyncio.wait_for(self._scale.tare(), ANSWER)
            with self._changed:
                self._readings.clear()

    async def _drop(self) -> None:
        scale, self._scale = self._scale, None
        if scale is not None:
            with contextlib.suppress(Exception):
                await asyncio.wait_for(scale.stop(), ANSWER)

    def _note(self, reading: tuple[float, float] | None, problem: str) -> None:
        with self._changed:
            if reading is None:
                self._readings.clear()
            else:
                self._readings.append(reading)
            self._problem = problem
            self._changed.notify_all()


def _text(error: BaseException) -> str:
    return str(error) or type(error).__name__
