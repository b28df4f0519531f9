"""Repeats a run's pour in simulation, with any number of particles, from the journal and the arm's executed motion.

`find_pour` reads a weighed pour; `task_of` makes the simulation task. The simulation itself is run by the caller.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from orchestrator.journal.codec import decode_outcome, decode_request
from orchestrator.journal.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.live_view.run_recording import scenes_of
from orchestrator.requests import Pour, Poured
from orchestrator.strategies.campaign_plan import CampaignPlan
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import PourTask, SampledMotion

DETAIL = 30.0
"""Frames per simulated second [1/s]."""


class NoSuchPourError(ValueError):
    """The journal has no such pour; the message lists the pours it has."""


@dataclass(frozen=True)
class PouredOnce:
    """A weighed pour.

    Attributes:
        stage: stage that requested it.
        measured: its measurement.
    """

    stage: str
    request: Pour
    measured: PourMeasurement

    @property
    def title(self) -> str:
        """Title for the viewer."""
        weighed = f"{1e3 * self.measured.spilled:.1f} g spilled when it was poured"
        return f"pour {self.request.number} of {self.stage}, simulated again ({weighed})"


def find_pour(run: Path, number: int, stage: str | None = None) -> PouredOnce:
    """Find a weighed pour of a run.

    Args:
        run: folder of the run.
        number: number of the pour within its stage.
        stage: stage that requested it; None: the last stage with such a pour.

    Raises:
        NoSuchPourError: the run has no such pour.
        JournalError: the journal can't be read.
    """
    pours: dict[int, tuple[str, Pour]] = {}
    weighed: list[PouredOnce] = []
    with JournalReader(run / JOURNAL_NAME) as journal:
        for entry in journal.entries(kinds=[Kind.REQUESTED, Kind.POUR_FINISHED]):
            key = entry.body["id"]
            if entry.kind == Kind.REQUESTED:
                if entry.body["request"]["type"] == Pour.__name__:
                    request = decode_request(entry.body["request"])
                    assert isinstance(request, Pour)
                    pours[key] = (entry.stage, request)
            elif isinstance(outcome := decode_outcome(entry.body["outcome"]), Poured):
                weighed.append(PouredOnce(*pours[key], outcome.measurement))
    fitting = [p for p in weighed if p.request.number == number and stage in (None, p.stage)]
    if not fitting:
        raise NoSuchPourError(f"{run}: there is no weighed pour {number}{_of(stage)}; {_known(weighed)}")
    return fitting[-1]


def task_of(plan: CampaignPlan, run: Path, pour: PouredOnce, particles: int | None = None) -> PourTask:
    """Make the task that simulates a pour again, with the arm's executed motion, if it was recorded, and the run's θ*.

    Args:
        plan: plan of the run.
        run: folder of the run.
        pour: pour to simulate.
        particles: number of particles instead of θ's.
    """
    theta = plan.parameters
    if (found := run / "theta.json").is_file():
        theta = SimulationParameters.model_validate(json.loads(found.read_text(encoding="utf-8"))["theta"])
    if particles is not None:
        theta = theta.model_copy(update={"particles": particles})
    scene = scenes_of(plan)[pour.request.scene]
    scene = replace(scene, liquid=scene.liquid.model_copy(update={"mass": pour.measured.loaded}))
    task = PourTask(scene, pour.request.action, theta, pour.request.seed % 2**31, frame_rate=DETAIL)
    arm, record = plan.laboratory.arm, pour.measured.notes.get("executed")
    figure = None if arm is None else arm.figure()
    executed = None if figure is None or not record else figure.executed(record)
    if figure is None or executed is None:
        return task
    times, joints = executed
    return replace(task, motion=SampledMotion(times - times[0], figure.pourer(joints)))


def _of(stage: str | None) -> str:
    return "" if stage is None else f" of stage {stage}"


def _known(weighed: list[PouredOnce]) -> str:
    stages: dict[str, list[str]] = {}
    for pour in weighed:
        stages.setdefault(pour.stage, []).append(str(pour.request.number))
    return "weighed were " + "; ".join(f"{s}: {', '.join(n)}" for s, n in stages.items()) if stages else "none was"
