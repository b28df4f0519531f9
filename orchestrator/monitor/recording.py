"""A campaign's recording: events in, Rerun rows out."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.events import (
    CampaignClosed,
    CampaignOpened,
    CampaignStateChanged,
    DecisionMade,
    Event,
    LogLine,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StageClosed,
    StageOpened,
    StrategyProgressed,
)
from orchestrator.monitor.streams import Streams
from orchestrator.plan import CampaignPlan
from orchestrator.report import style
from orchestrator.report.names import receiver_names
from orchestrator.report.style import safe_name
from orchestrator.report.units import (
    DISCREPANCY,
    at_least_nothing,
    deployment_unit,
    is_calibration,
    loss_of_pour,
    unit_of_pour,
)
from orchestrator.requests import Failed, Pour, Poured, Simulate, Simulated, Suggest, Suggested
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.task import Scene

if TYPE_CHECKING:
    from orchestrator.report.section import Solid
    from sim_engine.vessel.spec import VesselSpec


@functools.lru_cache(maxsize=16)
def solid(spec: VesselSpec) -> Solid:
    """The surface of a vessel, built once."""
    from sim_engine.vessel.build import build_vessel

    return build_vessel(spec)


class CampaignRecording:
    """Knows what each event means in a recording. For one thread.

    Args:
        path: `.rrd` to write.
        plan: of the campaign.
        url: of a Rerun server that gets the same; '' for none.
    """

    def __init__(self, path: Path, plan: CampaignPlan, *, url: str = "") -> None:
        scenes = plan.deployment.scenes if plan.deployment is not None else ()
        unit = deployment_unit(plan.deployment) if plan.deployment is not None else DISCREPANCY
        names = receiver_names(plan)
        receivers = {scene.name: names[scene.name] for scene in scenes}
        self.path, self._plan = path, plan
        self.streams = Streams(path, name=plan.name, receivers=receivers, loss_label=unit.label, url=url)
        self._scenes: dict[str, Scene] = {}
        if plan.calibration is not None:
            for records in (plan.calibration.records, plan.calibration.transfer):
                if records is not None:
                    self._scenes[records.scene.name] = records.scene
            self._scenes[plan.calibration.scene.name] = plan.calibration.scene
        if plan.deployment is not None:
            self._scenes.update({scene.name: scene for scene in plan.deployment.scenes})
        self._names = receiver_names(plan)
        self._scene_of_stage: dict[str, str] = {}
        self._best: dict[str, float] = {}
        self._running: set[int] = set()
        self._pours = self._simulations = 0
        self._about: dict[str, str] = {"campaign": plan.name}

    @property
    def next_due(self) -> float | None:
        """When `play` has something to do next [s since 1970]; None: nothing is planned."""
        return None

    def play(self, now: float) -> None:
        """Write what is due by now."""

    def close(self, dropped: int = 0) -> None:
        """Complete the recording; `dropped` events never came."""
        if dropped:
            self._say(f"{dropped} events are missing: the recording could not keep up", "warning", "recording")
        self.streams.close()

    def handle(self, event: Event) -> None:
        """Take note of an event."""
        self.streams.at(wall=event.time, pour=self._pours)
        match event:
            case CampaignOpened():
                self._about["mode"] = event.mode
                self._about["stages"] = ", ".join(event.stages)
                self._about["simulators"] = str(event.simulators)
                self._say(f"{event.name}: {'goes on' if event.resumed else 'begins'}, mode {event.mode}")
                self._page()
            case CampaignStateChanged():
                self._about["state"] = event.after
                self._say(f"{event.before} → {event.after}{': ' + event.reason if event.reason else ''}")
                self._page()
            case CampaignClosed():
                self._about["state"] = event.state
                self._say(f"ended: {event.state}")
                self._page()
            case StageOpened():
                self._about["stage"] = f"{event.stage} ({event.index}/{event.count})"
                self._say(f"stage {event.stage} begins", source=event.stage)
                self._page()
            case StageClosed():
                self._say(f"stage {event.stage} done", source=event.stage)
            case RequestStarted():
                self._started(event)
            case RequestFinished():
                self._finished(event)
            case PourProgressed():
                progress = event.progress
                if progress.tilt is not None:
                    tilt = progress.tilt / ACTION_DIMENSIONS["max_angle"].factor
                    self.streams.number("/laboratory/tilt", tilt, name="tilt [deg]", colour=style.POURER)
                if progress.balance is not None:
                    self.streams.number(
                        "/laboratory/balance", progress.balance * 1e3, name="balance [g]", colour=style.SPILLED
                    )
                if self._about.get("pour") != (now := f"{event.number}: {progress.checkpoint}"):
                    self._about["pour"] = now
                    self._page()
            case StrategyProgressed():
                self._about[f"progress of {event.stage}"] = str(event.progress)
                self._page()
            case DecisionMade():
                self._say(event.decision.text, source=event.stage)
            case LogLine():
                self._say(event.text, event.level, event.stage)

    def _say(self, text: str, level: str = "info", source: str = "") -> None:
        self.streams.line(text, level, safe_name(source or "campaign"))

    def _page(self) -> None:
        cells = [(name, value.replace("|", "\\|")) for name, value in self._about.items()]  # |Δ| is not a border
        rows = "\n".join(f"| {name} | {value} |" for name, value in cells)
        self.streams.page("/state", f"| | |\n|---|---|\n{rows}\n")

    def _pool(self) -> None:
        self.streams.number(
            "/laboratory/simulators_busy", len(self._running), name="simulators busy", colour=style.FALLING
        )

    def _started(self, event: RequestStarted) -> None:
        match event.request:
            case Simulate():
                self._running.add(event.id)
                self._pool()
            case Pour() as pour:
                expected = ""
                if pour.predicted is not None:
                    unit = unit_of_pour(self._plan, pour)
                    expected = f", predicted {unit.text(pour.predicted.mean, pour.predicted.deviation)}"
                self._say(f"pour {pour.number}: {self._action(pour)}{expected}", source=event.stage)

    def _finished(self, event: RequestFinished) -> None:
        if isinstance(event.outcome, Failed):
            self._running.discard(event.id)
            self._say(f"{event.outcome.kind}: {event.outcome.reason}", "warning", event.stage)
            return
        match event.request, event.outcome:
            case Simulate() as request, Simulated() as outcome:
                self._running.discard(event.id)
                self._simulations += 1
                self._scene_of_stage[event.stage] = request.scene
                self._about["simulations"] = str(self._simulations)
                self._pool()
                self._simulated(event, request, outcome)
            case Pour() as request, Poured() as outcome:
                self._scene_of_stage[event.stage] = request.scene
                self._poured(event, request, outcome)
            case Suggest() as request, Suggested() as outcome:
                self._suggested(event, request, outcome)

    def _simulated(self, event: RequestFinished, request: Simulate, outcome: Simulated) -> None:
        result = outcome.outcome
        if result.invalid is not None:
            self._say(f"simulation {event.id} is not valid: {result.invalid}", "warning", event.stage)
        if event.frames is None:
            return
        scene = self._scenes[request.scene]
        self._say(
            f"recorded simulation {event.id} ({request.purpose}): {request.action.display('angular_velocity')}, "
            f"{100 * result.spilled:.1f} % spilled, {result.particles} particles",
            source=event.stage,
        )
        self.streams.film(
            event.frames,
            (scene.pourer, solid(scene.pourer)),
            (scene.receiver, solid(scene.receiver)),
            radius=0.5 * result.spacing,
        )

    def _poured(self, event: RequestFinished, request: Pour, outcome: Poured) -> None:
        self._pours += 1
        self.streams.at(wall=event.time, pour=self._pours)
        measured = outcome.measurement
        unit = unit_of_pour(self._plan, request)
        value = loss_of_pour(self._plan, request, measured)
        calibrating = is_calibration(self._plan, request)
        place = "/calibration/loss" if calibrating else f"/pours/{safe_name(request.scene)}"
        if value is None:
            self._say(f"pour {request.number}: too little was poured for a loss", "warning", event.stage)
            return
        shown = unit.factor * value
        self.streams.number(f"{place}/measured", shown, name="measured", colour=style.MEASURED, points=True)
        if request.predicted is not None:
            mean = unit.factor * at_least_nothing(request.predicted.mean)
            sigma = unit.factor * request.predicted.deviation
            self.streams.number(f"{place}/predicted", mean, name="predicted", colour=style.PREDICTED)
            self.streams.number(
                f"{place}/predicted_low", max(mean - 2 * sigma, 0.0), name="predicted − 2 σ", colour=style.PALE
            )
            self.streams.number(f"{place}/predicted_high", mean + 2 * sigma, name="predicted + 2 σ", colour=style.PALE)
        if not calibrating:
            best = min(shown, self._best.get(request.scene, shown))
            self._best[request.scene] = best
            self.streams.number(f"{place}/best", best, name="best so far", colour=style.BEST)
            self._about[f"best of {self._name(request.scene)}"] = f"{best:.2f} {unit.unit}"
        self._say(
            f"pour {request.number} of {self._name(request.scene)}: {shown:.2f} {unit.unit} "
            f"({1e3 * measured.spilled:.1f} g spilled, {1e3 * measured.retained:.1f} g retained)",
            source=event.stage,
        )
        self._page()

    def _suggested(self, event: RequestFinished, request: Suggest, outcome: Suggested) -> None:
        problem, suggestion = request.problem, outcome.suggestion
        if suggestion.surrogate is None:
            return
        # A space of actions belongs to the receiver in question, one of simulation parameters to the calibration.
        acting = problem.space.names[0] in ACTION_DIMENSIONS
        scene = self._scene_of_stage.get(event.stage)
        place = f"/maps/{safe_name(scene)}" if acting and scene is not None else "/maps/calibration"
        unit = deployment_unit(self._plan.deployment) if acting and self._plan.deployment else DISCREPANCY
        said = self.streams.surrogate(place, problem.space, suggestion.surrogate, problem.data.points, unit.factor)
        self._about[f"map {self._name(scene) if acting and scene is not None else 'calibration'}"] = (
            f"{unit.label}: {said}"
        )
        self._page()

    def _name(self, scene: str) -> str:
        return self._names.get(scene, scene)

    def _action(self, pour: Pour) -> str:
        plan = self._plan.calibration if is_calibration(self._plan, pour) else self._plan.deployment
        return pour.action.display(*(plan.actions.names if plan is not None else ()))
