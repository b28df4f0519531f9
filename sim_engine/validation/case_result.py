"""What a case reports: measured quantities beside their references, and the curves that a figure shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Measurement:
    """One measured quantity and what is asked of it.

    Attributes:
        name: what was measured, in words.
        value: SI.
        unit: SI unit; '1' for pure numbers.
        reference: value that theory or experiment gives; None if there is none.
        lower, upper: the quantity passes between them; both infinite: it is reported, not judged.
        criterion: those bounds in words.
        particles: N of the run.
    """

    name: str
    value: float
    unit: str
    reference: float | None
    lower: float
    upper: float
    criterion: str
    particles: int

    @property
    def judged(self) -> bool:
        """Whether anything is asked of it."""
        return self.lower > -math.inf or self.upper < math.inf

    @property
    def passed(self) -> bool:
        """Whether it lies within its bounds. A value that is not a number passes nothing, not even when unjudged."""
        return self.lower <= self.value <= self.upper

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping; open bounds, and values that could not be measured, are None."""
        return {
            "name": self.name,
            "value": self.value if math.isfinite(self.value) else None,
            "unit": self.unit,
            "reference": self.reference,
            "lower": self.lower if math.isfinite(self.lower) else None,
            "upper": self.upper if math.isfinite(self.upper) else None,
            "criterion": self.criterion,
            "particles": self.particles,
            "judged": self.judged,
            "passed": self.passed,
        }


def within(
    name: str, value: float, reference: float, by: float, *, particles: int, unit: str = "1", criterion: str
) -> Measurement:
    """A quantity that must lie within an absolute distance of its reference.

    Args:
        by: largest distance, in the quantity's unit.
    """
    return Measurement(name, value, unit, reference, reference - by, reference + by, criterion, particles)


def at_most(name: str, value: float, limit: float, *, particles: int, unit: str = "1", criterion: str) -> Measurement:
    """A quantity that must not exceed a limit."""
    return Measurement(name, value, unit, None, -math.inf, limit, criterion, particles)


def at_least(name: str, value: float, limit: float, *, particles: int, unit: str = "1", criterion: str) -> Measurement:
    """A quantity that must reach a limit."""
    return Measurement(name, value, unit, None, limit, math.inf, criterion, particles)


def reported(
    name: str, value: float, *, particles: int, unit: str = "1", reference: float | None = None
) -> Measurement:
    """A quantity that is shown and not judged."""
    return Measurement(name, value, unit, reference, -math.inf, math.inf, "reported", particles)


@dataclass(frozen=True)
class Series:
    """A curve of a case's figure.

    Attributes:
        name: legend.
        x, y: SI.
        kind: how it is drawn: 'measured' curves differ in colour; a 'reference' is dashed, or points if it has few. It
            has the colour of the curve whose name begins as its own up to a comma, and is black if none does.
        panel: figures of several panels: which one.
        spread: standard deviation at each point, drawn as a band; empty: none.
    """

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    kind: Literal["measured", "reference"] = "measured"
    panel: int = 0
    spread: tuple[float, ...] = ()


@dataclass(frozen=True)
class Figure:
    """Curves that belong into one picture, by panel.

    Attributes:
        titles, x_labels, y_labels: one of each per panel.
        series: curves.
        log_x: whether the horizontal axes are logarithmic: all of them, or one by one.
    """

    titles: tuple[str, ...]
    x_labels: tuple[str, ...]
    y_labels: tuple[str, ...]
    series: tuple[Series, ...]
    log_x: bool | tuple[bool, ...] = False


@dataclass(frozen=True)
class CaseResult:
    """Outcome of one case.

    Attributes:
        measurements: what was measured.
        figure: its curves, if it has any.
        cpu_s: CPU seconds of the process while it ran, compilation of kernels included if they were not cached.
    """

    measurements: tuple[Measurement, ...]
    figure: Figure | None = None
    cpu_s: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether every judged quantity passed."""
        return all(m.passed for m in self.measurements)
