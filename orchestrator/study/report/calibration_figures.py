"""Figures of the calibrations: 3b test discrepancy, 3c discrepancy against simulations, 4 discrepancy over θ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from orchestrator.results import figure_style as style
from orchestrator.strategies.calibration.calibration_base import Calibrated
from orchestrator.strategies.calibration.calibration_scores import UNCALIBRATED
from orchestrator.study.report.cell_results import RANDOM, Found, Gathered, mean, running_least
from orchestrator.study.report.figure_panels import Drawn, colour, legend, log_axis, look, strategy_of
from orchestrator.study.report.statistics import SHARE, Estimate, estimate
from orchestrator.study.study_plan import StudyPlan


def draw_calibrations(study: StudyPlan, found: Gathered) -> list[Drawn]:
    """Draw all figures for which there is data."""
    known = {name: one for name, one in found.calibrated.items() if any(one.test)}
    strategies = {name: one for name, one in known.items() if name not in (UNCALIBRATED, RANDOM)}
    drawn = [_boxes(known)] if known else []
    if strategies:
        drawn.append(_against_simulations(strategies))
        drawn.append(_over_theta(study, strategies))
    return drawn


def error(one: Estimate) -> list[list[float]]:
    """Distances down and up for `errorbar`; zero without an interval."""
    return [[np.nan_to_num(one.mean - one.low)], [np.nan_to_num(one.high - one.mean)]]


def _boxes(known: Mapping[str, Found]) -> Drawn:
    figure, axes = style.new_figure(size=(1.6 + 1.25 * len(known), 4.2))
    rows: list[list[object]] = []
    for place, (name, one) in enumerate(known.items(), start=1):
        pooled = [100 * value for test in one.test for value in test]
        axes.boxplot([pooled], positions=[place], widths=0.55, showfliers=False, medianprops={"color": style.INK})
        axes.plot(np.linspace(place - 0.12, place + 0.12, len(pooled)), pooled, ".", color=style.PALE, zorder=1)
        average = estimate([mean(test) for test in one.test], SHARE).scaled(100)
        axes.errorbar([place], [average.mean], yerr=error(average), fmt="D", color=colour(name), capsize=4, zorder=4)
        quartiles = [float(q) for q in np.percentile(pooled, [25, 50, 75])]
        rows.append([name, average.count, len(pooled), average.mean, average.low, average.high, *quartiles])
    axes.set_xticks(range(1, len(known) + 1), list(known))
    axes.set_ylim(bottom=0.0)
    style.dress(axes, title="Test discrepancy", y="|measured − simulated| spillage [%]")
    return Drawn(
        "figure-3b",
        "3b",
        "Test discrepancy",
        "Every test pour of every repetition: quartiles, median, whiskers to 1.5 quartile ranges (grey: the pours). "
        "Diamonds: mean over repetitions with its 95 % t interval.",
        figure,
        ("strategy", "repetitions", "pours", "mean_percent", "low", "high", "quartile_1", "median", "quartile_3"),
        rows,
    )


def _against_simulations(known: Mapping[str, Found]) -> Drawn:
    figure, axes = style.new_figure(size=(6.4, 4.2))
    rows: list[list[object]] = []
    for name, one in known.items():
        curves = [_curve(name, *pair) for pair in zip(one.results, one.expected, strict=True)]
        curves = [curve for curve in curves if curve]
        if not curves:
            continue
        length = min(len(curve) for curve in curves)
        points = [
            (curves[0][i][0], estimate([curve[i][1] for curve in curves], SHARE).scaled(100)) for i in range(length)
        ]
        rows += [[name, spent, e.count, e.mean, e.low, e.high] for spent, e in points]
        spent, means = [p[0] for p in points], [p[1].mean for p in points]
        if len(points) == 1:
            axes.errorbar(
                spent,
                means,
                yerr=error(points[0][1]),
                fmt="s",
                color=colour(name),
                capsize=4,
                label=name,
                clip_on=False,
            )
        else:
            axes.plot(spent, means, look(name, list(known)).line, color=colour(name), label=name)
            axes.errorbar(
                spent[-1:], means[-1:], yerr=error(points[-1][1]), fmt="o", color=colour(name), capsize=4, clip_on=False
            )
    log_axis(axes.xaxis)
    axes.set_ylim(bottom=0.0)
    legend(figure, list(known))
    style.dress(axes, title="Discrepancy against simulations", x="simulations", y="best discrepancy [%]", grid="both")
    return Drawn(
        "figure-3c",
        "3c",
        "Best discrepancy against simulations",
        "On training pours. C3: least mean discrepancy of the θ tried so far; C4: least that its surrogate had "
        "expected of a θ it chose, and at last of θ*; C1 and C2 choose all θ beforehand, and are one point. Bars, of "
        "a curve at its end: 95 % t intervals over repetitions.",
        figure,
        ("strategy", "simulations", "repetitions", "best_percent", "low", "high"),
        rows,
    )


def _curve(name: str, result: Calibrated, expected: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """(simulations, best discrepancy so far)."""
    if strategy_of(name) == "C3":
        each = result.training_pours
        values = [float("nan") if t.discrepancy is None else t.discrepancy for t in result.trials]
        return [(each * (i + 1), value) for i, value in enumerate(running_least(values))]
    if strategy_of(name) == "C4":
        best = running_least([max(value, 0.0) for _, value in expected])
        return [(spent, value) for (spent, _), value in zip(expected, best, strict=True)]
    return [] if result.found is None else [(result.simulations, result.found.predicted_discrepancy)]


def _over_theta(study: StudyPlan, known: Mapping[str, Found]) -> Drawn:
    figure, grid = style.new_figure(1, len(known), size=(1.0 + 3.4 * len(known), 3.9), squeeze=False)
    rows: list[list[object]] = []
    names: list[str] = []
    box = {axis.name: axis for axis in study.calibrations[0].plan.parameters.axes}
    shown = None
    top = 100 * max((_largest(one) for one in known.values()), default=1.0)
    for axes, (name, one) in zip(grid[0], known.items(), strict=True):
        found = [result.found for result in one.results if result.found is not None]
        maps = [theta.map for theta in found if theta.map is not None]
        names = list(maps[0].over) if maps else [*found[0].searched, *found[0].searched][:2]
        settings = {"cmap": "viridis", "vmin": 0.0, "vmax": top}
        if strategy_of(name) in ("C1", "C2"):
            tried: dict[tuple[float, float], list[float]] = {}
            for result in one.results:
                for trial in result.trials:
                    if trial.discrepancy is not None:
                        place = (trial.theta[names[0]], trial.theta[names[1]])
                        tried.setdefault(place, []).append(100 * trial.discrepancy)
            places = list(tried)
            values = [mean(tried[place]) for place in places]
            xs, ys = [p[0] for p in places], [p[1] for p in places]
            shown = axes.scatter(xs, ys, c=values, marker="s", s=46, clip_on=False, **settings)
            rows += [[name, "trial", names[0], x, names[1], y, v] for (x, y), v in zip(places, values, strict=True)]
        elif maps:
            alike = [m for m in maps if list(m.over) == names]
            surface = 100 * np.mean([np.maximum(m.mean, 0.0) for m in alike], axis=0)
            xs, ys = list(alike[0].axes[names[0]]), list(alike[0].axes[names[1]])
            shown = axes.pcolormesh(xs, ys, surface, shading="gouraud", **settings)
            rows += [
                [name, "surrogate", names[0], x, names[1], y, float(surface[j, i])]
                for j, y in enumerate(ys)
                for i, x in enumerate(xs)
            ]
        stars = [(getattr(theta.theta, names[0]), getattr(theta.theta, names[1])) for theta in found]
        axes.plot(
            [x for x, _ in stars], [y for _, y in stars], "X", color=style.BEST, markeredgecolor="white", markersize=9,
            label="θ* of a repetition", clip_on=False, zorder=4,
        )  # fmt: skip
        rows += [[name, "theta*", names[0], x, names[1], y, ""] for x, y in stars]
        first = axes is grid[0][0]
        style.dress(axes, title=name, x=style.label(names[0]), y=style.label(names[1]) if first else "", grid=None)
        style.frame(axes, box[names[0]], "x")
        style.frame(axes, box[names[1]], "y")
    if shown is not None:
        figure.colorbar(shown, ax=list(grid[0]), label="discrepancy [%]", extend="max", pad=0.02)
    legend(figure, [])
    return Drawn(
        "figure-4",
        "4",
        "Discrepancy over θ",
        "C1 and C2: mean over the training pours of each θ that was tried, over the repetitions. C3 and C4: posterior "
        "mean of the surrogate, averaged over the repetitions. Crosses: θ* of each repetition. "
        "Colours end at the ninth decile of what was found.",
        figure,
        ("strategy", "what", "x_name", "x", "y_name", "y", "discrepancy_percent"),
        rows,
    )


def _largest(one: Found) -> float:
    values = [t.discrepancy for r in one.results for t in r.trials if t.discrepancy is not None]
    return float(np.percentile(values, 90)) if values else 0.0
