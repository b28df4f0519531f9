"""Resolution of a study's levels and strategies to plans.

- `bench_of` and `levels_of` determine the benches.
- `calibration_arms` and `deployment_arms` combine an arm's settings with those of the base campaign and check its
  budget.

Problems are added to the report; the file itself is read in `study_file`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from actors.laboratory_settings import LaboratorySpec, VirtualBenchSpec
from orchestrator.config.yaml.section_validation import PlacedProblems
from orchestrator.config.yaml.yaml_source import Place, Report
from orchestrator.strategies.campaign_plan import CalibrationPlan, DeploymentPlan, Premises
from orchestrator.strategies.strategy_registry import calibrations, deployments
from orchestrator.study.study_plan import ALL, CalibrationArm, DeploymentArm, Level
from sim_engine.scene import PoseError

if TYPE_CHECKING:
    from sim_engine.settings.model import Settings

HARDWARE = (
    "laboratory '{}' is hardware. An arm moves only for one run, after '--enable-motion' and with a person beside it; "
    "the cells of a study run one after the other in processes of their own, where nobody is asked. Pour there with "
    "'decant run', and name a virtual laboratory here"
)

BUDGETS = (
    *("grid", "per_axis", "samples", "simulations"),
    *("pours", "iterations", "simulations_per_iteration", "prior_simulations", "per_pour", "prices", "mean"),
    *("risk_limit", "stop", "good_enough"),
)
"""Settings that an arm does not take from the base campaign, because the study defines each budget."""

AS_IN_THE_PAPER: dict[str, dict[str, Any]] = {
    "D2_paper": {"mean": "zero"},
    "D3_paper": {"model": "residual"},
}
"""Settings in which the paper's forms differ from the defaults."""


def bench_of(laboratory: LaboratorySpec, at: Place, report: Report) -> VirtualBenchSpec | None:
    """The bench of a study. Without a usable one, the reason is added to the report and the result is None."""
    if laboratory.mode != "virtual":
        report.add(at, HARDWARE.format(laboratory.name))
    elif laboratory.arm is not None and laboratory.operator.answers != "virtual":
        report.add(
            at,
            f"laboratory '{laboratory.name}' asks a person, and nobody is asked in a study; set 'operator: {{answers: "
            "virtual}' in it",
        )
    elif laboratory.bench is None:
        report.add(
            at,
            f"laboratory '{laboratory.name}' has no virtual bench to pour on; name one that has, for example "
            "../laboratories/twin.yaml",
        )
    else:
        # Simulated readings need no waiting; an arm over wires needs its real time.
        wired = laboratory.arm is not None
        return replace(laboratory.bench, time_scale=laboratory.bench.time_scale if wired else 0.0)
    return None


def written_levels(sections: Sequence[Settings] | None, root: Place, report: Report) -> list[Any] | None:
    """The complete levels of mismatch; None if the file has none. Problems are added to the report."""
    found: list[Any] = []
    if sections is not None and not sections:
        report.add(root.at("mismatch"), "is empty; name at least one level, or remove the key")
    for i, level in enumerate(sections or ()):
        if level.value("name") is None or level.value("liquid") is None:
            continue  # already reported as missing
        if level.value("name") in [other.name for other in found]:
            report.add(root.at("mismatch", i), f"a level '{level.value('name')}' stands above already")
        found.append(level)
    return found if sections is not None else None


def levels_of(written: Sequence[Any] | None, laboratory: str, bench: VirtualBenchSpec) -> tuple[Level, ...]:
    """The benches of all levels: as given, or the laboratory's own under its name."""
    if written is None:
        return (Level(laboratory, bench),)
    return tuple(
        Level(
            level.name,
            replace(
                bench,
                liquid=level.liquid.parameters(),
                pose_error=PoseError(**level.pose_error.model_dump()),
                pose_noise=PoseError(**level.pose_noise.model_dump()),
            ),
        )
        for level in written
    )


def calibration_arms(
    section: Settings | None,
    base: CalibrationPlan,
    train: int,
    levels: tuple[str, ...],
    compared: str,
    root: Place,
    report: Report,
) -> tuple[CalibrationArm, ...]:
    """The calibrations of a study; problems are added to the report.

    Args:
        base: plan with space and scene; pours and budget are filled in here and later.
        train: number of pours on which every θ of C1 to C3 is simulated.
        levels: names of all levels; C4 runs at all of them, the others at `compared`.
    """
    arms = []
    for written in () if section is None else type(section).model_fields:
        arm: Any = section.value(written) if section is not None else None
        if arm is None:
            continue
        at, kind = root.at("calibration", written), calibrations()[arm.variant]
        if any(arm.value(key) is None for key in arm.required if key != "repetitions"):
            continue
        base_settings, changes = base.settings, arm.changes()
        if "averaging" in kind.model_fields:
            shared = getattr(base_settings, "averaging", "context")
            changes["averaging"] = "noise" if written == "C4_paper" else shared
        settings = kind.like(base_settings, without=BUDGETS, **changes)
        budget = getattr(settings, "iterations", None) or getattr(settings, "simulations", None)
        if (initial := getattr(settings, "initial", None)) is not None and budget is not None and initial > budget:
            if "initial" in changes:
                key = next(key for key in arm.required if key != "repetitions")
                report.add(at.at("initial"), f"{initial} random θ don't fit into {key}: {budget}")
            settings = settings.model_copy(update={"initial": budget})
        settled = settings.settled(base.parameters.names, train, PlacedProblems(at, report, frozenset()))
        if settled is None:
            continue
        prior, known = (base.prior, base.parameter_prior) if kind.has_prior else ((), ())
        plan = replace(base, settings=settled, prior=prior, parameter_prior=known)
        own = getattr(arm, "pours", None) or 0  # only an arm that chooses its pours has the key
        if own:
            plan = replace(plan, design="active", design_simulations=arm.design_simulations)
        where = levels if written == "C4" or compared == ALL else (compared,)
        arms.append(CalibrationArm(_label(written), plan, arm.repetitions or 1, where, own))
    return tuple(arms)


def deployment_arms(
    section: Settings | None,
    base: DeploymentPlan | None,
    calibrated: tuple[CalibrationArm, ...],
    root: Place,
    report: Report,
) -> tuple[DeploymentArm, ...]:
    """The deployments of a study; problems are added to the report."""
    if section is None:
        return ()
    if base is None:
        report.add(root.at("deployment"), "the base campaign has no 'deployment' section to take receivers from")
        return ()
    most = max((arm.repetitions for arm in calibrated if arm.label == "C4"), default=0)
    arms: list[DeploymentArm] = []
    for key in type(section).model_fields:
        arm: Any = section.value(key)
        if arm is None:
            continue
        at, kind = root.at("deployment", key), deployments()[arm.variant]
        if key == "D2_paper" and arm.mean == "constant":
            report.add(at.at("mean"), "D2_paper has the paper's mean, 'zero'; remove the key, or compare with D2")
        repetitions = arm.repetitions or 1
        if kind.simulates and repetitions > most:
            report.add(
                at.at("repetitions") if arm.repetitions is not None else at,
                f"{arm.variant} simulates with the θ* that C4 finds in the same repetition, and C4 has {most}; "
                f"add 'calibration: {{C4: {{repetitions: {repetitions}, simulations: 108}}}}'",
            )
        if any(arm.value(needed) is None for needed in arm.required if needed != "repetitions"):
            continue
        changes = arm.changes() | AS_IN_THE_PAPER.get(key, {})
        rounds = changes.pop("iterations", None)
        settings = kind.like(base.settings, without=BUDGETS, **changes)
        settings.check(Premises(base.actions, base.objectives is not None), PlacedProblems(at, report, frozenset()))
        common = replace(base, settings=settings, data=None, confirm=0)  # a study has its own 'confirm'
        if rounds is None:
            arms.append(DeploymentArm(_label(key), common, repetitions))
        for n in sorted(set(rounds or ())):
            plan = common.with_settings(iterations=n)
            arms.append(DeploymentArm(f"{key}-{n}", plan, repetitions))
    return tuple(arms)


def _label(key: str) -> str:
    """Name of an arm in figures and folders."""
    return key.replace("_", "-")
