"""Live display in the terminal: bars for the stages, the running pour, the pool, and the best pour so far.

`ProgressDisplay` is a subscriber of a run's events. It writes to stderr, so that stdout stays free for results. If
stderr is not a terminal (CI, a log file), it writes plain lines, at most one every two seconds. `ProgressState` keeps
the numbers.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Pour
from orchestrator.records.events import (
    CampaignClosed,
    CampaignOpened,
    CampaignStateChanged,
    DecisionMade,
    Event,
    LogLine,
    RequestFinished,
    StageClosed,
    StageOpened,
)
from orchestrator.records.run_clock import run_time
from orchestrator.records.run_record import RecordedStage, RunPour
from orchestrator.reports.progress_state import CHECKPOINT_WORDS, ProgressState

INTERVAL = 2.0
"""Minimum time between two plain lines of progress [s]."""

_LEVEL_STYLE = {"info": "", "warning": "yellow", "error": "bold red"}


class ProgressDisplay:
    """A subscriber that displays a campaign in the terminal. Use it as a context manager.

    Args:
        plan: plan of the campaign.
        console: output console; stderr by default.
        clock: seconds, monotonic, for the plain lines.
        quiet: show only warnings and errors.
    """

    def __init__(
        self,
        plan: CampaignPlan,
        *,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
        quiet: bool = False,
    ) -> None:
        if console is None:
            console = Console(stderr=True, highlight=False)
        self._console = console
        self._clock = clock
        self._quiet = quiet
        self._progress_state = ProgressState(plan)
        self._live: Live | None = None
        self._lock = threading.Lock()
        self._last_line = -float("inf")
        self._delayed: list[str] | None = None

    def __enter__(self) -> ProgressDisplay:
        if self._console.is_terminal and not self._quiet:
            # Rich draws in its own thread, four times a second, at any rate of events.
            self._live = Live(console=self._console, get_renderable=self._render, refresh_per_second=4, transient=False)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """During a question to the operator: hide the bars and delay lines, except warnings and errors."""
        live, self._live = self._live, None
        if live is not None:
            live.transient = True  # remove the bars from the screen before the question
            live.stop()
        self._delayed = []
        try:
            yield
        finally:
            held, self._delayed = self._delayed, None
            for text in held:
                self._print(text)
            if live is not None:
                live.transient = False
                live.start(refresh=True)
                self._live = live

    def __call__(self, event: Event) -> None:
        """Process an event. Returns at once."""
        with self._lock:
            self._progress_state(event)
        self._print_event(event)

    def _print_event(self, event: Event) -> None:
        """Print permanent lines and, in plain mode, the progress in between."""
        match event:
            case CampaignOpened():
                goes = "goes on" if event.resumed else "begins"
                self._print(f"{event.name} {goes}: {', '.join(event.stages)}; mode {event.mode}; {event.run_directory}")
            case CampaignStateChanged() if event.reason:
                self._print(f"{event.before} → {event.after}: {event.reason}")
            case CampaignClosed():
                self._print(f"campaign {event.state}; {self._progress_state.counts_line()}")
            case LogLine():
                if not event.asked and not event.internal:
                    self._print(event.text, _LEVEL_STYLE[event.level])
            case _ if event.replayed:
                return  # an earlier process has displayed it
            case DecisionMade() if event.decision.urgent:
                self._print(event.decision.text, _LEVEL_STYLE["warning"])
            case StageOpened() if self._live is None:
                self._print(f"{event.stage}: stage {event.index} of {event.count}")
            case StageClosed() if self._live is None:
                self._print(f"{event.stage}: done")
            case RequestFinished(request=Pour()):
                line = self._progress_state.pour_line()
                if line is not None:
                    self._print(line)
            case _ if self._live is None:
                self._plain(event)

    def _plain(self, event: Event) -> None:
        if self._delayed is not None:
            return
        now = self._clock()
        if now - self._last_line < INTERVAL:
            return
        stage = self._progress_state.run.stages.get(event.stage)
        if stage is None or stage.progress.total == 0:
            return
        self._last_line = now
        left = self._progress_state.forecast.left(event.time)
        eta = f"  about {_duration(left)} left in all" if left is not None else ""
        # Lines are printed when a request has just ended, so the mean load is shown instead of the load at that moment.
        load = self._progress_state.load()
        pool = f"pool {100 * load:.0f} % busy · " if load is not None else ""
        self._print(f"{stage.name}: {stage.progress}  {pool}{self._progress_state.counts_line()}{eta}")

    def _print(self, text: str, look: str = "") -> None:
        if self._quiet and not look:
            return
        if self._delayed is not None and not look:
            self._delayed.append(text)
            return
        self._console.print(Text(text, style=look), soft_wrap=True)

    def _render(self) -> RenderableType:
        with self._lock:
            state = self._progress_state
            rows: list[RenderableType] = [self._stages()]
            if state.pour is not None:
                rows.append(Text(state.pour_line() or "", style="bold"))
                rows.append(self._pour_bar(state.pour))
            left = state.forecast.left(run_time())
            eta = f" · about {_duration(left)} left in all" if left is not None else ""
            rows.append(Text(f"  {state.pool_line()}{eta}", style="dim"))
            return Group(*rows)

    def _stages(self) -> RenderableType:
        table = Table.grid(padding=(0, 2))
        for stage in self._progress_state.run.stages.values():
            progress = stage.progress
            waiting = stage.opened_at is None and progress.total == 0
            total = max(progress.total, 1)
            done = total if stage.closed_at is not None else progress.done
            table.add_row(
                Text(stage.name, style="dim" if waiting else ""),
                ProgressBar(total=total, completed=done, width=30),
                Text(str(progress)),
                Text(self._stage_note(stage), style="dim"),
            )
        return table

    def _stage_note(self, stage: RecordedStage) -> str:
        if stage.closed_at is not None:
            return "done"
        now = run_time()
        left = self._progress_state.forecast.stage_left(stage.name, now)
        about = "" if left is None else f"about {_duration(left)}"
        if stage.opened_at is None:
            return about or "waiting"
        spent = _duration(now - stage.opened_at)
        return f"{spent}, {about} left" if about else spent

    def _pour_bar(self, pour: RunPour) -> RenderableType:
        progress = pour.progress
        fraction = 0.0 if progress is None else progress.fraction
        note = [f"{100 * fraction:3.0f} %", f"{max(run_time() - (pour.time or 0.0), 0.0):.1f} s"]
        if progress is not None and progress.tilt is not None:
            note.append(f"tilt {math.degrees(progress.tilt):.0f} deg")
        if (dose := self._progress_state.dose_line()) is not None:
            note.append(dose)
        elif progress is not None and progress.balance is not None:
            note.append(f"balance {progress.balance * 1e3:.1f} g")
        table = Table.grid(padding=(0, 2))
        table.add_row(
            Text(
                "  "
                + ("starting" if progress is None else CHECKPOINT_WORDS.get(progress.checkpoint, progress.checkpoint))
            ),
            ProgressBar(total=1.0, completed=fraction, width=30),
            Text("   ".join(note)),
        )
        return table


def _duration(seconds: float) -> str:
    """'8 s', '3 min 20 s', '2 h 05 min'."""
    total = max(round(seconds), 0)
    if total < 60:
        return f"{total} s"
    if total < 3600:
        return f"{total // 60} min {total % 60:02d} s"
    return f"{total // 3600} h {total % 3600 // 60:02d} min"
