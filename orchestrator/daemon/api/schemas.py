"""Request and response models of the HTTP API. Times are in seconds since 1970.

Classes whose names end in `In` are request bodies; the others are responses. The models contain no logic.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from orchestrator.daemon.rigs.pour_request import AfterIn, Moment, RequestModel, ResponseModel
from orchestrator.daemon.state.daemon_store import CampaignFields
from orchestrator.learning.dispense import MixedComponent
from orchestrator.records.verdict import Verdict
from orchestrator.reports.run_summary import PourSummary


def text_response(media_type: str, description: str) -> dict[str, Any]:
    """Description of a response that is text of another media type than JSON."""
    return {"content": {media_type: {"schema": {"type": "string"}}}, "description": description}


class AnswerIn(RequestModel):
    """An answer to a question."""

    answer: str = Field(min_length=1, max_length=1000)
    """'done', 'yes', 'no', a weight with its unit, one of the options, 'give up', or a list of mixtures in JSON."""


class MoveIn(RequestModel):
    """A new place in the queue."""

    before: str | None = Field(default=None, max_length=80)
    """Id of the campaign to move in front of; '' for the head of the queue."""

    priority: int | None = Field(default=None, ge=-1000, le=1000)
    not_before: Moment | None = None
    """Earliest start; 0 removes it."""

    after: AfterIn | Literal[""] | None = None
    """Campaign that has to end first; '' removes the condition."""


class EnableIn(RequestModel):
    """Enables motion in the coming part of a run."""

    laboratory: str = Field(max_length=80)
    """Name of the laboratory, typed by an operator who has read what will move."""


class ClearIn(RequestModel):
    """Selects the emergency stop to clear."""

    rig: str = Field(default="", max_length=60)
    """Rig whose emergency stop is cleared; '' for the stop of all rigs. Each is cleared separately."""


class ProblemOut(ResponseModel):
    """An error: the problem, its place and a remedy."""

    detail: str | list[dict[str, Any]]
    """Text of the error; a list if fields of the request are invalid."""


class HealthOut(ResponseModel):
    """Health of the daemon."""

    ok: bool
    problems: list[str] = Field(default_factory=list)


class ProgressOut(ResponseModel):
    """Progress of a running campaign."""

    stage: str
    stage_index: int
    stage_count: int
    simulations: int
    of_simulations: int
    pours: int
    of_pours: int
    simulators_busy: int
    line: str
    pour: str | None
    dose: str | None
    """Estimated amount, target and flow while a wanted amount is poured."""

    checkpoint: str
    checkpoint_words: str
    fraction: float | None
    seconds_left: float | None


class AfterOut(ResponseModel):
    """A campaign that has to end first."""

    campaign: str
    """Its id."""

    verdict: Literal["complete", "any"]
    """Verdict that it needs."""


class CampaignOut(CampaignFields):
    """A submitted campaign."""

    verdict: Verdict | None
    """What its run reached, once it is at rest; null before, and without a run."""

    after: AfterOut | None
    """Campaign that has to end before it starts."""

    followers: list[str]
    """Ids of the campaigns that wait for its end."""

    waits_for: str
    """What has to happen before it starts or continues; '' if only its turn."""

    needs_enabling: bool
    """The campaign uses hardware and waits for `decant queue enable` to enable motion."""

    progress: ProgressOut | None
    """Progress while the campaign runs."""

    report: bool
    """Whether a report exists at `campaigns/ID/report`."""

    live: str | None
    """URL of the live view."""


class NightEventOut(ResponseModel):
    """An entry of the timeline of unattended pours."""

    time: float
    kind: Literal["consent", "pour", "accounted", "fault", "answer", "end"]
    text: str


class CampaignDetailOut(CampaignOut):
    """A submitted campaign with its results so far."""

    pours_made: list[PourSummary] = Field(default_factory=list)
    night: list[NightEventOut] = Field(default_factory=list)
    """Unattended pours since the first consent; empty without one."""

    mixtures: list[MixedComponent] = Field(default_factory=list)
    """Each liquid of each cup of mixtures so far; empty without mixtures."""

    rack: str = ""
    """The rack of the mixtures from above, as SVG; '' without mixtures."""

    summary: dict[str, Any] | None
    """`summary.json` of its run, after publication."""

    audit: list[dict[str, Any]]
    """Audit entries of the campaign, newest first."""


class EmergencyOut(ResponseModel):
    """Authors, time and reasons of an emergency stop."""

    by: str
    """User who stopped; several are separated by commas, the first one first."""

    time: float
    """Time of the first stop."""

    reason: str
    """Reasons, separated by semicolons."""


class ArmStatusOut(ResponseModel):
    """Whether an arm can move, with the text that a run or `decant robot check` would give."""

    state: Literal["ok", "warn", "fail"]
    """'ok': it can move; 'fail': it can't; 'warn': the controller doesn't report it."""

    text: str
    advice: str
    """Remedy; '' if none is needed."""

    time: float
    """Time since which it has been so."""


class RigOut(ResponseModel):
    """A laboratory that one campaign at a time leases."""

    name: str
    mode: str
    campaign: str | None
    """Campaign that leases the rig now."""

    checkpoint: str
    """Checkpoint of the pour in progress."""

    emergency: EmergencyOut | None
    """Emergency stop of this rig alone; the stop of all rigs is part of the status."""

    arm: ArmStatusOut | None
    """Last reading while no campaign used the rig; null during a run and without hardware."""


class WhatMovesOut(ResponseModel):
    """The motion of a campaign on hardware."""

    laboratory: str
    """Name to be typed to enable motion."""

    arm: str
    lines: list[str]


class PersonOut(ResponseModel):
    """The holder of the request's token."""

    name: str
    role: Literal["viewer", "operator", "admin"]


class StatusOut(ResponseModel):
    """State of the daemon."""

    version: str
    time: float
    began: float
    stopping: bool
    ready: bool
    """Simulators are running and no problem is open."""

    problems: list[str]
    queue_paused: bool
    emergency: EmergencyOut | None
    """The emergency stop of all rigs."""

    simulators: int
    rigs: list[RigOut]
    campaigns: dict[str, int]
    """Number of campaigns in each state."""

    questions: int
    """Number of open questions."""

    last_event: int
    live: str | None
    person: PersonOut
    """Who asks, and what they may do."""


class StoppedOut(StatusOut):
    """State of the daemon after an emergency stop."""

    notes: list[str]
    """What was shortened, replaced or ignored in the request; the stop was given in any case."""


class EndingOut(StatusOut):
    """State of the daemon after a request to shut it down."""

    waits_for: list[str]
    """What has to come to rest first, by campaign; empty if nothing runs."""

    at_once: bool
    """Whether it was shutting down already, and now gives up what it waits for."""
