"""The figures of a run: the choice of figures for its results, and those of losses and discrepancies.

- `draw_figures` writes all figures into a folder; `figures_of` returns them for notebooks.
- `draw_losses` and `draw_discrepancy` draw losses against pours, and θ* next to its rivals.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orchestrator.campaigns.dose_flows import DoseFlow
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import UNCALIBRATED, Scores
from orchestrator.learning.campaign_plan import CampaignPlan, receiver_name
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.dispense import Dispensed, Dose
from orchestrator.learning.requests import Prediction
from orchestrator.learning.stage_result import DisplayedMap
from orchestrator.records.codec import Results
from orchestrator.reports import figure_style as style
from orchestrator.reports.figure_style import safe_name
from orchestrator.reports.loss_units import DISCREPANCY, LossUnit, at_least_nothing, deployment_unit, largest_loss
from orchestrator.reports.mixture_report import draw_rack, mixed_liquids, mixtures_of
from orchestrator.reports.pour_figures import film_strip
from orchestrator.reports.stage_views import (
    SPLITS,
    all_of,
    calibrated_label,
    calibration_of,
    deployments_of,
    evaluation_of,
    theta_of,
)
from orchestrator.reports.surrogate_figures import (
    SurrogatePicture,
    draw_posterior,
    draw_surrogate,
    draw_trials,
)
from orchestrator.runs.run_folder import dose_film_file, film_file, read_film
from orchestrator.runs.stages import recommended_pours, scenes_of
from sim_engine.prediction_band import LEVEL
from sim_engine.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)


def draw_figures(
    directory: Path, plan: CampaignPlan, results: Results, formats: tuple[str, ...] = (".svg",)
) -> dict[str, Path]:
    """Draw all figures that the results allow.

    These are the discrepancy map and its trials, the test discrepancy, loss against pours, loss maps, safe windows,
    and the comparison of the first pours with simulations. With more than two searched axes, a map shows the two most
    important ones, and the trials against every axis are a separate figure.

    A figure that can't be drawn is reported and left out, so that it does not end a long run with an error.

    Args:
        directory: folder of the PNGs.
        plan: plan of the campaign.
        results: results of the stages.
        formats: suffixes of additional files next to each PNG.

    Returns:
        Name of each figure → its PNG.
    """
    pictures: dict[str, Path] = {}
    for name, draw in _drawings(plan, results, directory).items():
        try:
            pictures[name] = style.save(draw(), directory / f"{safe_name(name.replace(' ', '-'))}.png", formats)
        except Exception as error:
            _log.warning("figure '%s' was not drawn: %s: %s", name, type(error).__name__, error)
    return pictures


def figures_of(plan: CampaignPlan, results: Results) -> dict[str, Figure]:
    """The same figures for notebooks, not written to files. An error in a figure is raised."""
    return {name: draw() for name, draw in _drawings(plan, results).items()}


def _drawings(plan: CampaignPlan, results: Results, directory: Path | None = None) -> dict[str, Callable[[], Figure]]:
    """The functions that draw the figures, by name.

    Args:
        directory: folder with the films of recommended pours.
    """
    drawings: dict[str, Callable[[], Figure]] = {}
    calibration, evaluation, theta = calibration_of(results), evaluation_of(results), theta_of(results)
    if calibration is not None and (picture := calibration_picture(plan, calibration)) is not None:
        drawings["discrepancy map"] = partial(draw_surrogate, picture)
        if picture.held and picture.points:
            drawings["discrepancy trials"] = partial(draw_trials, picture)
    if theta is not None and plan.calibration is not None and theta.posterior is not None:
        space, best = plan.calibration.parameters, theta.theta.model_dump()
        drawings["posterior"] = partial(draw_posterior, theta.posterior, space, best)
    if evaluation is not None and (groups := discrepancy_groups(evaluation)):
        title = f"How far the simulator is from the balance: {plan.name}"
        drawings["test discrepancy"] = partial(draw_discrepancy, groups, title=title)
    mixtures = mixtures_of(results)
    if mixtures is not None:
        drawings["rack"] = draw_rack(mixtures, mixed_liquids(plan)).figure
    for dose in (dose for dispensed in all_of(results, Dispensed) for dose in dispensed.doses if dose.signals.times):
        if mixtures is not None and dose.outcome in (None, "reached"):
            continue  # of many doses, those that missed
        drawings[f"dose {dose.number}"] = partial(draw_dose, dose)
    drawings |= {} if directory is None else _dose_films(plan, results, directory)
    if plan.deployment is None:
        return drawings
    unit = deployment_unit(plan.deployment)
    if series := loss_series(plan, results, unit):
        title = f"Loss of every pour: {plan.name}"
        drawings["loss against pours"] = partial(draw_losses, series, cost=unit.label, title=title)
    for scene, result in deployments_of(results).items():
        picture, name = deployment_picture(plan, result), receiver_name(plan, scene)
        if picture is not None:
            drawings[f"loss map {name}"] = partial(draw_surrogate, replace(picture, deviation=None))
        if picture is not None and picture.deviation is not None:
            drawings[f"uncertainty of the loss {name}"] = partial(draw_surrogate, replace(picture, mean=None))
    if directory is not None:
        scenes = scenes_of(plan)
        for name, pour in recommended_pours(plan, results).items():
            if (file := film_file(directory, name)).is_file():
                drawings[f"recommended pour {name}"] = partial(_recommended, scenes[pour.scene], file)
    return drawings


def _dose_films(plan: CampaignPlan, results: Results, directory: Path) -> dict[str, Callable[[], Figure]]:
    """The film strips of doses of particles: those that missed, and the first ones of each source."""
    films: dict[str, Callable[[], Figure]] = {}
    sources: set[str] = set()
    for dose in (dose for dispensed in all_of(results, Dispensed) for dose in dispensed.doses):
        file = dose_film_file(directory, dose.number)
        if plan.dispense is None or not file.is_file() or (dose.source in sources and dose.outcome == "reached"):
            continue
        sources.add(dose.source)
        receiver = plan.dispense.doses[min(dose.number, len(plan.dispense.doses)) - 1].receiver
        scene = plan.dispense.scene(dose.source, receiver)
        title = f"Dose {dose.number} from {dose.source}: {dose.wanted_g:g} g wanted, {dose.outcome_text or dose.end}"
        films[f"film of dose {dose.number}"] = partial(_film, scene, file, title)
    return films


def _film(scene: Scene, file: Path, title: str) -> Figure:
    return film_strip(scene, read_film(file), title=title)


def _recommended(scene: Scene, file: Path) -> Figure:
    pour = read_film(file)
    got = pour.outcome
    shares = (
        f"{100 * got.received:.1f} % received, {100 * got.spilled:.1f} % spilled, {100 * got.retained:.1f} % retained"
    )
    return film_strip(scene, pour, title=f"The recommended pour into {scene.receiver.name}, simulated: {shares}")


def discrepancy_groups(evaluation: Scores) -> list[DiscrepancyGroup]:
    """Scores by set of pours, for `draw_discrepancy`."""
    label = calibrated_label(evaluation)
    if label is None:
        return []
    groups = []
    for split, name in SPLITS.items():
        uncalibrated = evaluation.discrepancy[label].get(split)
        if uncalibrated is None:
            continue
        rivals = [scores.get(split) for other, scores in evaluation.discrepancy.items() if other.startswith("random ")]
        groups.append(
            DiscrepancyGroup(
                name,
                sum(pair.split == split and pair.theta == label for pair in evaluation.pairs),
                uncalibrated,
                evaluation.discrepancy.get(UNCALIBRATED, {}).get(split),
                [value for value in rivals if value is not None],
                evaluation.mean_predictor.get(split),
                evaluation.regression.get(split),
                evaluation.posterior_mean.get(split),
            )
        )
    return groups


def calibration_picture(plan: CampaignPlan, result: Calibrated) -> SurrogatePicture | None:
    """The discrepancy over θ; None if the plan calibrates nothing or no trial has a discrepancy."""
    if plan.calibration is None:
        return None
    trials = [(trial.theta, trial.discrepancy) for trial in result.trials if trial.discrepancy is not None]
    shown = None if result.found is None else result.found.map
    if not trials and shown is None:
        return None
    return SurrogatePicture(
        title=f"Discrepancy over θ: {', '.join(scene.receiver.name for scene in plan.calibration.scenes)}",
        cost=DISCREPANCY.label,
        space=plan.calibration.parameters,
        points=[theta for theta, _ in trials],
        costs=[DISCREPANCY.factor * discrepancy for _, discrepancy in trials],
        best=None if result.found is None else result.found.theta.model_dump(),
        largest=DISCREPANCY.factor,
        **_surrogate(shown, DISCREPANCY),
    )


def deployment_picture(plan: CampaignPlan, result: Deployed) -> SurrogatePicture | None:
    """The loss over actions with numbered pours; None before the first data."""
    if plan.deployment is None:
        return None
    unit = deployment_unit(plan.deployment)
    pours = [(pour, pour.loss) for pour in result.weighed if pour.loss is not None]
    if not pours and result.map is None:
        return None
    return SurrogatePicture(
        title=f"Loss over actions: {receiver_name(plan, result.scene)} ({result.strategy})",
        cost=unit.label,
        space=plan.deployment.actions,
        points=[pour.action_si for pour, _ in pours],
        costs=[unit.factor * loss for _, loss in pours],
        best=None if result.recommended is None else result.recommended.action_si,
        best_name="best action",
        numbers=[pour.number for pour, _ in pours],
        simulated=[simulation.action_si for simulation in result.simulated],
        largest=unit.factor * largest_loss(plan.deployment),
        **_surrogate(result.map, unit),
    )


def loss_series(plan: CampaignPlan, results: Results, unit: LossUnit) -> list[LossSeries]:
    """Pours by receiver, for `draw_losses`; refused ones (nothing was poured) are left out."""
    series = []
    for scene, result in deployments_of(results).items():
        pours = [pour for pour in result.pours if pour.status in ("weighed", "failed")]
        if not pours:
            continue
        losses = [
            unit.factor * pour.loss if pour.status == "weighed" and pour.loss is not None else None for pour in pours
        ]
        predictions = [
            None
            if pour.predicted is None
            else _prediction_interval(
                Prediction(
                    pour.predicted, pour.predicted_deviation or 0.0, pour.predicted_scatter, pour.predicted_interval
                ),
                unit,
            )
            for pour in pours
        ]
        series.append(LossSeries(f"{receiver_name(plan, scene)} ({result.strategy})", losses, predictions))
    return series


def _prediction_interval(predicted: Prediction, unit: LossUnit) -> tuple[float, float, float]:
    low, high = predicted.of_a_pour()
    return unit.factor * at_least_nothing(predicted.mean), unit.factor * low, unit.factor * high


def _surrogate(shown: DisplayedMap | None, unit: LossUnit) -> dict[str, Any]:
    """The map of a figure: its axes, and the values of the other axes."""
    if shown is None:
        return {}
    return {
        "mean": unit.factor * np.maximum(np.asarray(shown.mean, float), 0.0),  # see `at_least_nothing`
        "deviation": unit.factor * np.asarray(shown.deviation, float),
        "over": shown.over,
        "held": shown.held,
    }


TOP = 1.08
"""Upper end of the axis, over the largest displayed value."""


@dataclass(frozen=True)
class LossSeries:
    """Pours into one receiver, in the order they were made.

    Attributes:
        receiver: display name.
        losses: measured loss of each pour in the axis's unit; None if a pour failed.
        predicted: (mean, low, high): expected loss of each pour, and its prediction interval with a probability of
            `sim_engine.prediction_band.LEVEL`; None without prediction.
    """

    receiver: str
    losses: Sequence[float | None]
    predicted: Sequence[tuple[float, float, float] | None]

    def best_so_far(self) -> list[float | None]:
        """Smallest loss up to each pour; None before the first successful one."""
        best: float | None = None
        running: list[float | None] = []
        for loss in self.losses:
            if loss is not None:
                best = loss if best is None else min(best, loss)
            running.append(best)
        return running


def draw_losses(series: Sequence[LossSeries], *, cost: str, title: str) -> Figure:
    """Loss against pours, one panel for each receiver: measured, best so far, and prediction interval.

    Args:
        series: one per receiver.
        cost: label of the loss with its unit.
        title: title of the whole figure.

    Raises:
        ValueError: no receiver, or a receiver without pours.
    """
    if not series or not all(len(s.losses) for s in series):
        raise ValueError("loss against pours: no pours to draw")
    columns = min(len(series), 3)
    rows = -(-len(series) // columns)
    figure, axes = style.new_figure(
        rows, columns, size=(max(6.4, 4.2 * columns), 0.6 + 3.7 * rows), squeeze=False, sharey=True
    )
    style.entitle(figure, title)
    top = 0.0
    for place, losses in enumerate(series):
        panel = axes[place // columns, place % columns]
        top = max(top, _pour_panel(panel, losses))
        style.dress(panel, title=_pour_title(losses, cost), x="pour", y=cost if place % columns == 0 else "")
    for extra in range(len(series), rows * columns):
        axes[extra // columns, extra % columns].set_visible(False)
    axes[0, 0].set_ylim(0.0, TOP * top or 1.0)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def draw_dose(dose: Dose) -> Figure:
    """Readings of the balance and tilt of the pourer over the time of a dose, with the wanted amount.

    Args:
        dose: with signals.
    """
    signals = dose.signals
    figure, axes = style.new_figure(2, 1, size=(6.4, 4.8), sharex=True)
    received = "unknown" if dose.received_g is None else f"{dose.received_g:.2f} g received"
    style.entitle(figure, f"Dose {dose.number}: {dose.wanted_g:g} g wanted, {received}")
    times, readings = np.array(signals.read_at), np.array(signals.readings_g)
    if dose.duration_s is not None:  # later readings are of another load, once an arm takes the receiver away
        times, readings = times[times <= dose.duration_s], readings[times <= dose.duration_s]
    axes[0].plot(times, readings, ".", color=style.MEASURED, label="reading")
    axes[0].axhline(dose.wanted_g, color=style.BEST, linewidth=1.0, label="wanted")
    axes[0].legend(loc="best", fontsize=9, frameon=False)
    axes[1].plot(signals.times, signals.tilt_deg, color=style.POURER)
    style.dress(axes[0], y="balance [g]")
    style.dress(axes[1], x="time [s]", y="tilt [deg]")
    return figure


FLOW_WINDOW = 0.5
"""Time over which a flow is averaged [s]."""


def draw_flow(flow: DoseFlow) -> Figure:
    """Flow and mass past the lip over the tilt of the pourer, simulated and by the equation of the dose controller.

    Args:
        flow: with a comparison.
    """
    found = flow.comparison
    assert found is not None
    tilts = np.degrees(found.tilts)
    curves = (
        ("simulated", found.simulated, {"color": style.MEASURED, "linewidth": 1.8}),
        ("equation of the controller", found.expected, {"color": style.GREY, "linestyle": "--"}),
        (
            f"with {math.degrees(found.onset):+.1f}° and the factor {found.factor:.2f}",
            found.fitted,
            {"color": style.BEST},
        ),
    )
    figure, axes = style.new_figure(2, 1, size=(6.4, 5.4), sharex=True)
    style.entitle(figure, f"{flow.title}: one slow dose of {1e3 * flow.amount:.4g} g")
    width = max(round(FLOW_WINDOW / float(np.diff(found.times).mean())), 1)
    for name, mass, line in curves:
        # (m(t + w/2) − m(t − w/2)) / w, as lumpy as the particles otherwise
        flows = (mass[width:] - mass[:-width]) / (found.times[width:] - found.times[:-width])
        axes[0].plot(0.5 * (tilts[width:] + tilts[:-width]), 1e3 * flows, label=name, **line)
        axes[1].plot(tilts, 1e3 * mass, **line)
    poured = np.flatnonzero(np.maximum(found.simulated, found.expected) > 0.0)
    axes[1].set_xlim(tilts[max(int(poured[0]) - 5, 0)] - 1.0 if len(poured) else 0.0, tilts[-1])
    axes[0].legend(loc="upper left", fontsize=9, frameon=False)
    style.dress(axes[0], y="flow [g/s]")
    style.dress(axes[1], x="tilt [deg]", y="past the lip [g]")
    return figure


def _pour_title(series: LossSeries, cost: str) -> str:
    """Receiver and loss of the best pour, with the unit of the cost's label."""
    worked = [(loss, number) for number, loss in enumerate(series.losses, start=1) if loss is not None]
    if not worked:
        return f"{series.receiver}: every pour failed"
    loss, number = min(worked)
    unit = cost.partition("[")[2].rstrip("]")
    return f"{series.receiver}: best {loss:.3g} {unit} (pour {number})"


def _pour_panel(axes: Axes, series: LossSeries) -> float:
    """Draw one receiver; returns the largest value that must be visible."""
    from matplotlib.ticker import MaxNLocator

    numbers = np.arange(1, len(series.losses) + 1)
    measured = np.array([np.nan if loss is None else loss for loss in series.losses], dtype=float)
    best = np.array([np.nan if value is None else value for value in series.best_so_far()], dtype=float)
    mean = np.array([np.nan if p is None else p[0] for p in series.predicted], dtype=float)
    low = np.array([np.nan if p is None else p[1] for p in series.predicted], dtype=float)
    high = np.array([np.nan if p is None else p[2] for p in series.predicted], dtype=float)
    top = float(np.nanmax(measured)) if np.isfinite(measured).any() else 1.0
    if np.isfinite(mean).any():
        # Bars, not a ribbon: every pour has another action, so there is nothing between two of them.
        axes.errorbar(
            numbers,
            mean,
            yerr=np.vstack([np.maximum(mean - low, 0.0), np.maximum(high - mean, 0.0)]),
            fmt="_",
            markersize=9,
            markeredgewidth=2.0,
            elinewidth=6.0,
            ecolor=(style.PREDICTED, 0.35),
            color=style.PREDICTED,
            label=f"predicted: mean, {100 * LEVEL:.0f} % interval",
            zorder=2,
        )
        # A first, uncertain prediction must not compress several measured values into the lowest tenth.
        top = max(top, min(float(np.nanmax(high)), 2.0 * top if len(numbers) > 1 else np.inf))
        for number, end in zip(numbers, high, strict=True):
            if end > TOP * top:
                axes.annotate(
                    f"{end:.3g}", (float(number), TOP * top), xytext=(7, -2), textcoords="offset points",
                    va="top", fontsize=8, color=style.GREY, arrowprops=None,
                )  # fmt: skip
    axes.step(numbers, best, where="post", color=style.BEST, linewidth=2.0, label="best so far", zorder=3)
    axes.plot(
        numbers,
        measured,
        "o",
        color=style.MEASURED,
        markersize=6.5,
        markeredgecolor="white",
        label="measured",
        zorder=4,
        clip_on=False,
    )
    failed = numbers[np.isnan(measured)]
    if len(failed):
        axes.plot(failed, np.full(len(failed), 0.02 * top), "x", color=style.INK, label="failed", zorder=4)
    axes.set_xlim(0.4, len(numbers) + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    return top


@dataclass(frozen=True)
class DiscrepancyGroup:
    """Mean |Δ| of several predictors on the same pours.

    Attributes:
        name: 'training pours', 'test pours', 'another receiver'.
        pours: number of pours.
        calibrated: of the calibrated simulator θ*.
        posterior: of the mean of its simulations over draws of θ's posterior; None if there is none.
        uncalibrated: of the simulator without calibration; None if not evaluated.
        random: of the simulator with random θ, one number each; empty if not evaluated.
        mean_predictor: of the mean spillage of the training pours; None if not evaluated.
        regression: of a GP regression without simulator; None if it can't predict (another vessel).
    """

    name: str
    pours: int
    calibrated: float
    uncalibrated: float | None = None
    random: Sequence[float] = ()
    mean_predictor: float | None = None
    regression: float | None = None
    posterior: float | None = None


def draw_discrepancy(groups: Sequence[DiscrepancyGroup], *, title: str) -> Figure:
    """Mean |Δ| of θ* and its posterior compared with rivals.

    The rivals are the uncalibrated θ, random θ (median, quartiles), the mean of the training pours, and the regression.

    Args:
        groups: sets of pours; values are fractions (0 … 1), shown in percent.
        title: title of the figure.

    Raises:
        ValueError: no group.
    """
    if not groups:
        raise ValueError("discrepancy figure: no set of pours was scored")
    figure, axes = style.new_figure(size=(2.2 + 2.5 * len(groups), 4.4))
    width = 0.17
    named: set[str] = set()
    top, left, middles = 0.0, 0.0, []
    for group in groups:
        every: list[tuple[str, float | None, str, tuple[float, float] | None]] = [
            ("calibrated simulator θ*", group.calibrated, style.BEST, None),
            ("mean over θ's posterior", group.posterior, style.POSTERIOR, None),
            ("uncalibrated simulator", group.uncalibrated, style.PREDICTED, None),
            (*_random(group.random),),
            ("mean of training pours", group.mean_predictor, style.PALE, None),
            ("GP regression, no simulator", group.regression, style.FALLING, None),
        ]
        bars = [(name, value, colour, spread) for name, value, colour, spread in every if value is not None]
        middles.append(left + 0.5 * (len(bars) - 1) * width)
        for slot, (name, value, colour, quartiles) in enumerate(bars):
            x = left + slot * width
            error = None if quartiles is None else 100 * np.array([[value - quartiles[0]], [quartiles[1] - value]])
            axes.bar(
                x,
                100 * value,
                width * 0.9,
                color=colour,
                yerr=error,
                ecolor=style.INK,
                capsize=3,
                error_kw={"elinewidth": 1.0},
                label=None if name in named else name,
            )
            named.add(name)
            peak = 100 * (value if quartiles is None else max(value, quartiles[1]))
            top = max(top, peak)
            axes.annotate(
                f"{100 * value:.1f}",
                (x, peak),
                xytext=(0, 3),
                textcoords="offset points",
                ha="center",
                fontsize=8.5,
                color=style.INK,
                fontweight="bold" if slot == 0 else "normal",
            )
        left += (len(bars) + 1.5) * width  # a set of pours is as wide as the number of its predictors
    style.dress(axes, title=title, y="mean |measured − predicted| spillage [%]")
    axes.set_ylim(0.0, 1.12 * top or 1.0)
    axes.set_xlim(-1.5 * width, left - width)
    axes.set_xticks(middles, [f"{g.name}\n{g.pours} pour{'s' * (g.pours != 1)}" for g in groups], fontsize=9.5)
    axes.tick_params(axis="x", length=0)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def _random(values: Sequence[float]) -> tuple[str, float | None, str, tuple[float, float] | None]:
    if not len(values):
        return "random θ", None, style.GREY, None
    name = "random θ (median, quartiles)" if len(values) > 1 else "random θ (median)"
    quartiles = (float(np.percentile(values, 25)), float(np.percentile(values, 75))) if len(values) > 1 else None
    return name, float(np.median(values)), style.GREY, quartiles
