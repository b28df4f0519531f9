"""What of a plan decides which requests are made: a run may only be resumed with the same."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from orchestrator.codec import to_json
from orchestrator.plan import CampaignPlan, ModelName, PricesPlan, TrustPlan
from sim_engine.liquid import Liquid
from sim_engine.task import Scene
from sim_engine.vessel.spec import MeshShape

_FREE = ("source", "outputs", "resolved", "on_unknown")
"""Fields of a plan that may be changed between two parts of a run."""

_TOLD = ("surface_tension", "dynamic_viscosity")
"""Properties of a liquid that decide which warnings are given, and no request."""

_MACHINE = ("simulators", "in_process", "object_store_mb", "ray", "operator", "accepted_checksum")
"""Fields of a laboratory that belong to the machine or to who stands beside it, not to the campaign."""

_WIRES = {"arm": ("address",), "balance.serial": ("port", "baud", "format", "handshake", "reconnect_time")}
"""Of its parts: a controller may get another address, a balance another socket."""

_YOUNGER: dict[str, dict[str, Any]] = {
    "calibration": {"grid": {}, "thetas": 0},
    "deployment": {"data": None, "objectives": None, "model": "residual", "trust": None, "prices": None},
}
"""Fields that runs from before them hadn't got, by section, each with the value that changes nothing."""

NEW_MODEL: ModelName = "scaled"
"""`deployment.model` of campaigns that name none."""


def as_begun(plan: CampaignPlan, begun: Mapping[str, Any]) -> CampaignPlan:
    """The plan of a run that began before D3 had a model to choose, a policy and prices, if the campaign asks for none.

    Such a run goes on as it began: with the paper's model, with an alarm that only tells, and without prices.

    Args:
        plan: of the campaign, as it is read today.
        begun: the fingerprint that the run began with.
    """
    before, today = begun.get("deployment") or {}, plan.deployment
    if today is None:
        return plan
    if "prices" not in before and today.prices == PricesPlan():
        today = replace(today, prices=None)
        plan = replace(plan, deployment=today)
    if "model" in before or "trust" in before:
        return plan
    if (today.model, today.trust) != (NEW_MODEL, TrustPlan()):
        return plan
    return replace(plan, deployment=replace(today, model="residual", trust=None))


def fingerprint(plan: CampaignPlan) -> dict[str, Any]:
    """JSON-ready copy of everything that matters; meshes by content, so that the project may be moved.

    Raises:
        OSError: a mesh file can't be read.
    """
    data = cast("dict[str, Any]", to_json(plan, CampaignPlan))
    for name in _FREE:
        data.pop(name, None)
    for name in _MACHINE:
        data["laboratory"].pop(name, None)
    for part, names in _WIRES.items():
        table = data["laboratory"]
        for key in part.split("."):
            table = (table or {}).get(key)
        for name in names:
            (table or {}).pop(name, None)
    for section, younger in _YOUNGER.items():
        for name, unused in younger.items():
            if data[section] is not None and data[section].get(name) == unused:
                data[section].pop(name)
    for part in ("arm", "balance"):  # a run from before there were any may be gone on with
        if data["laboratory"].get(part) is None:
            data["laboratory"].pop(part, None)
    return cast("dict[str, Any]", _by_content(data))


def scene_by_content(scene: Scene) -> dict[str, Any]:
    """A scene as fingerprints have it: comparable with one in the header of a journal.

    Raises:
        OSError: a mesh file can't be read.
    """
    return cast("dict[str, Any]", _by_content(to_json(scene, Scene)))


def _by_content(data: Any) -> Any:
    if isinstance(data, list):
        return [_by_content(value) for value in data]
    if not isinstance(data, dict):
        return data
    if set(data) == set(Liquid.model_fields):
        return {key: value for key, value in data.items() if key not in _TOLD}
    if data.get("kind") == "mesh" and set(data) == set(MeshShape.model_fields):
        return {**data, "path": hashlib.sha256(Path(data["path"]).read_bytes()).hexdigest()}
    # Where records came from does not matter: they are in the plan.
    return {key: _by_content(value) for key, value in data.items() if key != "path"}
