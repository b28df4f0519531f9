"""Rows of the balance: its display over time, and the spillage that simulations predicted for the same pour.

`BalanceStage` keeps the simulations of each scene. The predicted range of a pour is formed from the simulations with
the nearest actions in the same scene: minimum, median and maximum of their spilled mass at each time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from actors.interfaces import DoseProgress, PourProgress
from orchestrator.learning.requests import Pour
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.recording_sink import RecordingSink, Track, columns_of
from orchestrator.reports import figure_style as style
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.scene import Scene

PLACE = "/balance"

NEAREST = 5
"""Number of simulations that form a prediction."""

REMEMBERED = 200
"""Number of simulations kept per scene."""

_POURING = ("tilt", "hold", "return", "settle", "weigh")
"""Checkpoints during which the net weight is the spilled mass."""

FloatArray = NDArray[np.float64]


@dataclass
class _Running:
    """A pour in progress."""

    scene: Scene
    band: FloatArray | None
    """Spilled mass [g] at `times`: minimum, median, maximum; shape (3, T)."""
    times: FloatArray
    shown: list[tuple[float, float]] = field(default_factory=list)
    """Wall time and display [g]."""
    tilted: float | None = None
    """Wall time at the start of tilting."""
    tared: float | None = None
    verdict: float | None = None
    """Spilled mass as weighed at the end [g]."""


class BalanceStage:
    """Writes the rows of the balance. For one thread.

    Args:
        sink: sink of the rows.
        time_scale: bench seconds per second of the clock.
    """

    def __init__(self, sink: RecordingSink, time_scale: float) -> None:
        self._sink, self._scale = sink, time_scale
        self._simulated: dict[str, list[tuple[Action, PourOutcome]]] = {}
        self._running: _Running | None = None
        self._checkpoint = self._phase = ""
        for name, label, colour, width in (
            ("shown", "display [g]", style.MEASURED, 3.0),
            ("net", "since the tare [g]", style.MEASURED, 3.0),
            ("expected/low", "expected, least [g]", "#f0c27a", 1.5),
            ("expected/middle", "expected at the end [g]", style.PREDICTED, 3.0),
            ("expected/high", "expected, most [g]", "#f0c27a", 1.5),
            ("pour/low", "simulated, least [g]", "#f0c27a", 1.5),
            ("pour/middle", "simulated [g]", style.PREDICTED, 3.0),
            ("pour/high", "simulated, most [g]", "#f0c27a", 1.5),
            ("pour/weighed", "balance [g]", style.MEASURED, 3.0),
            ("pour/liquid", "virtual liquid [g]", style.FALLING, 3.0),
            ("dose/target", "wanted [g]", style.BEST, 1.5),
            ("dose/reading", "balance [g]", style.MEASURED, 3.0),
            ("dose/estimated", "estimated in the receiver and falling [g]", style.PREDICTED, 3.0),
            ("dose/tilt", "tilt [deg]", style.FALLING, 1.5),
        ):
            appearance = rr.SeriesLines(names=label, colors=shapes.rgb(colour), widths=width)
            sink.log(f"{PLACE}/{name}", appearance, static=True)
        for name, label, colour, size in (
            ("stable", "stable [g]", style.GOOD, 4.0),
            ("tare", "tare [g]", style.INK, 6.0),
            ("verdict", "weighed [g]", style.BEST, 9.0),
            ("pour/verdict", "weighed [g]", style.BEST, 9.0),
            ("dose/stop", "turned back [g]", style.INK, 9.0),
        ):
            sink.log(
                f"{PLACE}/{name}",
                rr.SeriesPoints(names=label, colors=shapes.rgb(colour), marker_sizes=size),
                static=True,
            )

    def simulated(self, scene: str, action: Action, outcome: PourOutcome) -> None:
        """Keep a simulation for comparison with later pours."""
        if outcome.curve_times:
            series = self._simulated.setdefault(scene, [])
            series.append((action, outcome))
            del series[:-REMEMBERED]

    def begin(self, pour: Pour, scene: Scene) -> None:
        """Start a pour."""
        times, band = self._predicted(pour, scene)
        self._running, self._checkpoint = _Running(scene, band, times), ""
        if band is not None:
            for name, value in zip(("low", "middle", "high"), band[:, -1], strict=True):
                self._number(f"expected/{name}", value)

    def progress(self, told: PourProgress, wall: float) -> str | None:
        """Log the display; return the checkpoint if it is new."""
        running = self._running
        if running is None:
            return None
        if told.checkpoint == "tilt" and running.tilted is None:
            running.tilted = wall
            running.tared = running.shown[-1][1] if running.shown else 0.0
            self._number("tare", running.tared)
        if told.balance is not None:
            grams = 1e3 * told.balance
            if not running.shown or running.shown[-1] != (wall, grams):
                running.shown.append((wall, grams))
                self._number("shown", grams)
                if told.stable:
                    self._number("stable", grams)
                net = grams - (running.tared or 0.0)
                # After weighing, the operator may put the pourer on the balance.
                if (
                    running.tilted is not None
                    and told.checkpoint in _POURING
                    and net <= 1e3 * running.scene.liquid.mass
                ):
                    self._number("net", net)
        if told.dose is not None:
            self._dose(told.dose, told.tilt)
        if told.checkpoint == self._checkpoint:
            return None
        self._checkpoint = told.checkpoint
        return told.checkpoint

    def _dose(self, dose: DoseProgress, tilt: float | None) -> None:
        """Log a dose: its target, reading, estimate and tilt, and the moment at which the cup is turned back."""
        self._number("dose/target", 1e3 * dose.target)
        self._number("dose/estimated", 1e3 * dose.amount)
        if dose.reading is not None:
            self._number("dose/reading", 1e3 * dose.reading)
        if tilt is not None:
            self._number("dose/tilt", math.degrees(tilt))
        if dose.phase == "return" and self._phase != "return":
            self._number("dose/stop", 1e3 * dose.amount)
        self._phase = dose.phase

    def finish(self, measured: PourMeasurement) -> _Running | None:
        """Log the result of a pour; return its readings for `beside`."""
        running, self._running = self._running, None
        self._number("verdict", 1e3 * measured.spilled)
        if running is not None:
            running.verdict = 1e3 * measured.spilled
        if running is not None and running.band is not None:
            for name, value in zip(("low", "middle", "high"), running.band[:, -1], strict=True):
                self._number(f"expected/{name}", value)
        # no line between two pours
        for ended in ("net", "expected", "dose/reading", "dose/estimated", "dose/tilt"):
            self._sink.clear(f"{PLACE}/{ended}", recursive=True)
        return running

    def beside(self, running: _Running | None, times: FloatArray, spilled: FloatArray | None) -> list[Track]:
        """Return the readings of a pour together with the simulations' prediction.

        Args:
            running: the pour, as returned by `finish`.
            times: times of the pour's playback, shape (T,) [s of bench time].
            spilled: mass spilled by the liquid of a virtual bench at these times, shape (T,) [kg].
        """
        if running is None:
            return []
        tracks = []
        if running.band is not None:
            for name, curve in zip(("low", "middle", "high"), running.band, strict=True):
                tracks.append(self._curve(f"pour/{name}", times, np.interp(times, running.times, curve)))
        if spilled is not None:
            tracks.append(self._curve("pour/liquid", times, 1e3 * spilled))
        if running.tilted is not None and np.isfinite(self._scale) and running.shown:
            walls, grams = np.array(running.shown).T
            at = running.tilted + times / self._scale
            covered = at <= walls[-1] + 1.0
            net = np.interp(at[covered], walls, grams) - (running.tared or 0.0)
            tracks.append(self._curve("pour/weighed", times[covered], net))
        if running.verdict is not None:
            tracks.append(self._curve("pour/verdict", times[-1:], np.array([running.verdict])))
        return tracks

    def told(self) -> None:
        """Clear the curves after the playback of a pour."""
        self._sink.clear(f"{PLACE}/pour", recursive=True)

    def _curve(self, name: str, times: FloatArray, values: FloatArray) -> Track:
        return Track(f"{PLACE}/{name}", times, columns_of(rr.Scalars.columns(scalars=values)))

    def _predicted(self, pour: Pour, scene: Scene) -> tuple[FloatArray, FloatArray | None]:
        simulated = self._simulated.get(pour.scene, [])
        wanted = _numbers(pour.action.values())
        if not simulated:
            return np.zeros(0), None
        names = sorted(wanted)
        places = np.array([[_numbers(action.values()).get(n, wanted[n]) for n in names] for action, _ in simulated])
        spread = np.ptp(places, axis=0)
        away = (places - np.array([wanted[n] for n in names])) / np.where(spread > 0.0, spread, 1.0)
        nearest = np.argsort(np.linalg.norm(away, axis=1), kind="stable")[:NEAREST]
        outcomes = [simulated[int(i)][1] for i in nearest]
        end = max(outcome.curve_times[-1] for outcome in outcomes)
        times = np.linspace(0.0, end, 80)
        grams = 1e3 * scene.liquid.mass
        curves = np.array([grams * np.interp(times, o.curve_times, o.curve_spilled) for o in outcomes])
        return times, np.stack([curves.min(axis=0), np.median(curves, axis=0), curves.max(axis=0)])

    def _number(self, name: str, value: float) -> None:
        self._sink.number(f"{PLACE}/{name}", float(value))


def _numbers(values: Mapping[str, float | None]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items() if value is not None and name in ACTION_DIMENSIONS}
