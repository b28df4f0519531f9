"""Progress of a running campaign for the API and the page, computed from its events.

`CampaignProgress` subscribes to a run's events and returns JSON-ready values. It stores nothing on disk.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any

from orchestrator.progress.progress_state import CHECKPOINT_WORDS, ProgressState
from orchestrator.requests import Pour
from orchestrator.runs.events import CampaignStateChanged, Event, PourProgressed, RequestFinished, StageOpened
from orchestrator.states import State
from orchestrator.strategies.campaign_plan import CampaignPlan


class CampaignProgress:
    """A subscriber that tracks the progress of one run.

    Attributes:
        checkpoint: checkpoint of the pour in progress; '' between pours.
        winding_down: set once the run has started to pause, stop or fail.
    """

    def __init__(self, plan: CampaignPlan) -> None:
        self._tally = ProgressState(plan)
        self.checkpoint = ""
        self.winding_down = asyncio.Event()
        self._stage, self._index, self._count = "", 0, 0

    def __call__(self, event: Event) -> None:
        """Process an event."""
        self._tally(event)
        match event:
            case PourProgressed():
                self.checkpoint = event.progress.checkpoint
            case RequestFinished(request=Pour()):
                self.checkpoint = ""
            case StageOpened():
                self._stage, self._index, self._count = event.stage, event.index, event.count
            case CampaignStateChanged():
                if event.after in (State.PAUSING, State.PAUSED, State.UNKNOWN, State.FAILED, State.STOPPING):
                    self.winding_down.set()

    def progress(self) -> dict[str, Any]:
        """Return JSON-ready values: stage, counts, state of the pour, and the remaining time [s] if it is known."""
        tally = self._tally
        stage = tally.stages.get(self._stage)
        done = stage.progress if stage is not None else None
        pour = tally.pour
        left = tally.forecast.left(time.time())
        return {
            "stage": self._stage,
            "stage_index": self._index,
            "stage_count": self._count,
            "simulations": done.simulations if done else 0,
            "of_simulations": done.of_simulations if done else 0,
            "pours": done.pours if done else 0,
            "of_pours": done.of_pours if done else 0,
            "simulators_busy": tally.busy,
            "line": tally.counts_line(),
            "pour": tally.pour_line(),
            "checkpoint": self.checkpoint,
            "checkpoint_words": CHECKPOINT_WORDS.get(self.checkpoint, ""),
            "fraction": pour.progress.fraction if pour is not None and pour.progress is not None else None,
            "seconds_left": left,
        }
