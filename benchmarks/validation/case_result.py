"""Effort and results of a case: measured quantities with their references, and the curves of its figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class CaseEffort:
    """The amount of computation.

    Attributes:
        full: all resolutions and seeds; else the quick subset.
        mirrored: all of them that pours are mirrored with, and only half of the liquid is simulated.
    """

    full: bool = False
    mirrored: bool = False

    def numbers(self, quick: tuple[int, ...], full: tuple[int, ...], coarse: int = 0) -> tuple[int, ...]:
        """Resolutions of the case.

        Args:
            quick, full: those of the quick and the full run, increasing.
            coarse: number of those that have fewer particles than pours are mirrored with.
        """
        return full[coarse:] if self.mirrored else full if self.full else quick


@dataclass(frozen=True)
class Measurement:
    """One measured quantity and its criterion.

    Attributes:
        name: of the quantity, in words.
        value: SI.
        unit: SI unit; '1' for pure numbers.
        reference: value from theory or experiment; None if there is none.
        lower, upper: the quantity passes between them; if both are infinite, it is reported without a criterion.
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
        """Whether it has a criterion."""
        return self.lower > -math.inf or self.upper < math.inf

    @property
    def passed(self) -> bool:
        """Whether it lies within its bounds. NaN never passes, even without a criterion."""
        return self.lower <= self.value <= self.upper

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping; infinite bounds, and values that could not be measured, are None."""
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
    """A quantity that is reported without a criterion."""
    return Measurement(name, value, unit, reference, -math.inf, math.inf, "reported", particles)


@dataclass(frozen=True)
class Series:
    """A curve of a case's figure.

    Attributes:
        name: legend.
        x, y: SI.
        kind: style: 'measured' curves differ in colour; a 'reference' is dashed, or drawn as points if it has few. It
            takes the colour of the curve whose name begins with its own name up to a comma, and is black if there is
            none.
        panel: number of the panel, in figures of several panels.
    """

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    kind: Literal["measured", "reference"] = "measured"
    panel: int = 0


@dataclass(frozen=True)
class Figure:
    """Curves of one figure, by panel.

    Attributes:
        titles, x_labels, y_labels: one of each per panel.
        series: curves.
        log_x: whether the horizontal axes are logarithmic.
    """

    titles: tuple[str, ...]
    x_labels: tuple[str, ...]
    y_labels: tuple[str, ...]
    series: tuple[Series, ...]
    log_x: bool = False


def collected(
    runs: Iterable[tuple[Sequence[Measurement], Sequence[Series]]],
) -> tuple[list[Measurement], list[Series]]:
    """Measurements and curves of several runs; a curve that several of them have is drawn only once."""
    measurements: list[Measurement] = []
    curves: dict[tuple[str, str, int], Series] = {}
    for of_run, series in runs:
        measurements += of_run
        for curve in series:
            curves.setdefault((curve.name, curve.kind, curve.panel), curve)
    return measurements, list(curves.values())


@dataclass(frozen=True)
class CaseResult:
    """Outcome of one case.

    Attributes:
        measurements: measured quantities.
        figure: its curves, if it has any.
        cpu_s: CPU time of the process while it ran [s], including the compilation of kernels that were not cached.
    """

    measurements: tuple[Measurement, ...]
    figure: Figure | None = None
    cpu_s: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether every quantity with a criterion passed."""
        return all(m.passed for m in self.measurements)
