"""A study with everything resolved: the base campaign, levels of mismatch, strategies with budgets and repetitions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from actors.laboratory_settings import VirtualBenchSpec
from orchestrator.runs.fingerprint import deciding, fingerprint
from orchestrator.strategies.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan

ALL = "all"
"""In place of a level's name: calibrations are compared at all of them."""


@dataclass(frozen=True)
class Level:
    """How far the bench is from what the simulator can be.

    Attributes:
        name: for people and folders.
        bench: with the hidden θ, the errors of grip and placement, and their scatter.
    """

    name: str
    bench: VirtualBenchSpec


@dataclass(frozen=True)
class CalibrationArm:
    """One of C1 to C4 with its budget (in `plan`, which has no pours yet).

    Attributes:
        label: the strategy; 'C4-paper' for C4 as in the paper.
        levels: names of the levels that it is run at.
        pours: that it chooses itself, actively, in place of the repetition's; 0: it learns from those.
    """

    label: str
    plan: CalibrationPlan
    repetitions: int
    levels: tuple[str, ...]
    pours: int = 0


@dataclass(frozen=True)
class DeploymentArm:
    """One of D1 to D3 with its budget (in `plan`, which has all receivers).

    Attributes:
        label: 'D1-15' for D1 with 15 iterations, 'D2-paper' and 'D3-paper' for those as in the paper, otherwise the
            strategy.
    """

    label: str
    plan: DeploymentPlan
    repetitions: int


@dataclass(frozen=True)
class StudyPlan:
    """A whole study.

    Attributes:
        source: the YAML file.
        base: the campaign that all cells are made from, with the study's laboratory.
        pour_count: calibration pours of a repetition.
        holdout: how many of them are kept for testing.
        compared: level at which C1 to C4 and the uncalibrated simulator are compared; 'all': at all of them together.
        confirm: how often each deployment's recommended action is poured again.
        directory: in which the study has its folder.
    """

    name: str
    seed: int
    source: Path
    base: CampaignPlan
    levels: tuple[Level, ...]
    calibrations: tuple[CalibrationArm, ...]
    deployments: tuple[DeploymentArm, ...]
    pour_count: int
    holdout: int
    compared: str
    confirm: int = 0
    directory: Path = field(default_factory=lambda: Path("runs"))

    @property
    def folder(self) -> Path:
        """Where everything of the study is."""
        return self.directory / f"study-{self.name}"

    def level(self, name: str) -> Level:
        """A level by its name. Raises KeyError."""
        return {level.name: level for level in self.levels}[name]

    def compares(self, level: str) -> bool:
        """Whether calibrations are compared at a level."""
        return self.compared in (ALL, level)

    def calibration(self, label: str) -> CalibrationArm:
        """The arm by its label. Raises KeyError."""
        return {arm.label: arm for arm in self.calibrations}[label]

    def deployment(self, label: str) -> DeploymentArm:
        """The arm by its label. Raises KeyError."""
        return {arm.label: arm for arm in self.deployments}[label]


def study_fingerprint(study: StudyPlan) -> dict[str, Any]:
    """JSON-ready copy of what decides what is asked for. Repetitions and `confirm` are left out: they may be raised.

    Raises:
        OSError: a mesh file can't be read.
    """
    base = fingerprint(study.base)
    base["laboratory"].pop("bench", None)  # every level has its own
    base.pop("deployment", None)
    return {
        "name": study.name,
        "seed": study.seed,
        "base": base,
        "levels": {level.name: deciding(level.bench) for level in study.levels},
        "calibrations": {arm.label: deciding(arm.plan) for arm in study.calibrations},
        "deployments": {arm.label: deciding(arm.plan) for arm in study.deployments},
        "pours": [study.pour_count, study.holdout],
        "compared": study.compared,
    }
