"""Effect of each simulation parameter on the spillage: one is varied at a time, around the defaults, in three pours.

There is no criterion. For every parameter and pour the result is the widest part of its range in which the spillage
only rises or only falls within the seeds' noise, with the change and the slope there. Spillage is monotone over an
interval if the residuals of an isotonic (least-squares monotone) fit are consistent with the noise: χ² below its 95 %
quantile.

Source of the fit: Barlow, Bartholomew, Bremner & Brunk, Statistical Inference under Order Restrictions (1972).

Limitations: interactions of two parameters are not covered; a slope is the mean over the interval.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, ParameterInfo, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.validation.case_result import Figure, Measurement, Series, reported
from sim_engine.vessel.shapes import cylinder

Floats = NDArray[np.float64]

PARTICLES = (250.0, 4_000.0)
"""Examined range of the number of particles: beyond it a pour takes minutes."""

CONFIDENCE = 0.95

SCENE = Scene(
    "sensitivity",
    cylinder("cup", inner_radius=0.04, inner_height=0.10),
    cylinder("tumbler", inner_radius=0.032, inner_height=0.10),
    Liquid(mass=0.1996),
)


def _pour(speed: float, x_offset: float) -> Action:
    return Action(
        angular_velocity=speed * DEG,
        max_angle=120 * DEG,
        hold_time=0.4,
        return_velocity=None,
        x_offset=x_offset,
        height=0.09,
    )


POURS = {"slow": _pour(20, 0.100), "standard": _pour(30, 0.105), "fast": _pour(100, 0.120)}
"""200 mL into a tumbler that stands slightly too far away, so that each pour spills some."""


@dataclass(frozen=True)
class Sensitivity:
    """Effect of one parameter on one pour.

    Attributes:
        values: of the parameter, increasing, SI.
        means, deviations: of the spillage spilled / poured, over seeds.
        direction: 1 if spillage rises with it, −1 if it falls, 0 if no effect exceeds the noise.
        lower, upper: interval of this direction.
        change, change_error: of the spillage from `lower` to `upper`, and its standard error.
        slope, slope_error: in 1 / (unit of the parameter), by least squares; for particles, per doubling.
    """

    parameter: str
    pour: str
    values: tuple[float, ...]
    means: tuple[float, ...]
    deviations: tuple[float, ...]
    direction: int
    lower: float
    upper: float
    change: float
    change_error: float
    slope: float
    slope_error: float


def grid(info: ParameterInfo, default: float, count: int) -> tuple[float, ...]:
    """Values of a parameter to try: both ends of its range, the default, and more values near the default.

    Args:
        info: its bounds.
        default: its default.
        count: number of values, at least 3.
    """
    places = np.linspace(0.0, 1.0, count)
    if info.name == "particles":
        values = np.geomspace(*PARTICLES, count)
    else:
        near_zero = default < info.lower + 0.25 * (info.upper - info.lower)
        values = info.lower + (info.upper - info.lower) * places ** (2.0 if near_zero else 1.0)
    if values[0] < default < values[-1]:
        values[1 + int(np.argmin(np.abs(values[1:-1] - default)))] = default
    rounded = [float(round(v)) if info.integer else float(f"{v:.3g}") for v in values]
    return tuple(sorted(set(rounded)))


def analyse(parameter: str, pour: str, values: Floats, samples: list[Floats], smallest: float) -> Sensitivity:
    """The interval in which spillage is monotone in a parameter, and its slope.

    Args:
        parameter, pour: names.
        values: of the parameter, increasing, shape (K,), K ≥ 3.
        samples: K arrays: spillages of the seeds, at least two each.
        smallest: resolution of a spillage: one particle of all.
    """
    means = np.array([s.mean() for s in samples])
    variances = np.array([s.var(ddof=1) for s in samples])
    counts = np.array([len(s) for s in samples])
    # few seeds estimate a variance badly, so half of it is pooled over all values
    errors = np.sqrt((0.5 * variances + 0.5 * variances.mean()) / counts + smallest**2)
    if _explained(means - np.average(means, weights=errors**-2), errors):
        direction, first, last = 0, 0, len(values) - 1
    else:
        direction, first, last = _widest(means, errors)
    inside = slice(first, last + 1)
    x = np.log2(values) if parameter == "particles" else values
    slope, slope_error = _line(x[inside], means[inside], errors[inside])
    return Sensitivity(
        parameter,
        pour,
        tuple(values.tolist()),
        tuple(means.tolist()),
        tuple(np.sqrt(variances).tolist()),
        direction,
        float(values[first]),
        float(values[last]),
        float(means[last] - means[first]),
        math.hypot(errors[first], errors[last]),
        slope,
        slope_error,
    )


def _explained(residuals: Floats, errors: Floats) -> bool:
    """Whether noise alone can cause such residuals."""
    from scipy.stats import chi2

    limit = chi2.ppf(CONFIDENCE, max(len(residuals) - 1, 1))
    return bool(np.sum((residuals / errors) ** 2) <= limit)


def _widest(means: Floats, errors: Floats) -> tuple[int, int, int]:
    """Direction, first and last point of the longest interval with a monotone fit; among equals, the largest change."""
    from scipy.optimize import isotonic_regression

    widest = []
    for first in range(len(means) - 1):
        for last in range(first + 1, len(means)):
            inside = slice(first, last + 1)
            for direction in (1, -1):
                fit = isotonic_regression(means[inside], weights=errors[inside] ** -2, increasing=direction > 0).x
                change = direction * float(fit[-1] - fit[0])
                if _explained(means[inside] - fit, errors[inside]):
                    widest.append((last - first, change, direction, first, last))
    _, _, direction, first, last = max(widest)
    return direction, first, last


def _line(x: Floats, y: Floats, errors: Floats) -> tuple[float, float]:
    """Slope by weighted least squares, and its standard error."""
    weights = errors**-2
    centred = x - np.average(x, weights=weights)
    spread = float(np.sum(weights * centred**2))
    return float(np.sum(weights * centred * y)) / spread, 1.0 / math.sqrt(spread)


@dataclass(frozen=True)
class Extent:
    """Extent of the simulations.

    Attributes:
        particles: N, unless it is the varied parameter.
        values: number of values of each parameter.
        seeds: number of seeds at each value.
        pours: names out of `POURS`.
        parameters: names; empty: all.
    """

    particles: int
    values: int
    seeds: int
    pours: tuple[str, ...]
    parameters: tuple[str, ...] = ()


FULL = Extent(particles=1_000, values=6, seeds=5, pours=tuple(POURS))
QUICK = Extent(particles=300, values=3, seeds=2, pours=("fast",))


def sensitivity(
    simulator: PourSimulator, extent: Extent, progress: Callable[[int, int], None] | None = None
) -> tuple[list[Measurement], Figure]:
    """Vary every parameter in every pour.

    Args:
        extent: of the simulations.
        progress: called with the number of finished simulations and their total.
    """
    base = SimulationParameters(particles=extent.particles)
    known = {n: i for n, i in SimulationParameters.info().items() if not i.nuisance}
    turned = {n: i for n, i in known.items() if not extent.parameters or n in extent.parameters}
    grids = {name: grid(info, float(getattr(base, name)), extent.values) for name, info in turned.items()}
    jobs = list(_jobs(base, grids, extent))
    spilled: dict[tuple[str, SimulationParameters], list[float]] = {}
    for done, (pour, theta, seed) in enumerate(jobs):
        if progress is not None:
            progress(done, len(jobs))
        outcome = simulator.simulate(PourTask(SCENE, POURS[pour], theta, seed)).outcome
        spillage = outcome.fractions.spillage
        if outcome.invalid is None and spillage is not None:
            spilled.setdefault((pour, theta), []).append(spillage)
    if progress is not None:
        progress(len(jobs), len(jobs))
    sensitivities = []
    for name, values in grids.items():
        for pour in extent.pours:
            samples = [(v, np.array(spilled.get((pour, _turned(base, name, v)), []))) for v in values]
            usable = [(v, s) for v, s in samples if len(s) >= 2]
            if len(usable) >= 3:
                at, seeds = np.array([v for v, _ in usable]), [s for _, s in usable]
                sensitivities.append(analyse(name, pour, at, seeds, 1.0 / extent.particles))
    return [*_spreads(base, spilled, extent), *_measurements(sensitivities, extent)], sensitivity_figure(
        sensitivities, base
    )


def _turned(base: SimulationParameters, name: str, value: float) -> SimulationParameters:
    return SimulationParameters.from_values({**base.model_dump(), name: value})


def _jobs(
    base: SimulationParameters, grids: dict[str, tuple[float, ...]], extent: Extent
) -> Iterator[tuple[str, SimulationParameters, int]]:
    """Pour, θ and seed of every simulation; the defaults only once."""
    thetas = dict.fromkeys(_turned(base, name, value) for name, values in grids.items() for value in values)
    for pour in extent.pours:
        for theta in thetas:
            for seed in range(1, extent.seeds + 1):
                yield pour, theta, seed


def _spreads(
    base: SimulationParameters, spilled: dict[tuple[str, SimulationParameters], list[float]], extent: Extent
) -> list[Measurement]:
    """Spillage of the defaults in each pour."""
    spreads = []
    for pour in extent.pours:
        seeds = np.array(spilled.get((pour, base), [math.nan, math.nan]))
        n = extent.particles
        spreads.append(reported(f"{pour} pour with the defaults: spilled / poured", float(seeds.mean()), particles=n))
        spreads.append(reported("… and the standard deviation of its seeds", float(seeds.std(ddof=1)), particles=n))
    return spreads


WORDS = {1: "spillage rises", -1: "spillage falls", 0: "no effect beyond the seeds' noise"}

_CHANGE = re.compile(
    r"(?P<parameter>\w+) (?P<where>.+), (?P<pour>\w+) pour: (?P<effect>.+); change \(± (?P<error>\S+)\)"
)


def _measurements(sensitivities: list[Sensitivity], extent: Extent) -> list[Measurement]:
    infos = SimulationParameters.info()
    rows = []
    for row in sensitivities:
        unit = "" if infos[row.parameter].unit == "1" else infos[row.parameter].unit
        where = f"{row.parameter} {row.lower:g} … {row.upper:g} {unit}".rstrip()
        change = f"{where}, {row.pour} pour: {WORDS[row.direction]}; change (± {row.change_error:.2g})"
        per = "doubling" if row.parameter == "particles" else unit or "1"
        slope = f"… mean slope, per {per} (± {row.slope_error:.2g})"
        rows.append(reported(change, row.change, particles=extent.particles))
        rows.append(reported(slope, row.slope, particles=extent.particles))
    return rows


@dataclass(frozen=True)
class ParameterEffect:
    """One line of a page: the effect of a parameter on a pour.

    Attributes:
        where: the interval, with its unit.
        effect: one of `WORDS`.
        change, error: of the spillage over the interval; the error as displayed.
    """

    parameter: str
    pour: str
    where: str
    effect: str
    change: float
    error: str


def effects(records: Sequence[Mapping[str, Any]]) -> list[ParameterEffect]:
    """Effects of parameters, from the measurements as a page stores them (`Measurement.as_json`)."""
    effects_of_parameters = []
    for record in records:
        match = _CHANGE.fullmatch(str(record["name"]))
        if match is not None and record["value"] is not None:
            effects_of_parameters.append(ParameterEffect(**match.groupdict(), change=float(record["value"])))
    return effects_of_parameters


def sensitivity_figure(sensitivities: list[Sensitivity], base: SimulationParameters) -> Figure:
    """A panel for each parameter, a curve for each pour, with the standard deviation of its seeds as a band.

    Args:
        base: value of each parameter while another one is varied.
    """
    infos = SimulationParameters.info()
    names = [name for name in infos if any(row.parameter == name for row in sensitivities)]
    curves = []
    for row in sensitivities:
        curves.append(
            Series(
                f"{row.pour} pour",
                row.values,
                row.means,
                panel=names.index(row.parameter),
                spread=row.deviations,
            )
        )
    top = max((mean for row in sensitivities for mean in row.means), default=1.0)
    for panel, name in enumerate(names):
        held = float(getattr(base, name))
        curves.append(Series("held at", (held, held), (0.0, top), "reference", panel))
    units = [infos[name].unit for name in names]
    return Figure(
        tuple(name.replace("_", " ") for name in names),
        tuple(
            name.replace("_", " ") + ("" if unit == "1" else f" [{unit}]")
            for name, unit in zip(names, units, strict=True)
        ),
        ("spilled / poured",) * len(names),
        tuple(curves),
        log_x=tuple(name == "particles" for name in names),
    )
