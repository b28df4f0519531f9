"""From levels and strategies of a study as written to its plans: benches, which keys are whose, what they may spend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from actors.bench.spec import VirtualBenchSpec
from actors.spec import LaboratorySpec
from orchestrator.config.yaml.source import Place, Report
from orchestrator.fingerprint import NEW_MODEL
from orchestrator.plan import CalibrationName, CalibrationPlan, DeploymentName, DeploymentPlan, TrustPlan
from orchestrator.study.plan import CalibrationArm, DeploymentArm, Level
from sim_engine.task import PoseError

if TYPE_CHECKING:
    from orchestrator.config.yaml.sections import Section

HARDWARE = (
    "laboratory '{}' is hardware. An arm moves only for one run, after '--arm' and with a person beside it; the cells "
    "of a study run one after the other in processes of their own, where nobody is asked. Pour there with 'decant "
    "run', and name a virtual laboratory here"
)

CALIBRATION_KEYS = {
    "per_axis": ("C1",),
    "samples": ("C2",),
    "iterations": ("C3",),
    "simulations": ("C4",),
    "initial": ("C3", "C4"),
    "kappa": ("C3", "C4"),
}
BUDGET = {"C1": ("per_axis", 10), "C2": ("samples", 18), "C3": ("iterations", 59), "C4": ("simulations", 108)}
"""What a calibration has to spend, with the paper's number as an example."""

DEPLOYMENT_KEYS = {
    "pours": ("D2", "D3"),
    "iterations": ("D1",),
    "simulations_per_iteration": ("D1",),
    "prior_simulations": ("D3",),
    "per_pour": ("D3",),
    "mean": ("D2",),
}


def bench_of(laboratory: LaboratorySpec, at: Place, report: Report) -> VirtualBenchSpec | None:
    """The bench that a study can pour on; None, with the reason in the report, where there is none."""
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
        # Numbers need not be waited for; an arm over wires needs its time.
        wired = laboratory.arm is not None
        return replace(laboratory.bench, time_scale=laboratory.bench.time_scale if wired else 0.0)
    return None


def written_levels(sections: Sequence[Section] | None, root: Place, report: Report) -> list[Any] | None:
    """The levels of mismatch that are complete; None where none are asked for. What is wrong goes to the report."""
    found: list[Any] = []
    if sections is not None and not sections:
        report.add(root.at("mismatch"), "is empty; name at least one level, or remove the key")
    for i, level in enumerate(sections or ()):
        if level.value("name") is None or level.value("liquid") is None:
            continue  # reported as missing
        if level.value("name") in [other.name for other in found]:
            report.add(root.at("mismatch", i), f"a level '{level.value('name')}' stands above already")
        found.append(level)
    return found if sections is not None else None


def levels_of(written: Sequence[Any] | None, laboratory: str, bench: VirtualBenchSpec) -> tuple[Level, ...]:
    """The benches of all levels: as written, or the laboratory's own under its name."""
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
    section: Section | None,
    base: CalibrationPlan,
    train: int,
    levels: tuple[str, ...],
    compared: str,
    root: Place,
    report: Report,
) -> tuple[CalibrationArm, ...]:
    """The calibrations of a study; what is wrong goes to the report.

    Args:
        base: with space and scene; pours and budget are filled in here and later.
        train: pours that every θ of C1 to C3 is simulated on.
        levels: all names; C4 is run at all of them, the others at `compared`.
    """
    arms = []
    for written in ("C1", "C2", "C3", "C4", "C4_paper") if section is not None else ():
        arm: Any = section.value(written) if section is not None else None
        at, name = root.at("calibration", written), cast("CalibrationName", written[:2])
        if arm is None:
            continue
        _check_keys(arm, name, CALIBRATION_KEYS, at, report)
        key, example = BUDGET[name]
        budget = arm.value(key)
        if budget is None:
            if not report.is_broken(at.at(key)):
                report.add(at, f"key '{key}' is missing; add for example '{key}: {example}'", key=True)
            continue
        changes: dict[str, Any] = {"strategy": name, "grid": {}, "thetas": 0, "averaging": "context", "prior": ()}
        match name:
            case "C1":
                changes |= {"grid": dict.fromkeys(base.parameters.names, budget)}
                changes |= {"simulations": train * budget**base.parameters.dimension}
            case "C4":
                averaging = "noise" if written == "C4_paper" else base.averaging
                changes |= {"simulations": budget, "averaging": averaging, "prior": base.prior}
            case _:
                changes |= {"thetas": budget, "simulations": train * budget}
        trials = budget if name in ("C3", "C4") else math.inf
        initial = base.initial if arm.initial is None else arm.initial
        if arm.initial is not None and initial > trials:
            report.add(at.at("initial"), f"{initial} random θ don't fit into {key}: {budget}")
        changes |= {"initial": int(min(initial, trials)), "kappa": base.kappa if arm.kappa is None else arm.kappa}
        where = levels if written == "C4" else (compared,)
        arms.append(CalibrationArm(_label(written), replace(base, **changes), arm.repetitions or 1, where))
    return tuple(arms)


def deployment_arms(
    section: Section | None,
    base: DeploymentPlan | None,
    calibrations: tuple[CalibrationArm, ...],
    root: Place,
    report: Report,
) -> tuple[DeploymentArm, ...]:
    """The deployments of a study; what is wrong goes to the report."""
    if section is None:
        return ()
    if base is None:
        report.add(root.at("deployment"), "the base campaign has no 'deployment' section to take receivers from")
        return ()
    most = max((arm.repetitions for arm in calibrations if arm.label == "C4"), default=0)
    arms: list[DeploymentArm] = []
    for key in ("D1", "D2", "D2_paper", "D3", "D3_paper"):
        arm: Any = section.value(key)
        at, name = root.at("deployment", key), cast("DeploymentName", key[:2])
        if arm is None:
            continue
        _check_keys(arm, name, DEPLOYMENT_KEYS, at, report)
        if key == "D2_paper" and arm.mean == "constant":
            report.add(at.at("mean"), "D2_paper has the paper's mean, 'zero'; remove the key, or compare with D2")
        repetitions = arm.repetitions or 1
        if name != "D2" and repetitions > most:
            report.add(
                at.at("repetitions") if arm.repetitions is not None else at,
                f"{name} simulates with the θ* that C4 finds in the same repetition, and C4 has {most}; "
                f"add 'calibration: {{C4: {{repetitions: {repetitions}, simulations: 108}}}}'",
            )
        if name != "D1" and arm.pours is None:
            if not report.is_broken(at.at("pours")):
                report.add(at, "key 'pours' is missing; add for example 'pours: 15'", key=True)
            continue
        common = replace(
            base,
            strategy=name,
            pours=1 if name == "D1" else arm.pours,
            per_pour=0,
            data=None,
            model="residual",
            trust=None,
            plain=False,
            # Risk and window are D1's: with them the others would be planned as D1, too.
            risk=base.risk if name == "D1" else None,
            tolerance=base.tolerance if name == "D1" else None,
            mean="zero" if key == "D2_paper" else arm.mean or "constant",
            kappa=base.kappa if arm.kappa is None else arm.kappa,
            initial=base.initial if arm.initial is None else arm.initial,
        )
        if name == "D1":
            numbers = sorted(set(arm.iterations or [15]))
            repeats = arm.simulations_per_iteration or 2
            if base.risk is not None and repeats < 2:
                report.add(
                    at.at("simulations_per_iteration"),
                    "one simulation of each action is made as planned, so that with the campaign's 'risk' at least 2 "
                    "are needed",
                )
            arms += [
                DeploymentArm(f"D1-{n}", replace(common, iterations=n, simulations_per_iteration=repeats), repetitions)
                for n in numbers
            ]
        elif name == "D3":
            prior = 37 if arm.prior_simulations is None else arm.prior_simulations
            beside = 2 if arm.per_pour is None else arm.per_pour
            common = replace(common, prior_simulations=prior, per_pour=beside)
            if key == "D3":
                model, trust = (base.model, base.trust) if base.strategy == "D3" else (NEW_MODEL, TrustPlan())
                common = replace(common, model=model, trust=trust)
            arms.append(DeploymentArm(_label(key), replace(common, plain=common.model == "residual"), repetitions))
        else:
            arms.append(DeploymentArm(_label(key), common, repetitions))
    return tuple(arms)


def _label(key: str) -> str:
    """What figures and folders call an arm."""
    return key.replace("_", "-")


def _check_keys(arm: Any, name: str, belongs: dict[str, tuple[str, ...]], at: Place, report: Report) -> None:
    for key, strategies in belongs.items():
        if arm.value(key) is not None and name not in strategies:
            report.add(at.at(key), f"belongs to {' and '.join(strategies)}, not to {name}; remove it", key=True)
