"""What version 0.2 wrote and this one no longer has: journals, results and recorded campaigns are read without it.

Version 0.2 had two further models of D3, `pooled` and `scaled`, and a check of the simulator by the first pours
(`trust`). It had a price of simulations that was used until the first outcome. Some fields of its results had other
names. Its runs can be listed and reported. One that used such a model or check can't be resumed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sim_engine.liquids import RETIRED_PARAMETERS

Data = Mapping[str, Any]

NAMES = {
    "hold_cap": "max_hold_time",
    "per_axis": "points_per_axis",
    "per_pour": "simulations_per_pour",
    "gain_below": "min_gain",
    "record_rate": "frame_rate",
}
"""Names of 0.2 that had one meaning, and those of this version."""

NAMES_BESIDE = {
    "strategy": {"initial": "initial_samples", "prices": "costs", "ignorance": "discrepancy_policy"},
    "probability": {"otherwise": "fallback"},
    "recorded_simulations": {"rrd": "recording"},
}
"""Names of 0.2 that changed in mappings with a certain key."""


def renamed(data: Any) -> Any:
    """Data of 0.2 with the names of this version."""
    if isinstance(data, Mapping):
        names = NAMES | RETIRED_PARAMETERS
        for key, more in NAMES_BESIDE.items():
            names |= more if key in data else {}
        if "Pa*s" in str(data.get("viscosity")):  # of a liquid in a recorded campaign, and no parameter
            names.pop("viscosity")
        own = () if "lower" in data else ("name",)  # a campaign's or laboratory's name; an axis has that of a parameter
        return {names.get(key, key): value if key in own else renamed(value) for key, value in data.items()}
    if isinstance(data, list | tuple) and data and not isinstance(data[0], int | float):
        return [renamed(item) for item in data]
    return RETIRED_PARAMETERS.get(data, data) if isinstance(data, str) else data


_SURROGATE = (
    *("space", "data", "seed", "kappa", "map_resolution", "map_at", "predict_at", "constraints", "infeasible"),
    *("refused", "failed", "noise", "effort"),
)
_PROPOSAL = (*_SURROGATE, "pending", "count")
_FIELDS = {
    "SpaceFillingQuery": ("space", "pending", "count", "seed", "constraints", "infeasible", "refused", "failed"),
    "RegressionQuery": (*_SURROGATE, "mean"),
    "MinimumQuery": (*_PROPOSAL, "acquisition", "mean", "plain"),
    "RiskQuery": (*_PROPOSAL, "acquisition", "risk"),
    "CalibrationQuery": (*_PROPOSAL, "posterior", "design"),
    "PourQuery": (*_PROPOSAL, "simulated", "acquisition"),
    "SimulationQuery": (*_PROPOSAL, "simulated", "pouring"),
}
"""Fields that each type of query has in common with the single type of version 0.2."""


def upgraded_request(data: Data) -> Data:
    """A request as this version reads it: the single type of query of version 0.2 becomes one of several.

    A pour of the models 'pooled' and 'scaled' becomes one of the model 'residual'.
    """
    data = renamed(data)
    problem = data.get("problem")
    if not isinstance(problem, Mapping):
        return data
    kind = _type_of(problem)
    query = {"type": kind} | {name: problem[name] for name in _FIELDS[kind] if name in problem}
    if kind == "SpaceFillingQuery":
        query["known"] = problem["data"]["points"]
    if kind == "CalibrationQuery":
        query["contexts"] = problem["context"]
    if kind == "SimulationQuery":
        query["coupling"] = "residual" if problem["mean"] == "simulated" else "scaled"
    if kind == "PourQuery" and (found := problem.get("mismatch")):
        names = {"play": "offset_priors", "ignorance": "uninformative", "left": "pours_left"}
        query["discrepancy"] = _renamed(found, names | {"looks_ahead": "lookahead"})
    if kind == "MinimumQuery" and data.get("purpose") == "prior":
        query["replicates"] = problem["plain"]  # of D3
    if problem["count"] == 0:
        query.pop("pending", None)  # a query without a proposal has no pending points
    return {**{key: value for key, value in data.items() if key != "problem"}, "query": query}


def _type_of(problem: Data) -> str:
    if problem["acquisition"] == "sobol":
        return "SpaceFillingQuery"
    if problem.get("risk") is not None:
        return "RiskQuery"
    if problem.get("context"):
        return "CalibrationQuery"
    if problem["acquisition"] == "knowledge":
        return "SimulationQuery"
    if problem["mean"] not in ("constant", "zero"):
        return "PourQuery"
    return "RegressionQuery" if problem["count"] == 0 else "MinimumQuery"


def upgraded_outcome(data: Data) -> Data:
    """An outcome as this version reads it."""
    suggestion = data.get("suggestion")
    if not isinstance(suggestion, Mapping) or "mismatch" not in suggestion:
        return data
    suggestion = _renamed(suggestion, {"mismatch": "discrepancy"})
    if found := suggestion["discrepancy"]:
        suggestion["discrepancy"] = _renamed(found, {"ignorance": "uninformative"})
    return {**data, "suggestion": suggestion}


def _renamed(data: Data, names: Mapping[str, str]) -> dict[str, Any]:
    return {names.get(key, key): value for key, value in data.items()}


_RENAMED = {
    "deployment": {"trust": "model_check", "front": "pareto_front"},
    "prediction": {"band": "interval"},
}
"""Fields of results by kind: the name of version 0.2 and today's."""


def upgraded_result(data: Data) -> Data:
    """A stage's result as this version reads it.

    Of a comparison of pours with simulations, the scores are left. Of a study's table, the number of its simulations is
    left: their outcomes are in the journal, too.
    """
    data = renamed(data)
    if data.get("kind") == "table":
        return {key: value for key, value in data.items() if key != "rows"}
    data = _renamed(data, _RENAMED.get(str(data.get("kind")), {}))
    if data.get("kind") != "deployment":
        return data
    check = data.get("model_check")
    if isinstance(check, Mapping) and "mean_z" in check:
        data["model_check"] = {key: check[key] for key in ("z_scores", "alarm")}
    return data | {"pours": [_renamed(row, {"predicted_band": "predicted_interval"}) for row in data.get("pours", ())]}


def upgraded_fingerprint(data: dict[str, Any]) -> dict[str, Any]:
    """A fingerprint of a campaign or study, comparable with one of this version where it means the same in both."""
    data = renamed(data)
    data = {**data, "deployment": _upgraded_plan(data["deployment"])} if "deployment" in data else data
    if isinstance(laboratory := data.get("laboratory"), Mapping) and "cell" not in laboratory:
        data = {**data, "laboratory": _upgraded_laboratory(laboratory)}
    if isinstance(arms := data.get("deployments"), Mapping):  # of a study
        data = {**data, "deployments": {label: _upgraded_plan(plan) for label, plan in arms.items()}}
    return data


def _upgraded_laboratory(laboratory: Data) -> Data:
    """A laboratory without an arm; one with an arm can't be resumed."""
    bench = laboratory["bench"]
    if bench is None:
        return {**laboratory, "cell": None}
    balance = {name: bench[f"balance_{name}"] for name in ("resolution", "noise", "drift")}
    kept = {name: bench[name] for name in ("pose_error", "pose_noise", "time_scale", "operator_time")}
    liquid = {name: value for name, value in bench["liquid"].items() if name not in _NUISANCES}
    balance["settling_time"] = bench["settling_time"]
    return {**laboratory, "cell": None, "bench": {"liquid": liquid, **kept, "balance": balance}}


_NUISANCES = ("receiver_x", "receiver_y", "receiver_z", "tilt_zero", "speed_factor")


def _upgraded_plan(plan: Any) -> Any:
    settings = plan.get("settings") if isinstance(plan, Mapping) else None
    if not isinstance(settings, Mapping) or settings.get("strategy") != "D3" or "trust" not in settings:
        return plan
    if settings["trust"] != {"adaptive": None, "residual": "always"}.get(settings["model"], "another"):
        return plan
    return {**plan, "settings": _without_retired(settings, "trust")}


def upgraded_campaign(data: Any) -> Any:
    """A recorded campaign as this version loads it, for all but resuming. A retired model becomes the default one."""
    data = renamed(data)
    deployment = data.get("deployment") if isinstance(data, Mapping) else None
    if not isinstance(deployment, Mapping) or deployment.get("strategy") != "D3":
        return data
    model = ("model",) if deployment.get("model") in ("pooled", "scaled") else ()
    return {**data, "deployment": _without_retired(deployment, "trust", *model)}


def _without_retired(settings: Data, *retired: str) -> dict[str, Any]:
    """D3's settings without some keys, and without the price of a simulation, which decided nothing."""
    kept = {key: value for key, value in settings.items() if key not in retired}
    if isinstance(costs := kept.get("costs"), Mapping):
        kept["costs"] = {key: value for key, value in costs.items() if key != "simulation"}
    return kept
