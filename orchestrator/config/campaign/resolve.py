"""From a campaign as written to a plan: what only makes sense together is checked here."""

from __future__ import annotations

from pathlib import Path

from actors.spec import LaboratorySpec
from orchestrator.config.campaign.record import campaign_record
from orchestrator.config.campaign.resolve_calibration import resolve_calibration
from orchestrator.config.campaign.resolve_deployment import resolve_deployment
from orchestrator.config.campaign.scenes import SceneBuilder
from orchestrator.config.campaign.searched import check_ranges
from orchestrator.config.campaign.sections import CampaignFile
from orchestrator.config.parameters import ParametersBase
from orchestrator.config.yaml.files import resolved
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.source import Place, Report
from orchestrator.plan import CampaignPlan, OutputPlan
from sim_engine.liquid import SimulationParameters


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
    check_ranges(file, root, report)
    calibration = deployment = None
    if file.calibration is not None:
        calibration = resolve_calibration(
            file.calibration,
            builder,
            fixed,
            searched,
            root.at("calibration"),
            laboratory,
            () if parameters is None else parameters.priors(),
        )
    if file.deployment is not None:
        deployment = resolve_deployment(file.deployment, builder, root.at("deployment"), laboratory)
    broken = any(report.is_broken(root.at(key)) for key in ("calibration", "deployment"))
    if not broken and (file.calibration is None or file.calibration.actions is not None):
        builder.refuse_prior(file.actions, root, "decides nothing: no calibration takes its actions from here")
    if file.calibration is None and file.deployment is None and not broken:
        report.add(root, "there is nothing to do; add a 'calibration' or a 'deployment' section")
    if file.on_unknown == "repeat" and laboratory is not None and not _is_virtual(laboratory):
        report.add(
            root.at("on_unknown"),
            f"'repeat' needs a virtual bench, and laboratory '{laboratory.name}' has none; use 'ask'",
        )
    if report.problems or laboratory is None or file.name is None:
        return None
    directory = _directory(file.outputs.directory, root)
    in_force = default if parameters is None else default | parameters.in_force()
    return CampaignPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        laboratory=laboratory,
        parameters=SimulationParameters.from_values(in_force),
        calibration=calibration,
        deployment=deployment,
        outputs=OutputPlan(
            directory=directory,
            rrd=file.outputs.rrd,
            figures=file.outputs.figures,
            record_rate=file.outputs.record_rate,
            recorded_simulations=file.outputs.recorded_simulations,
        ),
        parallel_simulations=file.parallel_simulations,
        on_unknown=file.on_unknown,
        resolved=campaign_record(file, root, references, directory),
        laboratory_source=(resolved(root.directory / file.laboratory) if isinstance(file.laboratory, str) else None),
    )


def _directory(text: str | None, root: Place) -> Path:
    return resolved(Path("runs") if text is None else root.directory / text)


def _is_virtual(laboratory: LaboratorySpec) -> bool:
    return laboratory.mode == "virtual" and laboratory.bench is not None
