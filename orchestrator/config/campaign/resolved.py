"""A plan as a campaign file that stands alone: everything filled in, vessels and laboratory inline, paths absolute."""

from __future__ import annotations

from typing import Any

from orchestrator.config.laboratory.sections import laboratory_as_file, pose_as_file
from orchestrator.config.motion import actions_as_file, fixed_as_file, space_as_file, value_as_file
from orchestrator.config.vessel import liquid_as_file, vessel_as_file
from orchestrator.journal import JOURNAL_NAME
from orchestrator.plan import CalibrationPlan, CampaignPlan, DeploymentPlan, ExistingPours, RiskPlan
from orchestrator.strategies.deployment.objectives import Objectives
from sim_engine.liquid import SimulationParameters
from sim_engine.task import Scene


def campaign_as_file(plan: CampaignPlan) -> dict[str, Any]:
    """The plan in the language of campaign files, JSON-ready: loading it gives the same plan.

    Numbers are exact; records stay in their CSV files, meshes in theirs, both by absolute path.
    """
    scene = plan.calibration.scene if plan.calibration is not None else _first_scene(plan)
    table: dict[str, Any] = {
        "name": plan.name,
        "seed": plan.seed,
        "laboratory": laboratory_as_file(plan.laboratory),
        "liquid": liquid_as_file(scene.liquid),
        "simulator": {"parameters": _parameters(plan)},
        "on_unknown": plan.on_unknown,
        "parallel_simulations": plan.parallel_simulations,
        "outputs": {
            "directory": str(plan.outputs.directory),
            "rrd": plan.outputs.rrd,
            "figures": plan.outputs.figures,
            "record_rate": f"{plan.outputs.record_rate!r} 1/s",
            "recorded_simulations": plan.outputs.recorded_simulations,
        },
    }
    if plan.calibration is not None:
        table["calibration"] = _calibration(plan.calibration)
    if plan.deployment is not None:
        table["deployment"] = _deployment(plan.deployment)
    return table


def _first_scene(plan: CampaignPlan) -> Scene:
    assert plan.deployment is not None, "a campaign calibrates, deploys, or both"
    return plan.deployment.scenes[0]


def _parameters(plan: CampaignPlan) -> dict[str, object]:
    info = SimulationParameters.info()
    searched = set() if plan.calibration is None else set(plan.calibration.parameters.names)
    table = {
        name: value_as_file(value, info[name].unit, info[name].unit, whole=info[name].integer)
        for name, value in plan.parameters.model_dump().items()
        if name not in searched
    }
    return table if plan.calibration is None else table | space_as_file(plan.calibration.parameters)


def _scene(scene: Scene) -> dict[str, object]:
    return {
        "pourer": vessel_as_file(scene.pourer),
        "receiver": vessel_as_file(scene.receiver),
        "motion": fixed_as_file(scene.fixed, scene.pivot, scene.hold_cap),
    }


def _calibration(plan: CalibrationPlan) -> dict[str, object]:
    return {
        "strategy": plan.strategy,
        **_scene(plan.scene),
        "actions": actions_as_file(plan.actions, plan.constraints, plan.prior),
        "pours": _pours(plan),
        **_budget(plan),
        "random_baseline": plan.random_baseline,
    }


def _budget(plan: CalibrationPlan) -> dict[str, object]:
    bayesian = {"initial": plan.initial, "kappa": plan.kappa}
    match plan.strategy:
        case "C1":
            return {"grid": dict(plan.grid)}
        case "C2":
            return {"samples": plan.thetas}
        case "C3":
            return {"iterations": plan.thetas, **bayesian}
        case "C4":
            return {"simulations": plan.simulations, **bayesian, "averaging": plan.averaging}


def _pours(plan: CalibrationPlan) -> dict[str, object]:
    if plan.records is None:
        return {"count": plan.pour_count, "holdout": plan.holdout}
    if plan.records.path.name == JOURNAL_NAME:
        return {"from_run": str(plan.records.path.parent)}
    pours: dict[str, object] = {"from": str(plan.records.path)}
    if plan.records.lip_radius is not None:
        pours["lip_radius"] = f"{plan.records.lip_radius!r} m"
    if plan.records.columns:
        pours["columns"] = dict(plan.records.columns)
    if plan.transfer is not None:
        scene = _scene(plan.transfer.scene)
        pours["transfer"] = {
            "from": str(plan.transfer.path),
            "receiver": scene["receiver"],
            "motion": scene["motion"],
        }
    return pours


def _deployment(plan: DeploymentPlan) -> dict[str, object]:
    scene = _scene(plan.scenes[0])
    loss: dict[str, object] = {"name": plan.loss.name}
    if plan.loss.name == "spilled_and_retained":
        loss["retained_weight"] = plan.loss.retained_weight
    table: dict[str, object] = {
        "strategy": plan.strategy,
        "pourer": scene["pourer"],
        "receivers": [vessel_as_file(s.receiver) for s in plan.scenes],
        "motion": scene["motion"],
        "actions": actions_as_file(plan.actions, plan.constraints),
        "loss": loss,
        "pours": plan.pours,
        "kappa": plan.kappa,
        "initial": plan.initial,
        "on_failed_pour": plan.on_failed_pour,
    }
    if plan.objectives is not None:
        del table["loss"]
        table |= _objectives(plan.objectives)
    if plan.data is not None:
        table["data"] = _data(plan.data, plan)
    match plan.strategy:
        case "D1":
            table |= {"iterations": plan.iterations, "simulations_per_iteration": plan.simulations_per_iteration}
            if plan.risk is not None:
                table["risk"] = _risk(plan.risk)
            if plan.tolerance is not None:
                table["window"] = {"tolerance": plan.tolerance}
        case "D2":
            table["mean"] = plan.mean
        case "D3":
            table["prior_simulations"] = plan.prior_simulations
            table["per_pour"] = "free" if plan.per_pour is None else plan.per_pour
            table["model"] = plan.model
            if plan.trust is not None:
                table["trust"] = {"pours": plan.trust.pours, "limit": plan.trust.limit, "policy": plan.trust.policy}
            if plan.prices is not None:
                pour, simulation = (f"{value!r} s" for value in (plan.prices.pour, plan.prices.simulation))
                table["prices"] = {"pour": pour, "simulation": simulation, "worth": plan.prices.worth}
    return table


def _risk(risk: RiskPlan) -> dict[str, object]:
    level = {"level": risk.level} if risk.measure == "cvar" else {}
    return {"measure": risk.measure, **level, "pose_error": pose_as_file(risk.pose_error), "theta": risk.theta}


def _data(data: ExistingPours, plan: DeploymentPlan) -> dict[str, object]:
    if data.path.name == JOURNAL_NAME:
        return {"run": str(data.path.parent), "counts": data.counts}
    receivers = [scene.receiver.name for scene in plan.scenes if scene.name in data.pours]
    table: dict[str, object] = {"from": str(data.path), "receiver": receivers[0], "counts": data.counts}
    if data.lip_radius is not None:
        table["lip_radius"] = f"{data.lip_radius!r} m"
    return table | ({"columns": dict(data.columns)} if data.columns else {})


def _objectives(objectives: Objectives) -> dict[str, object]:
    parts = []
    for part in objectives.parts:
        row: dict[str, object] = {"name": part.name, "weight": part.weight}
        if part.name == "time":
            row["scale"] = f"{part.scale!r} s"
        if part.name == "target_volume":
            row |= {"volume": f"{part.volume!r} m^3", "tolerance": f"{part.tolerance!r} m^3"}
        parts.append(row)
    return {"objectives": parts, "pareto": objectives.pareto, "floor": objectives.floor}
