"""The machine: who works at what, the queue, seconds for each simulation, waits, what was dropped; log and status."""

from __future__ import annotations

from orchestrator.monitor import shapes
from orchestrator.monitor.outlet import Outlet
from orchestrator.report import style
from orchestrator.report.style import safe_name

PLACE = "/machine"

IDLE = "idle"

LOG = "/log"

STATUS = "/status"

OUTCOME = "/outcome"

_PURPOSES = {
    "calibrate": style.MEASURED,
    "prior": style.FALLING,
    "refine": style.GOOD,
    "evaluate": style.PREDICTED,
    "tilt": style.BEST,
    "idle": style.PALE,
}
"""Colours of lanes that have one of their own; others get Rerun's."""


class Machine:
    """Rows of the machine. For one thread.

    Args:
        outlet: where rows go.
    """

    def __init__(self, outlet: Outlet) -> None:
        import rerun as rr

        self._rr, self._outlet = rr, outlet
        self._simulators = 1
        self._slots: dict[int, int] = {}
        self._styled: set[str] = set()
        self._poured: float | None = None
        self._page = ""
        for name, label, colour in (
            ("load/busy", "simulators busy", style.MEASURED),
            ("load/queue", "simulations waiting", style.PREDICTED),
            ("seconds", "one simulation [s]", style.GOOD),
            ("wait", "arm waited before the pour [s]", style.BEST),
            ("dropped", "events that watchers missed", style.ESCAPED),
        ):
            points = name in ("seconds", "wait")
            looks = (
                rr.SeriesPoints(names=label, colors=shapes.rgb(colour), marker_sizes=4.0)
                if points
                else rr.SeriesLines(names=label, colors=shapes.rgb(colour), widths=2.5)
            )
            outlet.log(f"{PLACE}/{name}", looks, static=True)

    def opened(self, simulators: int, *, arm: bool) -> None:
        """The pool is so large, and there is an arm or not: nobody works yet."""
        self._simulators = max(simulators, 1)
        for name in (*(["arm"] if arm else []), "optimiser", *(f"simulator {n + 1}" for n in range(self._simulators))):
            self.lane(name, None)
        self._load()

    def simulation_started(self, key: int, purpose: str) -> None:
        """One was handed to the pool."""
        taken = set(self._slots.values())
        self._slots[key] = slot = next(i for i in range(len(taken) + 1) if i not in taken)
        if slot < self._simulators:
            self.lane(f"simulator {slot + 1}", purpose)
        self._load()

    def simulation_finished(self, key: int, seconds: float) -> None:
        """It came back, or not."""
        slot = self._slots.pop(key, None)
        if slot is not None and slot < self._simulators:
            self.lane(f"simulator {slot + 1}", None)
        if seconds > 0.0:
            self._number("seconds", seconds)
        self._load()

    def pour_started(self, now: float) -> None:
        """The arm is given a pour."""
        if self._poured is not None:
            self._number("wait", now - self._poured)

    def pour_finished(self, now: float) -> None:
        """It is over."""
        self._poured = now
        self.lane("arm", None)

    def lane(self, name: str, doing: str | None) -> None:
        """Somebody begins something, or (None) has ended it."""
        entity = f"{PLACE}/lanes/{safe_name(name)}"
        if entity not in self._styled:
            self._styled.add(entity)
            known = list(_PURPOSES)
            colours = [shapes.rgb(_PURPOSES[each]) for each in known]
            looks = self._rr.StateConfiguration(values=known, labels=known, colors=colours)
            self._outlet.log(entity, looks, static=True)
        self._outlet.log(entity, self._rr.StateChange(state=doing or IDLE))

    def dropped(self, count: int) -> None:
        """So many events were dropped so far."""
        self._number("dropped", count)

    def line(self, text: str, level: str = "info", source: str = "campaign") -> None:
        """A line of the log."""
        log = self._rr.TextLogLevel
        levels = {"info": log.INFO, "warning": log.WARN, "error": log.ERROR}
        self._outlet.log(f"{LOG}/{safe_name(source)}", self._rr.TextLog(text, level=levels.get(level, log.INFO)))

    def status(self, markdown: str) -> None:
        """What is going on, in large letters; replaces what was there before."""
        if markdown != self._page:
            self._page = markdown
            self._outlet.log(STATUS, self._rr.TextDocument(markdown, media_type="text/markdown"))

    def outcome(self, markdown: str) -> None:
        """How the run ended: the same at all times, wherever a viewer's time cursor is."""
        self._outlet.log(OUTCOME, self._rr.TextDocument(markdown, media_type="text/markdown"), static=True)

    def _load(self) -> None:
        running = len(self._slots)
        self._number("load/busy", min(running, self._simulators))
        self._number("load/queue", max(running - self._simulators, 0))

    def _number(self, name: str, value: float) -> None:
        self._outlet.number(f"{PLACE}/{name}", float(value))
