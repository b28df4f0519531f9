"""Rows of a campaign's learning: losses and predictions, surrogates, θ, and the model check of the simulator.

`LearningStage` writes curves and pictures; `map_images` draws the pictures.
"""

from __future__ import annotations

from collections.abc import Callable

from actors.optimizer.questions import SpaceFillingQuery
from orchestrator.live_view import map_images as pictures
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.recording_sink import RecordingSink
from orchestrator.requests import Pour, Poured, Suggest, Suggested
from orchestrator.results import figure_style as style
from orchestrator.results.figure_style import safe_name
from orchestrator.results.loss_units import (
    DISCREPANCY,
    at_least_nothing,
    deployment_unit,
    is_calibration,
    loss_of_pour,
    unit_of_pour,
)
from orchestrator.results.stage_views import receiver_names
from orchestrator.runs.events import RequestFinished
from orchestrator.strategies.calibration.calibration_base import Calibrated
from orchestrator.strategies.campaign_plan import CampaignPlan
from orchestrator.strategies.deployment.deployment_result import Deployed
from orchestrator.strategies.deployment.model_monitoring import Believed
from orchestrator.strategies.stage_result import StageResult
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.prediction_band import LEVEL

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
        import rerun as rr

        self._rr, self._sink, self._plan = rr, sink, plan
        self._names = receiver_names(plan)
        self._styled: set[str] = set()
        self._scene_of_stage: dict[str, str] = {}
        self._drawn: dict[str, float] = {}
        self._waiting: dict[str, Callable[[], bytes]] = {}
        self._least: dict[str, float] = {}
        self.best: dict[str, str] = {}
        """Text for the best pour so far, by the receiver's name."""
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

    def _coming(self, place: str, text: str) -> None:
        picture = pictures.png(pictures.words(text))
        self._sink.log(f"{PLACE}/{place}", self._rr.EncodedImage(contents=picture, media_type="image/png"))

    def about(self, stage: str, scene: str) -> None:
        """Associate a stage with a scene."""
        self._scene_of_stage[stage] = scene

    def poured(self, request: Pour, outcome: Poured) -> str:
        """Log a weighed pour; return a description."""
        measured, unit = outcome.measurement, unit_of_pour(self._plan, request)
        value = loss_of_pour(self._plan, request, measured)
        weights = f"{1e3 * measured.spilled:.1f} g spilled, {1e3 * measured.retained:.1f} g left in the pourer"
        if value is None:
            return f"pour {request.number}: too little was poured for a loss ({weights})"
        calibrating = is_calibration(self._plan, request)
        place = f"{PLACE}/{CALIBRATION if calibrating else safe_name(request.scene)}/loss"
        shown = unit.factor * value
        self._number(f"{place}/measured", shown, f"measured [{unit.unit}]", style.MEASURED, marker=9.0)
        if request.predicted is not None:
            mean = unit.factor * at_least_nothing(request.predicted.mean)
            self._number(f"{place}/predicted", mean, f"predicted [{unit.unit}]", style.PREDICTED)
            for name, end in zip(("low", "high"), request.predicted.of_a_pour(), strict=True):
                label = f"{100 * LEVEL:.0f} % band, {'upper' if name == 'high' else 'lower'} end [{unit.unit}]"
                self._number(f"{place}/predicted_{name}", unit.factor * end, label, "#f0c27a", width=1.5)
        name = self._names.get(request.scene, request.scene)
        if not calibrating:
            self._best(request.scene, place, shown, unit.unit, name)
        return f"pour {request.number} of {name}: {shown:.2f} {unit.unit} ({weights})"

    def _best(self, scene: str, place: str, shown: float, unit: str, name: str) -> None:
        self._least[scene] = least = min(shown, self._least.get(scene, shown))
        self._number(f"{place}/best", least, f"best so far [{unit}]", style.GOOD)
        self.best[name] = f"{least:.2f} {unit}"

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
        known = f"{len(query.data)} observations"
        if simulations := len(pictures.simulated_points(query)):
            known = f"{len(query.data)} pours and {simulations} simulations"
        title = f"{subject}: what is known after {known}"
        self._picture(
            f"{PLACE}/{where}/surrogate",
            event.time,
            lambda: pictures.png(pictures.surrogate_picture(query, suggestion, unit, title)),
        )
        if query.space.dimension > MAPPED:
            self._picture(
                f"{PLACE}/{where}/slices",
                event.time,
                lambda: pictures.png(pictures.slices_picture(query, suggestion, unit, title)),
                SLICING_INTERVAL,
            )

    def learnt(self, result: StageResult, now: float) -> None:
        """Log the current result of a strategy."""
        if isinstance(result, Calibrated) and result.found is not None:
            found = result.found
            if found.searched:
                draw = f"{PLACE}/{CALIBRATION}/theta"
                self._picture(draw, now, lambda: pictures.png(pictures.theta_picture(found)))
        if isinstance(result, Deployed):
            place = f"{PLACE}/{safe_name(result.scene)}/trust"
            if isinstance(result.trust, Believed):
                self.trust = result.trust.text
                if result.trust.after:
                    share = result.trust.after[-1].ignorance
                    label = "probability that the simulator says nothing of this bench"
                    self._number(place, share, label, style.ESCAPED, marker=8.0)
            elif result.trust.z_scores:
                z = result.trust.z_scores[-1]
                label = "worse than simulated by so many σ (2 and more: distrust)"
                self._number(place, z, label, style.ESCAPED, marker=8.0)

    def flush(self, now: float) -> None:
        """Draw the pictures that were postponed."""
        for entity, draw in list(self._waiting.items()):
            self._draw(entity, now, draw)

    def _picture(self, entity: str, now: float, draw: Callable[[], bytes], interval: float = DRAWING_INTERVAL) -> None:
        if now - self._drawn.get(entity, -interval) < interval:
            self._waiting[entity] = draw
            return
        self._draw(entity, now, draw)

    def _draw(self, entity: str, now: float, draw: Callable[[], bytes]) -> None:
        self._waiting.pop(entity, None)
        self._drawn[entity] = now
        self._sink.log(entity, self._rr.EncodedImage(contents=draw(), media_type="image/png"))

    def _number(
        self, entity: str, value: float, name: str, colour: str, *, marker: float = 0.0, width: float = 3.0
    ) -> None:
        if entity not in self._styled:
            self._styled.add(entity)
            appearance = (
                self._rr.SeriesPoints(names=name, colors=shapes.rgb(colour), marker_sizes=marker)
                if marker
                else self._rr.SeriesLines(names=name, colors=shapes.rgb(colour), widths=width)
            )
            self._sink.log(entity, appearance, static=True)
        self._sink.number(entity, float(value))
