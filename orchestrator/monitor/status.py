"""What is going on, for somebody who looks in from the door: a page of a few large lines."""

from __future__ import annotations

import re

from orchestrator.events import (
    CampaignClosed,
    CampaignOpened,
    CampaignStateChanged,
    Event,
    LogLine,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StageOpened,
    StrategyProgressed,
)
from orchestrator.plan import CampaignPlan
from orchestrator.requests import Pour, Simulate

_DOING = {
    "operator": "the operator refills and wipes",
    "tare": "the balance is tared",
    "approach": "the arm goes to its start",
    "tilt": "the arm tilts",
    "hold": "the arm holds",
    "return": "the arm comes back upright",
    "settle": "the last drops fall",
    "weigh": "what was spilled is weighed",
    "record": "the pour is written down",
}


class Status:
    """Collects what the page says.

    Args:
        plan: of the campaign.
    """

    def __init__(self, plan: CampaignPlan) -> None:
        self._plan = plan
        self._state, self._reason, self._stage = "preparing", "", ""
        self._stages: tuple[str, ...] = ()
        self._progress: dict[str, str] = {}
        self._pour = self._doing = self._question = ""
        self._simulating = 0
        self._pours = self._simulations = 0
        self.best: dict[str, str] = {}
        self.trust = ""

    @property
    def reality(self) -> str:
        """'VIRTUAL' or 'REAL'."""
        return "REAL" if self._plan.laboratory.mode == "hardware" else "VIRTUAL"

    def take(self, event: Event) -> None:
        """Take note of an event."""
        match event:
            case CampaignOpened():
                self._stages = event.stages
            case CampaignStateChanged():
                self._state, self._reason = event.after, event.reason
            case CampaignClosed():
                self._state, self._pour, self._stage = event.state, "", ""
            case StageOpened():
                self._stage = f"{event.stage} ({event.index} of {event.count})"
            case StrategyProgressed():
                self._progress[event.stage] = str(event.progress)
            case LogLine() if event.asked:
                self._question = event.text
            case PourProgressed():
                self._doing = _DOING.get(event.progress.checkpoint, event.progress.checkpoint)
                if event.progress.checkpoint not in ("operator", "tare"):
                    self._question = ""
            case RequestStarted():
                self._started(event)
            case RequestFinished():
                self._finished(event)

    def _started(self, event: RequestStarted) -> None:
        if isinstance(event.request, Simulate):
            self._simulating += 1
        elif isinstance(event.request, Pour):
            self._pour, self._doing = str(event.request.number), "it is prepared"

    def _finished(self, event: RequestFinished) -> None:
        if isinstance(event.request, Simulate):
            self._simulating = max(self._simulating - 1, 0)
            self._simulations += 1
        elif isinstance(event.request, Pour):
            self._pour, self._doing, self._pours = "", "", self._pours + 1

    def page(self) -> str:
        """The page, as Markdown."""
        lines = [f"# {self.reality}: {_plain(self._state)}", f"## {_plain(self._stage or self._plan.name)}"]
        if self._question:
            lines.append(f"## A question is open\n\n{_plain(self._question)}")
        if self._state in ("running", "pausing") or self._pour or self._simulating:
            doing = [f"**Pour {self._pour}**: {self._doing}"] if self._pour else []
            if self._simulating:
                doing.append(f"**{self._simulating} simulation{'s' if self._simulating > 1 else ''}** under way")
            lines += doing or ["The next step is being chosen"]
        elif self._reason:
            lines.append(_plain(self._reason))
        lines += [f"{_plain(stage)}: {said}" for stage, said in self._progress.items() if said]
        lines += [f"**Best into {_plain(name)}: {value}**" for name, value in self.best.items()]
        if self.trust:
            lines.append(f"Trust: {_plain(self.trust)}")
        lines.append(f"{self._pours} pours and {self._simulations} simulations so far")
        return "\n\n".join(lines) + "\n"


def _plain(text: str) -> str:
    return re.sub(r"([|*_#<>])", r"\\\1", text)
