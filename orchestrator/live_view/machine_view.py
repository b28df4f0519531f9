"""Rows of the machine: activity of each worker, queue, simulation times, waits and dropped events; log and status page.

`MachineView` writes the rows. `status_page` shows the progress of a campaign in a few large lines, which can be read
from a distance.
"""

from __future__ import annotations

import re

import rerun as rr

from actors.laboratory_settings import MODE_LABELS
from orchestrator.learning.campaign_plan import receiver_name
from orchestrator.learning.strategy import plural
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.recording_sink import RecordingSink
from orchestrator.records.run_record import RunState
from orchestrator.records.states import RESTING, State
from orchestrator.reports import figure_style as style
from orchestrator.reports.figure_style import safe_name
from orchestrator.reports.progress_state import CHECKPOINT_WORDS, ProgressState

PLACE = "/machine"

IDLE = "idle"

LOG = "/log"

STATUS = "/status"

OUTCOME = "/outcome"

_PURPOSES = {
    "calibrate": style.MEASURED,
    "prior": style.FALLING,
    "refine": style.GOOD,
    "evaluate": style.PREDICTED,
    "tilt": style.BEST,
    "idle": style.PALE,
}
"""Colours of activities; others get Rerun's default colours."""


class MachineView:
    """Writes the rows of the machine. For one thread.

    Args:
        sink: sink of the rows.
        run: state of the run, which takes each event before the rows are written.
    """

    def __init__(self, sink: RecordingSink, run: RunState) -> None:
        self._sink, self._run = sink, run
        self._slots: dict[int, int] = {}
        self._styled: set[str] = set()
        self._poured: float | None = None
        self._page = ""
        for name, label, colour in (
            ("load/busy", "simulators busy", style.MEASURED),
            ("load/queue", "simulations waiting", style.PREDICTED),
            ("seconds", "one simulation [s]", style.GOOD),
            ("wait", "arm waited before the pour [s]", style.BEST),
            ("dropped", "events that subscribers missed", style.ESCAPED),
        ):
            points = name in ("seconds", "wait")
            appearance = (
                rr.SeriesPoints(names=label, colors=shapes.rgb(colour), marker_sizes=4.0)
                if points
                else rr.SeriesLines(names=label, colors=shapes.rgb(colour), widths=2.5)
            )
            sink.log(f"{PLACE}/{name}", appearance, static=True)

    @property
    def _simulators(self) -> int:
        return max(self._run.simulators, 1)

    def opened(self, *, arm: bool) -> None:
        """Initialise the rows of the simulators, the optimiser, and an arm if there is one; all are idle."""
        for name in (*(["arm"] if arm else []), "optimiser", *(f"simulator {n + 1}" for n in range(self._simulators))):
            self.activity(name, None)
        self._load()

    def simulation_started(self, key: int, purpose: str) -> None:
        """Log that a simulation was sent to the pool."""
        taken = set(self._slots.values())
        self._slots[key] = slot = next(i for i in range(len(taken) + 1) if i not in taken)
        if slot < self._simulators:
            self.activity(f"simulator {slot + 1}", purpose)
        self._load()

    def simulation_finished(self, key: int, seconds: float) -> None:
        """Log that a simulation has finished or failed."""
        slot = self._slots.pop(key, None)
        if slot is not None and slot < self._simulators:
            self.activity(f"simulator {slot + 1}", None)
        if seconds > 0.0:
            self._number("seconds", seconds)
        self._load()

    def pour_started(self, now: float) -> None:
        """Log that a pour starts."""
        if self._poured is not None:
            self._number("wait", now - self._poured)

    def pour_finished(self, now: float) -> None:
        """Log that a pour has ended."""
        self._poured = now
        self.activity("arm", None)

    def activity(self, name: str, doing: str | None) -> None:
        """Log the start of an activity, or its end (None)."""
        entity = f"{PLACE}/activity/{safe_name(name)}"
        if entity not in self._styled:
            self._styled.add(entity)
            purposes = list(_PURPOSES)
            colours = [shapes.rgb(_PURPOSES[each]) for each in purposes]
            appearance = rr.StateConfiguration(values=purposes, labels=purposes, colors=colours)
            self._sink.log(entity, appearance, static=True)
        self._sink.log(entity, rr.StateChange(state=doing or IDLE))

    def dropped(self, count: int) -> None:
        """Log the number of events dropped so far."""
        self._number("dropped", count)

    def line(self, text: str, level: str = "info", source: str = "campaign") -> None:
        """Add a line to the log."""
        log = rr.TextLogLevel
        levels = {"info": log.INFO, "warning": log.WARN, "error": log.ERROR}
        self._sink.log(f"{LOG}/{safe_name(source)}", rr.TextLog(text, level=levels.get(level, log.INFO)))

    def status(self, markdown: str) -> None:
        """Replace the status page."""
        if markdown != self._page:
            self._page = markdown
            self._sink.log(STATUS, rr.TextDocument(markdown, media_type="text/markdown"))

    def outcome(self, markdown: str) -> None:
        """Log the outcome of the run, shown at every position of a viewer's time cursor."""
        self._sink.log(OUTCOME, rr.TextDocument(markdown, media_type="text/markdown"), static=True)

    def _load(self) -> None:
        running = len(self._run.running)
        self._number("load/busy", min(running, self._simulators))
        self._number("load/queue", max(running - self._simulators, 0))

    def _number(self, name: str, value: float) -> None:
        self._sink.number(f"{PLACE}/{name}", float(value))


def status_page(progress: ProgressState, trust: str = "") -> str:
    """Return the status page as Markdown: the progress of a campaign in a few large lines.

    Args:
        progress: of the campaign.
        trust: result of the model check.
    """
    plan, run, opened = progress.plan, progress.run, progress.run.opened
    lines = [
        f"# {MODE_LABELS[plan.laboratory.mode]}: {_plain('preparing' if run.state is State.QUEUED else run.state)}"
    ]
    ended = run.state in RESTING and run.state is not State.QUEUED
    stage = f"{opened.stage} ({opened.index} of {opened.count})" if opened.stage and not ended else plan.name
    lines.append(f"## {_plain(stage)}")
    if run.question:
        lines.append(f"## A question is open\n\n{_plain(run.question)}")
    pour = None if ended else progress.pour
    if run.state in (State.RUNNING, State.PAUSING) or pour or run.running:
        if pour is not None:
            at = "preparing" if pour.progress is None else pour.progress.checkpoint
            lines.append(f"**Pour {pour.request.number}**: {CHECKPOINT_WORDS.get(at, at)}")
        if count := len(run.running):
            lines.append(f"**{plural(count, 'simulation')}** under way")
        if pour is None and not run.running:
            lines.append("The next step is being chosen")
    elif run.reason:
        lines.append(_plain(run.reason))
    lines += [f"{_plain(known.name)}: {shown}" for known in run.stages.values() if (shown := str(known.progress))]
    for scene, best in progress.best.items():
        lines.append(f"**Best into {_plain(receiver_name(plan, scene))}: {best.unit.text(best.loss)}**")
    if trust:
        lines.append(f"Model check: {_plain(trust)}")
    lines.append(f"{plural(run.finished_pours, 'pour')} and {plural(run.simulated, 'simulation')} so far")
    return "\n\n".join(lines) + "\n"


def _plain(text: str) -> str:
    return re.sub(r"([|*_#<>])", r"\\\1", text)
