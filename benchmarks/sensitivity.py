"""Effect of each simulation parameter on the spillage: one is varied at a time, around the defaults, in three pours.

    python benchmarks/sensitivity.py

It takes eight minutes, and writes two tables to docs/data/results.json, and docs/images/sensitivity.png. For every
parameter and pour the result is the widest part of its range in which the spillage only rises or only falls within the
seeds' noise, with the change there. Spillage is monotone over an interval if the residuals of an isotonic
(least-squares monotone) fit are consistent with the noise: χ² below its 95 % quantile.

Source of the fit: Barlow, Bartholomew, Bremner & Brunk, Statistical Inference under Order Restrictions (1972).

Limitations: interactions of two parameters are not covered; a slope is the mean over the interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from machine import write_table
from numpy.typing import NDArray

from orchestrator.reports import figure_style
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, ParameterInfo, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
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
PICTURE = Path("docs/images/sensitivity.png")


def sensitivity(simulator: PourSimulator, extent: Extent) -> tuple[dict[str, Floats], list[Sensitivity]]:
    """Vary every parameter in every pour.

    Args:
        extent: of the simulations.

    Returns:
        By pour, the spillages of the seeds with the defaults; and the effects.
    """
    base = SimulationParameters(particles=extent.particles)
    known = {n: i for n, i in SimulationParameters.info().items() if not i.nuisance}
    turned = {n: i for n, i in known.items() if not extent.parameters or n in extent.parameters}
    grids = {name: grid(info, float(getattr(base, name)), extent.values) for name, info in turned.items()}
    spilled: dict[tuple[str, SimulationParameters], list[float]] = {}
    for pour, theta, seed in _jobs(base, grids, extent):
        outcome = simulator.simulate(PourTask(SCENE, POURS[pour], theta, seed)).outcome
        spillage = outcome.fractions.spillage
        if outcome.invalid is None and spillage is not None:
            spilled.setdefault((pour, theta), []).append(spillage)
    sensitivities = []
    for name, values in grids.items():
        for pour in extent.pours:
            samples = [(v, np.array(spilled.get((pour, _turned(base, name, v)), []))) for v in values]
            usable = [(v, s) for v, s in samples if len(s) >= 2]
            if len(usable) >= 3:
                at, seeds = np.array([v for v, _ in usable]), [s for _, s in usable]
                sensitivities.append(analyse(name, pour, at, seeds, 1.0 / extent.particles))
    return {pour: np.array(spilled[pour, base]) for pour in extent.pours}, sensitivities


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


WORDS = {1: "rises", -1: "falls"}


def effects_table(sensitivities: Sequence[Sensitivity], pours: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Head and rows: the effect of each parameter on each pour."""
    infos = SimulationParameters.info()
    known = {(row.parameter, row.pour): row for row in sensitivities}
    rows = []
    for name in dict.fromkeys(row.parameter for row in sensitivities):
        unit = "" if infos[name].unit == "1" else infos[name].unit
        cells = []
        for pour in pours:
            row = known.get((name, pour))
            if row is None or row.direction == 0:
                cells.append("not measured" if row is None else "none")
                continue
            where = f"{row.lower:g} … {row.upper:g} {unit}".rstrip()
            cells.append(f"{WORDS[row.direction]}, {where}: {row.change:+.3f} ± {row.change_error:.2g}")
        rows.append([f"`{name}`", unit, *cells])
    return ["name", "unit", *(f"{pour} pour" for pour in pours)], rows


def draw(sensitivities: Sequence[Sensitivity], base: SimulationParameters, path: Path) -> None:
    """A panel for each parameter, a curve for each pour, with the standard deviation of its seeds as a band.

    Args:
        base: value of each parameter while another one is varied.
        path: of the PNG.
    """
    infos = SimulationParameters.info()
    names = list(dict.fromkeys(row.parameter for row in sensitivities))
    colours = dict(zip(POURS, (figure_style.MEASURED, figure_style.PREDICTED, figure_style.GOOD), strict=True))
    lines = -(-len(names) // 3)
    figure, grid_of_axes = figure_style.new_figure(lines, 3, size=(10.2, 0.5 + 2.7 * lines), squeeze=False)
    for axes, name in zip(grid_of_axes.flat, names, strict=False):
        for row in (row for row in sensitivities if row.parameter == name):
            means, deviations = np.array(row.means), np.array(row.deviations)
            axes.plot(row.values, means, color=colours[row.pour], label=f"{row.pour} pour")
            axes.fill_between(
                row.values, means - deviations, means + deviations, color=colours[row.pour], alpha=0.18, lw=0
            )
        axes.axvline(float(getattr(base, name)), color=figure_style.INK, ls="--", lw=1.2)
        axes.set_xscale("log" if name == "particles" else "linear")
        unit = "" if infos[name].unit == "1" else f" [{infos[name].unit}]"
        title = name.replace("_", " ")
        figure_style.dress(axes, title=title, x=f"{title}{unit}", y="spilled / poured")
    for axes in grid_of_axes.flat[len(names) :]:
        axes.set_visible(False)
    figure.legend(*grid_of_axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure_style.save(figure, path)


def main() -> None:
    """Measure, and write tables and picture."""
    seeds, sensitivities = sensitivity(PourSimulator(), FULL)
    command, settings = (
        "python benchmarks/sensitivity.py",
        f"{FULL.particles:,} particles, {FULL.seeds} seeds, {FULL.values} values of each parameter",
    )
    write_table("effects", *effects_table(sensitivities, FULL.pours), command, settings)
    rows = [
        [pour, f"{FULL.particles}", f"{spilled.mean():.3f}", f"{spilled.std(ddof=1):.3f}"]
        for pour, spilled in seeds.items()
    ]
    head = ["pour", "particles", "spilled / poured", "standard deviation of a seed"]
    write_table("seeds", head, rows, command, settings)
    draw(sensitivities, SimulationParameters(particles=FULL.particles), PICTURE)


if __name__ == "__main__":
    main()
