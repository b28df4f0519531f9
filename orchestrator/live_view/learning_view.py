"""Rows and pictures of a campaign's learning: losses and predictions, surrogates, θ, and the model check.

`LearningStage` writes curves and pictures. `surrogate_picture` and `slices_picture` draw those of surrogates, since
Rerun has no plot type for them; `png` encodes them. The posterior of θ is that of the report.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from actors.optimizer.questions import (
    Point,
    PourQuery,
    SpaceFillingQuery,
    Suggestion,
    SurrogateQuery,
)
from actors.optimizer.suggest import slices
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.campaign_plan import CampaignPlan, receiver_names
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.model_monitoring import Believed
from orchestrator.learning.requests import Suggest, Suggested
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import plural
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.machine_view import OUTCOME
from orchestrator.live_view.recording_sink import RecordingSink
from orchestrator.records.events import RequestFinished
from orchestrator.records.run_record import RunPour
from orchestrator.reports import figure_style as style
from orchestrator.reports.figure_style import safe_name
from orchestrator.reports.loss_units import (
    DISCREPANCY,
    LossUnit,
    at_least_nothing,
    deployment_unit,
    loss_of_pour,
    unit_of_pour,
)
from orchestrator.reports.progress_state import Best
from orchestrator.reports.summarise import pour_summary
from orchestrator.reports.surrogate_figures import draw_posterior
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.outcome import PourMeasurement
from sim_engine.prediction_band import LEVEL
from sim_engine.search_space import Axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


PLACE = "/learning"

CALIBRATION = "calibration"

MAPPED = 2
"""Number of axes that one picture shows; for more axes, a second picture shows all pairs."""

SLICING_INTERVAL = 180.0
"""Like `DRAWING_INTERVAL`, for pictures that need another fit of the surrogate [s]."""

DRAWING_INTERVAL = 60.0
"""Shortest time between two drawings of one picture, except at the end of a stage [s]. A drawing takes 0.25 s of a
core; the average load should be about a hundredth of it.
"""


class LearningStage:
    """Writes rows and pictures of the learning progress. For one thread.

    Args:
        sink: sink of the rows.
        plan: plan of the campaign.
    """

    def __init__(self, sink: RecordingSink, plan: CampaignPlan) -> None:
        self._sink, self._plan = sink, plan
        self._names = receiver_names(plan)
        self._styled: set[str] = set()
        self._scene_of_stage: dict[str, str] = {}
        self._drawn: dict[str, float] = {}
        self._waiting: dict[str, Callable[[], bytes]] = {}
        self._newest: dict[str, bytes] = {}
        self.trust = ""
        """Result of the model check, as text."""

    def opened(self) -> None:
        """Show placeholders at the start of a campaign, which state when each picture follows."""
        plan = self._plan
        if plan.calibration is not None:
            self._coming(f"{CALIBRATION}/surrogate", "The discrepancy over θ comes with the first simulations.")
            self._coming(f"{CALIBRATION}/theta", "θ* comes when the calibration ends.")
            if plan.calibration.parameters.dimension > MAPPED:
                self._coming(f"{CALIBRATION}/slices", "Slices come with the first simulations.")
        for scene in plan.deployment.scenes if plan.deployment is not None else ():
            place, name = safe_name(scene.name), self._names[scene.name]
            self._coming(f"{place}/surrogate", f"{name}: nothing was simulated or poured yet.")
            if plan.deployment is not None and plan.deployment.actions.dimension > MAPPED:
                self._coming(f"{place}/slices", f"{name}: nothing was simulated or poured yet.")
        self._keep()

    def _coming(self, place: str, text: str) -> None:
        self._show(f"{PLACE}/{place}", png(words(text)))

    def about(self, stage: str, scene: str) -> None:
        """Associate a stage with a scene."""
        self._scene_of_stage[stage] = scene

    def poured(self, pour: RunPour, measured: PourMeasurement, best: Best | None) -> str:
        """Log a weighed pour and the best one into its receiver; return a description."""
        request, unit, told = pour.request, unit_of_pour(self._plan, pour.request), pour_summary(self._plan, pour)
        value = loss_of_pour(self._plan, request, measured)
        if value is None:
            return told.line
        place = f"{PLACE}/{CALIBRATION if told.calibration else safe_name(request.scene)}/loss"
        shown = unit.factor * value
        self._number(f"{place}/measured", shown, f"measured [{unit.unit}]", style.MEASURED, marker=9.0)
        if request.predicted is not None:
            mean = unit.factor * at_least_nothing(request.predicted.mean)
            self._number(f"{place}/predicted", mean, f"predicted [{unit.unit}]", style.PREDICTED)
            for name, end in zip(("low", "high"), request.predicted.of_a_pour(), strict=True):
                label = f"{100 * LEVEL:.0f} % interval, {'upper' if name == 'high' else 'lower'} end [{unit.unit}]"
                self._number(f"{place}/predicted_{name}", unit.factor * end, label, "#f0c27a", width=1.5)
        if best is not None and not told.calibration:
            self._number(f"{place}/best", unit.factor * best.loss, f"best so far [{unit.unit}]", style.GOOD)
        return told.line

    def suggested(self, event: RequestFinished, request: Suggest, outcome: Suggested) -> None:
        """Draw the surrogate of a suggestion, unless it was drawn recently."""
        query, suggestion = request.query, outcome.suggestion
        if suggestion.surrogate is None or isinstance(query, SpaceFillingQuery):
            return
        # A space of actions belongs to the stage's receiver, a space of parameters to the calibration.
        acting = query.space.names[0] in ACTION_DIMENSIONS
        scene = self._scene_of_stage.get(event.stage)
        deploying = acting and scene is not None and self._plan.deployment is not None
        where = safe_name(scene or "") if deploying else CALIBRATION
        unit = DISCREPANCY
        if deploying and self._plan.deployment is not None:
            unit = deployment_unit(self._plan.deployment)
        subject = self._names.get(scene or "", scene or "") if deploying else "θ"
        observed = plural(len(query.data), "observation")
        if simulations := len(simulated_points(query)):
            observed = f"{plural(len(query.data), 'pour')} and {plural(simulations, 'simulation')}"
        title = f"{subject}: estimates after {observed}"
        self._picture(
            f"{PLACE}/{where}/surrogate",
            event.time,
            lambda: png(surrogate_picture(query, suggestion, unit, title)),
        )
        if query.space.dimension > MAPPED:
            self._picture(
                f"{PLACE}/{where}/slices",
                event.time,
                lambda: png(slices_picture(query, suggestion, unit, title)),
                SLICING_INTERVAL,
            )

    def learnt(self, result: StageResult, now: float) -> None:
        """Log the current result of a strategy."""
        if isinstance(result, Calibrated) and result.found is not None and self._plan.calibration is not None:
            theta, space = result.found.theta.model_dump(), self._plan.calibration.parameters
            draw = partial(words, f"θ*: {style.display_values({name: theta[name] for name in space.names})}")
            if (posterior := result.found.posterior) is not None:
                draw = partial(draw_posterior, posterior, space, theta)
            self._picture(f"{PLACE}/{CALIBRATION}/theta", now, lambda: png(draw()))
        if isinstance(result, Deployed):
            place = f"{PLACE}/{safe_name(result.scene)}/trust"
            if isinstance(result.model_check, Believed):
                self.trust = result.model_check.text
                if result.model_check.after:
                    share = result.model_check.after[-1].ignorance
                    label = "probability that the simulator does not describe this bench"
                    self._number(place, share, label, style.ESCAPED, marker=8.0)
            elif result.model_check.z_scores:
                z = result.model_check.z_scores[-1]
                label = "standard deviations above the prediction (2 or more: warning)"
                self._number(place, z, label, style.ESCAPED, marker=8.0)

    def flush(self, now: float) -> None:
        """Draw the pictures that were postponed, and keep the newest ones for a replay."""
        for entity, draw in list(self._waiting.items()):
            self._draw(entity, now, draw)
        self._keep()

    def _keep(self) -> None:
        """Log the newest pictures for every position of a viewer's time cursor: a replay begins at 0, where the
        timelines have none yet."""
        for entity, picture in self._newest.items():
            image = rr.EncodedImage(contents=picture, media_type="image/png")
            self._sink.log(f"{OUTCOME}{entity}", image, static=True)
        self._newest.clear()

    def _picture(self, entity: str, now: float, draw: Callable[[], bytes], interval: float = DRAWING_INTERVAL) -> None:
        if now - self._drawn.get(entity, -interval) < interval:
            self._waiting[entity] = draw
            return
        self._draw(entity, now, draw)

    def _draw(self, entity: str, now: float, draw: Callable[[], bytes]) -> None:
        self._waiting.pop(entity, None)
        self._drawn[entity] = now
        self._show(entity, draw())

    def _show(self, entity: str, picture: bytes) -> None:
        self._newest[entity] = picture
        self._sink.log(entity, rr.EncodedImage(contents=picture, media_type="image/png"))

    def _number(
        self, entity: str, value: float, name: str, colour: str, *, marker: float = 0.0, width: float = 3.0
    ) -> None:
        if entity not in self._styled:
            self._styled.add(entity)
            appearance = (
                rr.SeriesPoints(names=name, colors=shapes.rgb(colour), marker_sizes=marker)
                if marker
                else rr.SeriesLines(names=name, colors=shapes.rgb(colour), widths=width)
            )
            self._sink.log(entity, appearance, static=True)
        self._sink.number(entity, float(value))


FloatArray = NDArray[np.float64]

_DPI = 80


def simulated_points(query: SurrogateQuery) -> tuple[Point, ...]:
    """Simulated observations of a query; empty if its type has none."""
    return query.simulated.points if isinstance(query, PourQuery) else ()


def png(figure: Figure) -> bytes:
    """Encode a figure as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    figure.set_dpi(_DPI)
    # `savefig` would draw it twice, the first time for layouts that PNG does not need.
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]
    return buffer.getvalue()


def surrogate_picture(query: SurrogateQuery, suggestion: Suggestion, unit: LossUnit, title: str) -> Figure:
    """Draw mean, deviation and lower bound of a surrogate over two axes, with observations and the next points.

    Args:
        query: suggestion query.
        suggestion: result with a surrogate.
        unit: unit of the cost.
        title: title of the picture.
    """
    assert suggestion.surrogate is not None
    surrogate, space = suggestion.surrogate, query.space
    plane = surrogate.plane(space)
    mean, deviation = (unit.factor * np.asarray(grid, float) for grid in (surrogate.mean, surrogate.deviation))
    bound = mean - query.kappa * deviation
    figure, axes = style.new_figure(1, 3, size=(15.0, 5.2), layout=None)
    figure.subplots_adjust(left=0.065, right=0.955, bottom=0.13, top=0.85, wspace=0.18)
    held = style.display_values(dict(surrogate.held(space)))
    figure.suptitle(f"{title}{f'   (held: {held})' if held else ''}", fontsize=17, color=style.INK, x=0.01, ha="left")
    panels = (
        (f"expected {unit.label}", np.maximum(mean, 0.0), "viridis_r"),
        (f"± σ [{unit.unit}]", deviation, "cividis"),
        (f"lower bound, mean − {query.kappa:g} σ [{unit.unit}]", bound, "viridis_r"),
    )
    across, up = plane.axes
    for panel, (name, values, colours) in zip(axes, panels, strict=True):
        mesh = _cut(panel, query, suggestion, plane.axes, values, cmap=colours)
        bar = figure.colorbar(mesh, ax=panel, pad=0.03, fraction=0.06)
        bar.ax.tick_params(labelsize=13)
        panel.set_title(name, fontsize=14, loc="left", color=style.INK)
        panel.set_xlabel(style.label(across.name), fontsize=14)
        panel.tick_params(labelsize=13, labelleft=panel is axes[0])
    axes[0].set_ylabel(style.label(up.name), fontsize=14)
    figure.text(0.955, 0.98, _key(query, suggestion), fontsize=14, color=style.INK, ha="right", va="top")
    return figure


def slices_picture(query: SurrogateQuery, suggestion: Suggestion, unit: LossUnit, title: str) -> Figure:
    """Draw a surrogate over each pair of axes: mean below the diagonal, deviation above it, with data and next points.

    Args:
        query: suggestion query with more than two axes.
        suggestion: result with a surrogate.
        unit: unit of the cost.
        title: title of the picture.
    """
    maps = slices(query, suggestion)
    names = [name for name in query.space.names if any(name in plane.axes for plane in maps)]
    if not names:
        return words(f"{title}: too little for slices")
    axis_of = dict(zip(query.space.names, query.space.axes, strict=True))
    figure, axes = style.new_figure(len(names), len(names), size=(15.0, 9.0), squeeze=False)
    figure.suptitle(title, fontsize=17, color=style.INK, x=0.01, ha="left")
    means = [unit.factor * np.maximum(np.asarray(plane.mean, float), 0.0) for plane in maps]
    deviations = [unit.factor * np.asarray(plane.deviation, float) for plane in maps]
    meshes: dict[str, Any] = {}
    for plane, mean, deviation in zip(maps, means, deviations, strict=True):
        low, high = (names.index(name) for name in plane.axes)
        # Below the diagonal, the first axis is horizontal; above it, the panel is transposed.
        for kind, (row, column), values, every, colours in (
            ("mean", (high, low), mean, means, "viridis_r"),
            ("sd", (low, high), deviation.T, deviations, "cividis"),
        ):
            panel, across, up = axes[row, column], axis_of[names[column]], axis_of[names[row]]
            span = {"vmin": min(float(v.min()) for v in every), "vmax": max(float(v.max()) for v in every)}
            meshes[kind] = _cut(panel, query, suggestion, (across, up), values, 0.6, cmap=colours, **span)
            panel.tick_params(labelsize=12, labelbottom=row == len(names) - 1, labelleft=column == 0)
    for place, name in enumerate(names):
        axes[place, place].axis("off")
        axes[place, place].text(0.5, 0.5, style.label(name).replace(" [", "\n["), ha="center", va="center", fontsize=15)
        if place:
            axes[place, 0].set_ylabel(style.label(name), fontsize=13)
        if place < len(names) - 1:
            axes[-1, place].set_xlabel(style.label(name), fontsize=13)
    for kind, text in (("mean", f"below: expected {unit.label}"), ("sd", f"above: ± σ [{unit.unit}]")):
        bar = figure.colorbar(meshes[kind], ax=axes, pad=0.01, aspect=40)
        bar.set_label(text, fontsize=13)
        bar.ax.tick_params(labelsize=12)
    held = style.display_values(dict(query.space.decode(maps[0].at)))
    figure.supxlabel(f"each cut goes through {held}      {_key(query, suggestion)}", fontsize=13, color=style.INK)
    return figure


def _key(query: SurrogateQuery, suggestion: Suggestion) -> str:
    marks = ["○ poured   ∘ simulated" if simulated_points(query) else "○ observed"]
    return "   ".join([*marks, "★ next"] if suggestion.points else marks)


def words(text: str) -> Figure:
    """Draw a line of text as placeholder."""
    figure, axes = style.new_figure(size=(15.0, 5.2))
    axes.axis("off")
    axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=26, color=style.GREY)
    return figure


def _cut(
    panel: Axes, query: SurrogateQuery, suggestion: Suggestion, plane: Sequence[Axis], values: FloatArray,
    size: float = 1.0, **colours: Any,
) -> Any:  # fmt: skip
    """Draw a map over two axes with simulations, observations and the next points; `size` is that of their marks."""
    scales = [style.display_factor(axis.name) for axis in plane]
    places = np.linspace(0.0, 1.0, len(values))
    grid = [[axis.decode(u) / scale for u in places] for axis, scale in zip(plane, scales, strict=True)]
    mesh = panel.pcolormesh(*grid, values, shading="nearest", zorder=0, rasterized=True, **colours)
    columns = [query.space.names.index(axis.name) for axis in plane]
    marks: tuple[tuple[Sequence[Point], float, dict[str, Any]], ...] = (
        (simulated_points(query), 14, {"marker": "o", "facecolor": "none", "edgecolor": style.INK}),
        (query.data.points, 55, {"marker": "o", "facecolor": "white", "edgecolor": style.INK}),
        (suggestion.points, 330, {"marker": "*", "facecolor": style.BEST, "edgecolor": "white"}),
    )
    for points, area, look in marks:
        if points:
            xs, ys = (
                [axis.decode(point[column]) / scale for point in points]
                for axis, column, scale in zip(plane, columns, scales, strict=True)
            )
            panel.scatter(xs, ys, s=size * area, linewidth=1.2, zorder=4, **look)
    style.frame(panel, plane[0], "x")
    style.frame(panel, plane[1], "y")
    return mesh
