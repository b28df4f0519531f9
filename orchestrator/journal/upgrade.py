"""What version 0.2 wrote and this one no longer has: journals, results and recorded campaigns are read without it.

Version 0.2 had two further models of D3, `pooled` and `scaled`, a check of the simulator by the first pours (`trust`),
and a price of simulations for as long as no outcome told one. Its runs can be listed and reported. One that used such a
model or check can't be resumed.
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
        return {names.get(key, key): renamed(value) for key, value in data.items()}
    if isinstance(data, list | tuple) and data and not isinstance(data[0], int | float):
        return [renamed(item) for item in data]
    return RETIRED_PARAMETERS.get(data, data) if isinstance(data, str) else data


def upgraded_request(data: Data) -> Data:
    """A request as this version reads it. A question with the mean 'pooled' has 'scaled', the nearest one."""
    data = renamed(data)
    problem = data.get("problem")
    if not isinstance(problem, Mapping) or "widening" not in problem:
        return data
    problem = {key: value for key, value in problem.items() if key != "widening"}
    return {**data, "problem": {**problem, "mean": {"pooled": "scaled"}.get(problem["mean"], problem["mean"])}}


def upgraded_result(data: Data) -> Data:
    """A stage's result as this version reads it. Of a comparison of pours with simulations its scores are left."""
    data = renamed(data)
    trust = data.get("trust")
    if not isinstance(trust, Mapping) or "mean_z" not in trust:
        return data
    return {**data, "trust": {key: trust[key] for key in ("z_scores", "alarm")}}


def upgraded_fingerprint(data: dict[str, Any]) -> dict[str, Any]:
    """A fingerprint of a campaign or study, comparable with one of this version where it means the same in both."""
    data = renamed(data)
    data = {**data, "deployment": _upgraded_plan(data["deployment"])} if "deployment" in data else data
    if isinstance(arms := data.get("deployments"), Mapping):  # of a study
        data = {**data, "deployments": {label: _upgraded_plan(plan) for label, plan in arms.items()}}
    return data


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
