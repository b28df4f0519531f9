"""Where a running campaign stands, for lists and pages: counted from its events."""

from __future__ import annotations

import time
from typing import Any

from orchestrator.progress.progress_state import CHECKPOINT_WORDS, ProgressState
from orchestrator.runs.events import Event, StageOpened
from orchestrator.strategies.campaign_plan import CampaignPlan


class CampaignProgress:
    """A subscriber."""

    def __init__(self, plan: CampaignPlan) -> None:
        self._tally = ProgressState(plan)
        self._stage, self._index, self._count = "", 0, 0

    def __call__(self, event: Event) -> None:
        """Take note of an event."""
        self._tally(event)
        if isinstance(event, StageOpened):
            self._stage, self._index, self._count = event.stage, event.index, event.count

    def progress(self, checkpoint: str) -> dict[str, Any]:
        """JSON-ready: stage, counts, the pour in words, and how long it still takes [s] where that is known.

        Args:
            checkpoint: of the pour that is under way; '' between pours.
        """
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
            "checkpoint": checkpoint,
            "checkpoint_words": CHECKPOINT_WORDS.get(checkpoint, ""),
            "fraction": pour.progress.fraction if pour is not None and pour.progress is not None else None,
            "seconds_left": left,
        }
