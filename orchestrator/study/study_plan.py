"""The plan of a study and its cells.

- `StudyPlan` holds the resolved study: base campaign, levels of mismatch, and strategies with budgets and repetitions.
- `cells_of` derives the cells: small campaigns with one folder each. It is a pure function of the plan.

A repetition resamples the following:

- the errors of grip and placement, the liquid's initial positions and the balance's noise of every pour;
- the selection of the calibration pours that are kept for testing;
- the strategies' own seeds.

The calibration's actions belong to the study and are equal in every repetition. C1's grid is therefore simulated once,
and only scored again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from actors.laboratory_settings import BenchSettings
from orchestrator.campaigns.fingerprint import deciding, fingerprint
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan
from orchestrator.runs.stages import stage_seed

ALL = "all"
"""Value used instead of a level's name: calibrations are compared at all levels."""


@dataclass(frozen=True)
class Level:
    """Level of mismatch between the bench and the simulator.

    Attributes:
        name: name for display and folders.
        bench: the bench with the ground truth, the errors of grip and placement, and their scatter.
    """

    name: str
    bench: BenchSettings


@dataclass(frozen=True)
class ComparedCalibration:
    """A compared calibration with its budget (in `plan`, which has no pours yet).

    Attributes:
        label: the strategy; 'C4-paper' for C4 as in the paper.
        levels: names of the levels that it is run at.
        pours: number of pours that the strategy chooses itself, actively, instead of the repetition's; 0: it uses the
            repetition's.
    """

    label: str
    plan: CalibrationPlan
    repetitions: int
    levels: tuple[str, ...]
    pours: int = 0


@dataclass(frozen=True)
class ComparedDeployment:
    """A compared deployment with its budget (in `plan`, which has all receivers).

    Attributes:
        label: 'D1-15' for D1 with 15 iterations, 'D1-uncalibrated' for the baseline, 'D2-paper' and 'D3-paper' for the
            paper's forms, otherwise the strategy.
        calibrated: whether it simulates with C4's θ* of the repetition; otherwise with the default θ.
    """

    label: str
    plan: DeploymentPlan
    repetitions: int
    calibrated: bool = True

    @property
    def needs_calibration(self) -> bool:
        """Whether it simulates with the result of a calibration."""
        return self.calibrated and self.plan.settings.simulates


@dataclass(frozen=True)
class StudyPlan:
    """A whole study.

    Attributes:
        source: the YAML file.
        base: the campaign that all cells are derived from, with the study's laboratory.
        pour_count: calibration pours of a repetition.
        holdout: number of these pours that are kept for testing.
        compared: level at which C1 to C4 and the uncalibrated simulator are compared; 'all': at all levels together.
        confirm: number of repeated pours of each deployment's recommended action.
        directory: parent directory of the study's folder.
    """

    name: str
    seed: int
    source: Path
    base: CampaignPlan
    levels: tuple[Level, ...]
    calibrations: tuple[ComparedCalibration, ...]
    deployments: tuple[ComparedDeployment, ...]
    pour_count: int
    holdout: int
    compared: str
    confirm: int = 0
    directory: Path = field(default_factory=lambda: Path("runs"))

    @property
    def folder(self) -> Path:
        """Folder of the study."""
        return self.directory / f"study-{self.name}"

    def level(self, name: str) -> Level:
        """Level by name. Raises KeyError."""
        return {level.name: level for level in self.levels}[name]

    def compares(self, level: str) -> bool:
        """Whether calibrations are compared at a level."""
        return self.compared in (ALL, level)

    def calibration(self, label: str) -> ComparedCalibration:
        """Compared calibration by label. Raises KeyError."""
        return {compared.label: compared for compared in self.calibrations}[label]

    def deployment(self, label: str) -> ComparedDeployment:
        """Compared deployment by label. Raises KeyError."""
        return {compared.label: compared for compared in self.deployments}[label]


def study_fingerprint(study: StudyPlan) -> dict[str, Any]:
    """JSON-ready copy of everything that determines the requests. Repetitions and `confirm` can be raised: they are
    left out.

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
        "calibrations": {compared.label: deciding(compared.plan) for compared in study.calibrations},
        "deployments": {compared.label: deciding(compared.plan) for compared in study.deployments},
        "pours": [study.pour_count, study.holdout],
        "compared": study.compared,
    }


Kind = Literal["grid", "pours", "calibration", "uncalibrated", "deployment", "final"]

GRID, FINAL = "grid", "final"
"""Stages that only a study has."""

PARTICLE_SECONDS = 0.0007
"""CPU seconds of a simulation per particle, for a first estimate; later estimates use the measured speed."""

CHANGE_SECONDS = 0.6
"""CPU seconds of the change to another θ, of which nearly each simulation has its own, and of the optimiser's part."""

CELL_SECONDS = 3.0
"""CPU seconds of a cell without simulations and pours."""


@dataclass(frozen=True)
class StudyCell:
    """One small campaign.

    Attributes:
        id: unique in the study and valid as a folder name.
        kind: content: C1's grid, calibration pours, a calibration, the score of the uncalibrated θ, a deployment, or
            one more pour of the action that a deployment recommends.
        level: level of mismatch; '' for the grid, which does not depend on the bench.
        strategy: label of a calibration or deployment; '' otherwise.
        receiver: name of a deployment's scene.
        repetition: number from 1; 0 for the grid.
        again: number of a final action's pour, from 1; 0 for all others. Each has its own cell, so that pours can be
            added later.
        needs: ids of the cells whose results it needs.
        simulations, pours: maximum numbers.
        seed: seed of its campaign.
    """

    id: str
    kind: Kind
    needs: tuple[str, ...]
    simulations: int
    pours: int
    seed: int
    level: str = ""
    strategy: str = ""
    receiver: str = ""
    repetition: int = 0
    again: int = 0


def cells_of(study: StudyPlan) -> tuple[StudyCell, ...]:
    """All cells, each after those that it needs. They are ordered by repetition, so that an unfinished study is
    balanced."""
    train = study.pour_count - study.holdout
    cells: list[StudyCell] = []

    def add(kind: Kind, simulations: int, pours: int, *needs: str, **place: str | int) -> str:
        parts = [str(place[key]) for key in ("level", "strategy", "receiver") if place.get(key)]
        numbers = [int(place[key]) for key in ("repetition", "again") if place.get(key)]
        name = _name(kind, *parts, numbers=numbers)
        # Strategies of a repetition share a seed: their scores then differ only by their results.
        shared = [str(place[key]) for key in ("level", "receiver") if place.get(key)]
        family = "calibration" if kind == "uncalibrated" else kind
        seed = stage_seed(study.seed, _name(family, *shared, numbers=numbers))
        cells.append(StudyCell(name, kind, needs, simulations, pours, seed, **place))  # type: ignore[arg-type]
        return name

    if any(compared.plan.strategy == "C1" for compared in study.calibrations):
        add("grid", study.calibration("C1").plan.settings.simulations_on(study.pour_count), 0)
    numbers = [compared.repetitions for compared in study.calibrations] + [
        compared.repetitions for compared in study.deployments
    ]
    for number in range(1, max(numbers) + 1):
        for level in study.levels:
            place: dict[str, str | int] = {"level": level.name, "repetition": number}
            calibrations = [a for a in study.calibrations if number <= a.repetitions and level.name in a.levels]
            if calibrations:
                pours = add("pours", 0, study.pour_count, **place)
                if study.compares(level.name):
                    add("uncalibrated", study.pour_count, 0, pours, **place)
            for compared in calibrations:
                by_grid = compared.plan.strategy == "C1"
                spent = 0 if by_grid else compared.plan.settings.simulations_on(train)
                made_of = (pours, GRID) if by_grid else (pours,)
                if compared.pours:
                    made_of = (
                        pours,
                        add(
                            "pours", compared.plan.design_simulations, compared.pours, **place, strategy=compared.label
                        ),
                    )
                scored = 2 * study.pour_count  # θ* and the uncalibrated θ on each pour
                add("calibration", spent + scored, 0, *made_of, **place, strategy=compared.label)
            for deployment in (a for a in study.deployments if number <= a.repetitions):
                plan = deployment.plan
                theta = f"calibration.{level.name}.C4.{number:02d}"
                needs = (theta,) if deployment.needs_calibration else ()
                for scene in plan.scenes:
                    axes: dict[str, str | int] = {**place, "strategy": deployment.label, "receiver": scene.name}
                    deployed = add("deployment", plan.settings.simulations, plan.pours, *needs, **axes)
                    for again in range(1, study.confirm + 1):
                        add("final", 0, 1, deployed, *needs, **axes, again=again)
    return tuple(cells)


def _name(*parts: str, numbers: Sequence[int]) -> str:
    return ".".join([*parts, *(f"{number:02d}" for number in numbers)])


def estimated_seconds(study: StudyPlan, cell: StudyCell) -> float:
    """Estimate the CPU time of a cell from its number of particles [s]; accurate within a factor of two."""
    axes = {axis.name: axis for compared in study.calibrations for axis in compared.plan.parameters.axes}
    usual = float(study.base.parameters.particles)
    if "particles" in axes:
        usual = math.sqrt(axes["particles"].lower * axes["particles"].upper)
    hidden = study.level(cell.level).bench.theta.particles if cell.level else 0
    changes = 0 if cell.kind == "uncalibrated" else cell.simulations
    pouring = PARTICLE_SECONDS * (cell.simulations * usual + cell.pours * hidden)
    return pouring + CHANGE_SECONDS * changes + CELL_SECONDS
