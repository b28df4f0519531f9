"""A campaign's recording: converts events to Rerun rows.

`CampaignRecording` passes each event to the views of cell, balance, learning, machine and simulations. There are three
timelines:

- `wall`: wall clock; an event has the time at which it became known.
- `step`: number of finished requests.
- `sim_time`: simulated time, on which the playbacks of simulations and pours follow one another.
"""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from actors.laboratory_settings import MODE_LABELS
from orchestrator.learning.campaign_plan import CampaignPlan, receiver_names
from orchestrator.learning.dispense import Dispensed
from orchestrator.learning.requests import Failed, Pour, Poured, Request, Simulate, Simulated, Suggest, Suggested
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.balance_view import BalanceStage
from orchestrator.live_view.blueprints import Moment, campaign_blueprint
from orchestrator.live_view.cell_view import CellScene
from orchestrator.live_view.learning_view import MAPPED, LearningStage
from orchestrator.live_view.machine_view import MachineView, status_page
from orchestrator.live_view.recording_sink import PlaybackQueue, RecordingSink
from orchestrator.live_view.simulation_view import SimulatedStage
from orchestrator.records.events import (
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
from orchestrator.records.run_clock import run_time
from orchestrator.reports.loss_units import DISCREPANCY, deployment_unit, is_calibration, unit_of_pour
from orchestrator.reports.mixture_report import draw_rack, mixed_liquids, mixtures_so_far
from orchestrator.reports.progress_state import ProgressState
from orchestrator.runs.stages import scenes_of


class CampaignRecording:
    """Handles the events of a campaign. For one thread.

    Args:
        path: `.rrd` to write.
        plan: plan of the campaign.
        url: URL of a Rerun server that gets the same rows; '' for none.

    Raises:
        OSError: the file can't be written.
    """

    def __init__(self, path: Path, plan: CampaignPlan, *, url: str = "") -> None:
        self.path, self._plan = path, plan
        self._scenes = scenes_of(plan)
        self._progress, reality = ProgressState(plan), MODE_LABELS[plan.laboratory.mode]
        sink = self._sink = RecordingSink(
            path, application=f"decant {plan.name}", name=f"{plan.name} · {reality}", url=url
        )
        self._moment: Moment | None = None
        sink.keep(blueprint_of(plan, "replaying"))
        self._show("calibrating" if plan.calibration is not None else "deploying")
        sink.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        sink.times(step=0, sim_time=0.0)
        self._films = PlaybackQueue(sink)
        self._simulated = SimulatedStage(sink, self._films)
        self._cell = CellScene(sink, self._films, plan)
        self._balance = BalanceStage(sink, self._cell.time_scale)
        self._learning = LearningStage(sink, plan)
        self._machine = MachineView(sink, self._progress.run)
        self._machine.outcome(
            f"# {reality}: no end\n\nThe run is under way, or its process was killed before it ended.\n"
        )
        self._step = 0
        self._decided = ""
        self._mixtures: Dispensed | None = None

    @property
    def wait(self) -> float | None:
        """Time until `play` has work to do [s]; None if it must wait for events."""
        film = self._films.next_due
        waits = (None if film is None else max(film - run_time(), 0.0), self._sink.wait)
        return min((each for each in waits if each is not None), default=None)

    def play(self) -> None:
        """Write everything that is due. Call it about every half second rather than after each event."""
        self._films.play(run_time())
        self._cell.show()
        self._sink.send()

    def close(self, dropped: int = 0) -> None:
        """Complete the recording; `dropped` is the number of missing events."""
        self._films.play(float("inf"))
        self._cell.show()
        if dropped:
            self.missed(dropped)
            self._machine.line(f"{dropped} events are missing: the recording could not keep up", "warning", "recording")
        self._sink.close()

    def missed(self, dropped: int) -> None:
        """Log the number of events dropped so far."""
        self._machine.dropped(dropped)

    def handle(self, event: Event) -> None:
        """Process an event."""
        if isinstance(event, RequestFinished):
            self._step += 1
        self._sink.times(wall=event.time, step=self._step, sim_time=self._films.end)
        self._progress(event)
        match event:
            case CampaignOpened():
                self._machine.opened(arm=self._plan.laboratory.bench is not None)
                self._learning.opened()
                self._say(f"{event.name}: {'goes on' if event.resumed else 'begins'}, mode {event.mode}")
            case CampaignStateChanged():
                self._say(f"{event.before} → {event.after}{': ' + event.reason if event.reason else ''}")
            case CampaignClosed():
                self._learning.flush(event.time)
                self._say(f"ended: {event.state}")
                self._machine.outcome(status_page(self._progress, self._learning.trust))
                self._show("replaying")
            case StageOpened():
                self._say(f"stage {event.stage} begins", source=event.stage)
            case StageClosed():
                self._learning.learnt(event.result, event.time)
                self._learning.flush(event.time)
                self._say(f"stage {event.stage} is done", source=event.stage)
            case RequestStarted():
                self._started(event)
            case RequestFinished():
                self._finished(event)
            case PourProgressed():
                self._cell.progress(event.progress)
                if (doing := self._balance.progress(event.progress, event.time)) is not None:
                    self._machine.activity("arm", doing)
            case StrategyProgressed():
                self._learning.learnt(event.result, event.time)
            case DecisionMade():
                level = "warning" if event.decision.urgent else "info"
                self._decided = event.decision.text
                self._say(event.decision.text, level, event.stage)
            case LogLine():
                self._say(event.text, event.level, event.stage)
        self._machine.status(status_page(self._progress, self._learning.trust))
        if isinstance(event, CampaignOpened | CampaignClosed | RequestStarted | RequestFinished):
            self._fill(live=not isinstance(event, CampaignClosed))

    def _fill(self, *, live: bool) -> None:
        """Show the rack of mixtures, if it has changed."""
        mixtures = mixtures_so_far(self._plan, self._progress.run, live=live)
        if mixtures is not None and mixtures != self._mixtures:
            self._mixtures = mixtures
            shapes.rack(self._sink, draw_rack(mixtures, mixed_liquids(self._plan)))

    def _say(self, text: str, level: str = "info", source: str = "") -> None:
        self._machine.line(text, level, source or "campaign")

    def _show(self, moment: Moment) -> None:
        """Set the layout for a phase, unless it is already set, since users may have rearranged its views."""
        if self._moment == moment:
            return
        self._moment = moment
        self._sink.show(blueprint_of(self._plan, moment))

    def _follow(self, request: Request) -> None:
        """Select the layout for a request."""
        if isinstance(request, Simulate | Pour) and self._moment != "replaying":
            deployed = [scene.name for scene in self._plan.deployment.scenes] if self._plan.deployment else []
            calibrates = request.calibrates(deployed) if isinstance(request, Pour) else request.scene not in deployed
            self._show("calibrating" if calibrates else "deploying")

    def _started(self, event: RequestStarted) -> None:
        self._follow(event.request)
        match event.request:
            case Simulate() as request:
                self._machine.simulation_started(event.id, request.purpose)
            case Suggest():
                self._machine.activity("optimiser", "suggest")
            case Pour() as pour:
                self._machine.pour_started(event.time)
                scene = self._scenes[pour.scene]
                self._cell.begin(pour, scene)
                self._balance.begin(pour, scene)
                expected = ""
                if pour.predicted is not None:
                    unit = unit_of_pour(self._plan, pour)
                    expected = f", predicted {unit.text(pour.predicted.mean, pour.predicted.deviation)}"
                if (
                    pour.dose is None and (action := self._action(pour)) not in self._decided
                ):  # most strategies have just logged it
                    self._say(f"pour {pour.number}: {action}{expected}", source=event.stage)

    def _finished(self, event: RequestFinished) -> None:
        match event.request:
            case Simulate():
                self._machine.simulation_finished(event.id, 0.0 if event.replayed else event.seconds)
            case Suggest():
                self._machine.activity("optimiser", None)
            case Pour():
                self._machine.pour_finished(event.time)
        if isinstance(event.outcome, Failed):
            self._say(f"{event.outcome.kind}: {event.outcome.reason}", "warning", event.stage)
            return
        match event.request, event.outcome:
            case Simulate() as request, Simulated() as outcome:
                self._learning.about(event.stage, request.scene)
                self._simulation(event, request, outcome)
            case Pour() as request, Poured(measured):
                self._learning.about(event.stage, request.scene)
                pour = next(made for made in self._progress.run.pours if made.id == event.id)
                best = self._progress.best.get(request.scene)
                self._say(self._learning.poured(pour, measured, best), source=event.stage)
                shown = self._balance.finish(measured)
                self._cell.finish(
                    self._scenes[request.scene],
                    measured,
                    now=event.time,
                    step=self._step,
                    beside=lambda times, spilled: self._balance.beside(shown, times, spilled),
                    told=self._balance.told,
                )
            case Suggest() as request, Suggested() as outcome:
                self._learning.suggested(event, request, outcome)

    def _simulation(self, event: RequestFinished, request: Simulate, outcome: Simulated) -> None:
        result = outcome.outcome
        self._balance.simulated(request.scene, request.action, result)
        if result.invalid is not None:
            self._say(f"simulation {event.id} is not valid: {result.invalid}", "warning", event.stage)
        if event.frames is None:
            return
        title = (
            f"simulation {event.id} ({request.purpose}): {request.action.display('angular_velocity')}, "
            f"{100 * result.spilled:.1f} % spilled, {result.particles} particles"
        )
        shown = f"shown: simulation {event.id} ({request.purpose}), {100 * result.spilled:.1f} % spilled"
        self._say(shown, source=event.stage)
        self._simulated.film(event.frames, self._scenes[request.scene], title, now=event.time, step=self._step)

    def _action(self, pour: Pour) -> str:
        plan = self._plan.calibration if is_calibration(self._plan, pour) else self._plan.deployment
        return pour.action.display(*(plan.actions.names if plan is not None else ()))


def blueprint_of(plan: CampaignPlan, moment: Moment) -> rrb.Blueprint:
    """Return the layout of a campaign for one phase."""
    calibration, deployment = plan.calibration, plan.deployment
    names = receiver_names(plan)
    receivers = {s.name: names[s.name] for s in deployment.scenes} if deployment is not None else {}
    unit = deployment_unit(deployment) if deployment is not None else DISCREPANCY
    return campaign_blueprint(
        moment,
        receivers,
        unit.label,
        theta_slices=calibration is not None and calibration.parameters.dimension > MAPPED,
        action_slices=deployment is not None and deployment.actions.dimension > MAPPED,
        doses=plan.dispense is not None and calibration is None and deployment is None,
        rack=plan.dispense is not None and plan.dispense.mixtures is not None,
    )
