"""What goes over the wire, in both directions. Times are seconds since 1970."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class _In(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class _Out(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True)


class SubmissionIn(_In):
    """A campaign: `text` with its `files`, or the `path` of one on the daemon's machine."""

    text: str = Field(default="", max_length=500_000)
    """The campaign as YAML. Paths in it are those of `files`."""

    files: dict[str, str] = Field(default_factory=dict)
    """Files that it refers to: relative path → content in base64."""

    path: str = Field(default="", max_length=1000)
    """In place of both: a file in one of the folders that the daemon's settings name as roots."""

    verb: Literal["run", "calibrate", "plan"] = "run"
    rig: str = Field(default="", max_length=60)
    """Where it is to run; '' for the rig that fits."""

    priority: int = Field(default=0, ge=-1000, le=1000)
    """Higher ones come first."""


class AnswerIn(_In):
    """An answer to a question."""

    answer: str = Field(min_length=1, max_length=1000)
    """'done', 'yes', 'no', a weight with its unit, one of the options, or 'give up'."""


class MoveIn(_In):
    """Another place in the queue."""

    before: str | None = Field(default=None, max_length=80)
    """In front of that campaign; '' for the head of the queue."""

    priority: int | None = Field(default=None, ge=-1000, le=1000)


class ArmIn(_In):
    """Hardware may move in the coming part of a run."""

    laboratory: str = Field(max_length=80)
    """Its name, typed by somebody who has read what will move."""


class EmergencyIn(_In):
    """An emergency stop: of one rig, or of all of them."""

    reason: str = Field(default="", max_length=500)
    rig: str = Field(default="", max_length=60)
    """Stop only this rig; '' for all."""


class ClearIn(_In):
    """Which emergency stop is cleared."""

    rig: str = Field(default="", max_length=60)
    """The one of this rig; '' for the one of all rigs. Each is cleared by itself."""


class ProblemOut(_Out):
    """What is wrong, where, and what would be right."""

    detail: str | list[dict[str, Any]]
    """In words; a list where fields of the request are not what they should be."""


class HealthOut(_Out):
    """Whether all is well."""

    ok: bool
    problems: list[str] = []


class ProgressOut(_Out):
    """Where a running campaign stands."""

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
    checkpoint: str
    checkpoint_words: str
    fraction: float | None
    seconds_left: float | None


class CampaignOut(_Out):
    """A submitted campaign."""

    id: str
    name: str
    verb: str
    rig: str
    mode: str
    """'virtual', 'hardware', or 'none' where nothing is poured."""

    priority: int
    state: str
    """queued, preparing, running, pausing, paused, waiting for operator, stopping, finished, failed, unknown, stopped,
    withdrawn."""

    wish: str
    """What people want of it: run, pause, stop, abort."""

    reason: str
    by: str
    created: float
    begun: float | None
    ended: float | None
    run: str | None
    """Name of its run's folder."""

    armed: bool
    needs_arming: bool
    """Hardware that nobody has armed yet: it waits for `decant arm`."""

    progress: ProgressOut | None
    """While it runs."""

    report: bool
    """Whether there is a report at `campaigns/ID/report`."""

    live: str | None
    """Where it can be watched live."""


class PourOut(_Out):
    """A pour that was asked for."""

    stage: str
    number: int
    receiver: str
    action: str
    """In the units that people use."""

    predicted: str
    measured: str
    """'' while nobody knows."""

    loss: str
    """What `predicted` and `measured` are, such as 'spilled / poured': each loss has its own denominator."""

    spillage: float | None
    """Share of the load that fell outside: spilled / loaded."""

    state: Literal["asked", "under way", "weighed", "failed", "unknown"]
    """'unknown': it had begun when its run ended, and has no outcome; resuming the run asks about it."""

    time: float | None


class CampaignDetailOut(CampaignOut):
    """A submitted campaign with what came of it so far."""

    pours_made: list[PourOut]
    summary: dict[str, Any] | None
    """`summary.json` of its run, once it is published."""

    deeds: list[dict[str, Any]]
    """Who did what to it, the newest first."""


class QuestionOut(_Out):
    """Something that a person is asked."""

    id: int
    campaign: str
    rig: str
    kind: str
    """'bench': a step at the arm; 'unknown': a pour without outcome; 'strategy': a decision."""

    about: str
    text: str
    problem: str
    """Why it is asked again; '' the first time."""

    wants: str
    """'done', 'weight', 'yes or no', or 'option'."""

    options: list[str]
    details: dict[str, Any]
    hands: bool
    """Whether it invites hands into the cell."""

    asked: float
    answer: str | None
    by: str | None
    answered: float | None
    closed: str | None
    open: bool


class EmergencyOut(_Out):
    """Who pressed an emergency stop, and when."""

    by: str
    time: float
    reason: str


class RigOut(_Out):
    """A laboratory that campaigns lease, one at a time."""

    name: str
    mode: str
    campaign: str | None
    """That has it now."""

    checkpoint: str
    """Where the pour that is under way stands."""

    emergency: EmergencyOut | None
    """The emergency stop of this rig alone; that of all rigs is in the status."""


class WhatMovesOut(_Out):
    """What hardware would do in a campaign."""

    laboratory: str
    """The name to be typed."""

    arm: str
    lines: list[str]


class StatusOut(_Out):
    """Everything at a glance."""

    version: str
    time: float
    began: float
    stopping: bool
    ready: bool
    """Simulators are up, and nothing is wrong."""

    problems: list[str]
    queue_paused: bool
    emergency: EmergencyOut | None
    """The emergency stop of all rigs."""

    simulators: int
    rigs: list[RigOut]
    campaigns: dict[str, int]
    """How many in each state."""

    questions: int
    """Open ones."""

    last_event: int
    live: str | None
