"""What of a plan decides which requests are made: a run may only be resumed with the same."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from orchestrator.codec import to_json
from orchestrator.plan import CampaignPlan, DeploymentPlan, ModelName, PricesPlan, TrustPlan
from sim_engine.liquid import Liquid
from sim_engine.task import Scene
from sim_engine.vessel.spec import MeshShape

_FREE = ("source", "laboratory_source", "outputs", "resolved", "on_unknown")
"""Fields of a plan that may be changed between two parts of a run."""

_TOLD = ("surface_tension", "dynamic_viscosity")
"""Properties of a liquid that decide which warnings are given, and no request."""

_MACHINE = ("simulators", "in_process", "object_store_mb", "ray", "operator", "accepted_checksum")
"""Fields of a laboratory that belong to the machine or to who stands beside it, not to the campaign."""

_WIRES = {"arm": ("address",), "balance.device": ("port", "baud", "format", "handshake", "reconnect_time")}
"""Of its parts: a controller may get another address, a balance another socket."""

_YOUNGER: dict[str, dict[str, Any]] = {
    "calibration": {"grid": {}, "thetas": 0, "constraints": [], "prior": [], "averaging": "context"},
    "deployment": {
        "data": None,
        "objectives": None,
        "model": "residual",
        "trust": None,
        "noise": "constant",
        "refusals": "penalise",
        "risk": None,
        "tolerance": None,
        "prices": None,
        "constraints": [],
        "plain": False,
    },
}
"""Fields that runs from before them hadn't got, by section, each with the value that changes nothing."""

NEW_MODEL: ModelName = "scaled"
"""`deployment.model` of campaigns that name none."""


_CAME_TOGETHER: tuple[dict[str, Any], ...] = (
    {"model": NEW_MODEL, "trust": TrustPlan()},
    {"prices": PricesPlan()},
    {"noise": "constant", "refusals": "avoid"},
    {"plain": True},
)
"""Fields of a deployment that came at the same time, each with what a campaign has that doesn't name it."""

_NEWEST = ("noise", "refusals", "risk", "tolerance", "prices", "constraints", "plain", "prior", "averaging")
"""Fields of a calibration or deployment that came after the first studies."""


def as_begun(plan: CampaignPlan, begun: Mapping[str, Any]) -> CampaignPlan:
    """The plan of a run that began before a deployment had some fields, if the campaign asks for nothing else.

    Such a run goes on as it began: with the paper's model and an alarm that only tells, without prices, with the
    worst cost for actions that can't be made, and with κ halved before the first pour, once simulations show structure.

    Args:
        plan: of the campaign, as it is read today.
        begun: the fingerprint that the run began with.
    """
    if plan.deployment is None:
        return plan
    older = deployment_as_begun(plan.deployment, begun.get("deployment") or {})
    return plan if older is plan.deployment else replace(plan, deployment=older)


def deployment_as_begun(today: DeploymentPlan, before: Mapping[str, Any]) -> DeploymentPlan:
    """The same of a deployment alone; `today` itself where nothing has to change."""
    changes: dict[str, Any] = {}
    for fields in _CAME_TOGETHER:
        older = {name: _YOUNGER["deployment"][name] for name in fields}
        unasked = all(getattr(today, name) in (fields[name], older[name]) for name in fields)
        if unasked and not before.keys() & fields.keys():
            changes |= {name: value for name, value in older.items() if getattr(today, name) != value}
    return replace(today, **changes) if changes else today


def without_newest(section: dict[str, Any]) -> dict[str, Any]:
    """A calibration's or deployment's JSON as it was written before the newest fields, where those change nothing."""
    either = _YOUNGER["calibration"] | _YOUNGER["deployment"]
    unused = {name: either[name] for name in _NEWEST}
    return {name: value for name, value in section.items() if name not in unused or value != unused[name]}


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
