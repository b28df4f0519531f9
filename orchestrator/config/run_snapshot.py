"""The self-contained record of a campaign that a run stores as `resolved.json`: the file with all values filled in.

`campaign_record` writes a campaign's file. `record_of` writes a plan derived from another campaign, for example the
cell of a study, as the base record with its changes. Loading a record gives the plan again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from orchestrator.config.campaign_file import CalibrationSection, CampaignFile, LearningSection
from orchestrator.config.laboratory_file import HiddenLiquid
from orchestrator.config.parameter_ranges import Parameters
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.yaml_source import Document, Place, Report
from orchestrator.config.yaml.yaml_writer import as_file
from orchestrator.strategies.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan
from orchestrator.strategies.deployment.disturbances import PoseErrorSection, PoseNoiseSection
from sim_engine.settings.model import Settings
from sim_engine.vessel.shapes import MeshShape, ProfileShape, VesselSpec


def record_of(base: Mapping[str, Any], plan: CampaignPlan) -> dict[str, Any]:
    """A plan in the format of campaign files, JSON-ready. Loading it gives the plan again.

    There are two exceptions. Pours that the cell of a study takes over from another cell are stored as shares of the
    load; loading reads the masses of that cell's journal instead, which differ by rounding. θ drawn from a posterior
    are not included.

    Args:
        base: the record of the campaign from which the plan was made.
        plan: plan of a study's cell, or for planning alone.
    """
    record = {key: value for key, value in base.items() if key not in ("calibration", "deployment")}
    outputs = {**asdict(plan.outputs), "record_rate": f"{plan.outputs.record_rate!r} 1/s"}
    record |= {
        "name": plan.name,
        "seed": plan.seed,
        "on_unknown": plan.on_unknown,
        "outputs": {**outputs, "directory": str(plan.outputs.directory)},
        "laboratory": _laboratory(base["laboratory"], plan),
        "simulator": {"parameters": _parameters(plan)},
    }
    if plan.calibration is not None:
        record["calibration"] = _calibration(base["calibration"], plan.calibration)
    if plan.deployment is not None:
        record["deployment"] = _deployment(base, plan.deployment)
    return record


def _laboratory(base: Mapping[str, Any], plan: CampaignPlan) -> dict[str, Any]:
    bench = plan.laboratory.bench
    if bench is None:
        return dict(base)
    changed = {
        "liquid": written(HiddenLiquid(**bench.liquid.of_the_solver())),
        "pose_error": written(PoseErrorSection(**asdict(bench.pose_error))),
        "pose_noise": written(PoseNoiseSection(**asdict(bench.pose_noise))),
        "time_scale": bench.time_scale,
    }
    return {**base, "bench": {**base["bench"], **changed}}


def _parameters(plan: CampaignPlan) -> dict[str, Any]:
    values: dict[str, Any] = plan.parameters.model_dump()
    for axis in () if plan.calibration is None else plan.calibration.parameters.axes:
        values[axis.name] = {"range": [axis.lower, axis.upper], "scale": axis.scale}
    for prior in () if plan.calibration is None else plan.calibration.parameter_prior:
        values[prior.name] |= {"measured": prior.mean, "tolerance": prior.deviation}
    return written(Parameters.model_validate(values))


def _calibration(base: Mapping[str, Any], plan: CalibrationPlan) -> dict[str, Any]:
    pours: dict[str, Any] = {"count": plan.pour_count, "holdout": plan.holdout}
    if plan.records is not None:
        pours = {"from_run": str(plan.records.path.parent)}
    pours["design"] = "stratified" if plan.records is not None else plan.design
    own = {"pours": pours, "random_baseline": plan.random_baseline, **written(plan.settings)}
    return {**_common(base, CalibrationSection), **own}


def _deployment(base: Mapping[str, Any], plan: DeploymentPlan) -> dict[str, Any]:
    section = base["deployment"]
    named = next(table for table in (section, base) if "receivers" in table or "receiver" in table)
    receivers = named["receivers"] if "receivers" in named else [named["receiver"]]
    known = {one["name"]: one for one in receivers}
    common = {key: value for key, value in _common(section, LearningSection).items() if key != "receiver"}
    if plan.data is None:
        common.pop("data", None)
    common["confirm"] = plan.confirm
    vessels = [known.get(scene.receiver.name) or vessel_record(scene.receiver) for scene in plan.scenes]
    return {**common, "receivers": vessels, **written(plan.settings)}


def vessel_record(vessel: VesselSpec) -> dict[str, Any]:
    """A vessel in the format of its file."""
    shape = vessel.shape
    match shape:
        case ProfileShape():
            inner, thickness = [list(point) for point in shape.inner], {"wall": shape.wall, "floor": shape.floor}
            lengths = {**thickness, **({"height_deviation": shape.height_deviation} if shape.height_deviation else {})}
            profile = {"unit": "m", "inner": inner, **{key: f"{value!r} m" for key, value in lengths.items()}}
            if shape.radius_deviations:
                profile["radius_deviations"] = [list(row) for row in shape.radius_deviations]
            return {"name": vessel.name, "profile": profile}
        case MeshShape():
            unit = {} if shape.unit is None else {"unit": shape.unit}
            return {"name": vessel.name, "mesh": str(shape.path), "up": shape.up, **unit}
        case Settings():
            return {"name": vessel.name, shape.kind: written(shape)}
        case _:
            raise TypeError(f"a vessel of the kind {shape.kind!r} can't be written down")


def _common(base: Mapping[str, Any], section: type[Settings]) -> dict[str, Any]:
    """The keys of a section that are common to all strategies."""
    return {key: value for key, value in base.items() if key in section.written_keys()}


def written(section: Settings) -> dict[str, Any]:
    """A section without a file, in the format of a file."""
    return as_file(section, Place(Document(Path.cwd() / "written")), References(Report()))


def campaign_record(file: CampaignFile, root: Place, references: References, directory: Path) -> dict[str, Any]:
    """The campaign in the format of campaign files, JSON-ready: loading it gives the same plan.

    Args:
        file: the file's content, without problems.
        root: place of the file's root.
        references: the references that read its other files.
        directory: parent folder of its runs.
    """
    record = as_file(file, root, references)
    record["outputs"]["directory"] = str(directory)
    return record
