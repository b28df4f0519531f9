"""From a campaign as written to a plan: what only makes sense together is checked here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from actors.spec import LaboratorySpec
from orchestrator.config.campaign import CampaignFile, DeploymentSection
from orchestrator.config.motion import ParametersBase
from orchestrator.config.references import References
from orchestrator.config.resolve_calibration import resolve_calibration
from orchestrator.config.scenes import SceneBuilder
from orchestrator.config.yaml_source import Place, Report
from orchestrator.plan import CampaignPlan, DeploymentPlan, OutputPlan
from sim_engine.liquid import SimulationParameters
from sim_engine.losses import Loss

BELONGS_TO = {
    "iterations": ("D1",),
    "simulations_per_iteration": ("D1",),
    "prior_simulations": ("D3",),
    "per_pour": ("D3",),
    "mean": ("D2",),
}
"""Deployment keys that only some strategies use: given to another, they were misunderstood."""


def resolve_campaign(file: CampaignFile, root: Place, report: Report) -> CampaignPlan | None:
    """The plan of a campaign; what is wrong goes to the report, and then the plan may be None."""
    references = References(report)
    laboratory: LaboratorySpec | None = references.laboratory(file.laboratory, root.at("laboratory"))
    liquid = references.liquid(file.liquid, root.at("liquid"))
    builder = SceneBuilder(file, root, references, liquid)
    for role in ("pourer", "receiver"):  # checked even where the sections override it
        if file.value(role) is not None:
            references.vessel(file.value(role), root.at(role))
    parameters: ParametersBase | None = file.simulator.parameters
    fixed = {} if parameters is None else parameters.fixed()
    searched = {} if parameters is None else parameters.searched()
    default = SimulationParameters().model_dump()
    fixed = {name: float(value) for name, value in default.items() if name not in searched} | fixed
    _check_ranges(file, searched, root, report)
    calibration = deployment = None
    if file.calibration is not None:
        calibration = resolve_calibration(
            file.calibration, builder, fixed, searched, root.at("calibration"), laboratory
        )
    if file.deployment is not None:
        deployment = _deployment(file.deployment, builder, root.at("deployment"), laboratory)
    broken = any(report.is_broken(root.at(key)) for key in ("calibration", "deployment"))
    if file.calibration is None and file.deployment is None and not broken:
        report.add(root, "there is nothing to do; add a 'calibration' or a 'deployment' section")
    if file.on_unknown == "repeat" and laboratory is not None and not _is_virtual(laboratory):
        report.add(
            root.at("on_unknown"),
            f"'repeat' needs a virtual bench, and laboratory '{laboratory.name}' has none; use 'ask'",
        )
    if report.problems or laboratory is None or file.name is None:
        return None
    in_force = fixed | {name: min(max(default[name], axis.lower), axis.upper) for name, axis in searched.items()}
    return CampaignPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        laboratory=laboratory,
        parameters=SimulationParameters.from_values(in_force),
        calibration=calibration,
        deployment=deployment,
        outputs=OutputPlan(
            directory=_directory(file.outputs.directory, root),
            rrd=file.outputs.rrd,
            figures=file.outputs.figures,
            record_rate=file.outputs.record_rate,
            recorded_simulations=file.outputs.recorded_simulations,
        ),
        parallel_simulations=file.parallel_simulations,
        on_unknown=file.on_unknown,
    )


def _directory(text: str | None, root: Place) -> Path:
    return Path("runs").resolve() if text is None else (root.directory / text).resolve()


def _is_virtual(laboratory: LaboratorySpec) -> bool:
    return laboratory.mode == "virtual" and laboratory.bench is not None


def _check_ranges(file: CampaignFile, searched: dict[str, Any], root: Place, report: Report) -> None:
    parameters = root.at("simulator", "parameters")
    if file.calibration is None and not report.is_broken(root.at("calibration")):
        for name in searched:
            report.add(
                parameters.at(name),
                "is a range, and nothing searches it; write one value, or add a 'calibration' section",
            )
    in_parameters = any(loc[:2] == parameters.loc for _, loc in report.broken)
    if file.calibration is not None and not searched and not in_parameters:
        report.add(
            root.at("calibration"),
            "has nothing to search; give a range to at least one of simulator.parameters, "
            "for example 'cohesion: [0 N/m, 0.1 N/m]'",
            key=True,
        )


def _deployment(
    section: DeploymentSection, builder: SceneBuilder, place: Place, laboratory: LaboratorySpec | None
) -> DeploymentPlan | None:
    report = builder.report
    strategy = section.strategy
    pourer = builder.pourer(section.pourer, place)
    receivers = builder.receivers(section, place)
    actions = builder.space(section.actions, section.motion, place)
    for key, strategies in BELONGS_TO.items():
        if strategy is not None and section.value(key) is not None and strategy not in strategies:
            report.add(place.at(key), f"belongs to {' and '.join(strategies)}, not to {strategy}; remove it", key=True)
    pours = section.pours
    if pours is None and strategy == "D1":
        pours = 1
    if pours is None and strategy is not None and not report.is_broken(place.at("pours")):
        report.add(
            place, f"key 'pours' is missing; {strategy} learns on real pours, add for example 'pours: 15'", key=True
        )
    if pours == 0 and strategy in ("D2", "D3"):
        report.add(place.at("pours"), f"{strategy} learns on real pours; at least 1 (D1 plans without any)")
    if pours and laboratory is not None and not laboratory.pours:
        at = place.at("pours") if section.pours is not None else place
        hint = "'pours: 0' only plans" if strategy == "D1" else "name one with a bench"
        report.add(at, f"laboratory '{laboratory.name}' has no bench to pour on; {hint}")
    loss = section.loss
    if loss.retained_weight is not None and loss.name != "spilled_and_retained":
        report.add(
            place.at("loss", "retained_weight"), f"belongs to spilled_and_retained, not to {loss.name}", key=True
        )
    scenes = []
    for receiver in receivers or [None]:
        name = "deployment" if receiver is None else f"deployment-{receiver.name}"
        motions = ((section.motion, place.at("motion")),)
        scene = builder.scene(
            name, pourer, receiver, motions, () if actions is None else actions.names, place, recorded=pours == 0
        )
        scenes.append(scene)
        if scene is None:
            break  # one cause, one message
    complete = tuple(scene for scene in scenes if scene is not None)
    if len(complete) < len(receivers) or actions is None or strategy is None or pours is None:
        return None
    per_pour = section.per_pour if section.per_pour is not None else 2
    return DeploymentPlan(
        strategy=strategy,
        scenes=complete,
        actions=actions,
        loss=Loss(loss.name, 1.0 if loss.retained_weight is None else loss.retained_weight),
        pours=pours,
        iterations=section.iterations or 15,
        simulations_per_iteration=section.simulations_per_iteration or 2,
        prior_simulations=37 if section.prior_simulations is None else section.prior_simulations,
        per_pour=(None if per_pour == "free" else int(per_pour)) if strategy == "D3" else 0,
        mean=section.mean or "constant",
        kappa=section.kappa,
        initial=section.initial,
        on_failed_pour=section.on_failed_pour,
    )
