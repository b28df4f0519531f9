"""Several objectives in place of a loss: each with its own keys, none that another one contradicts."""

from __future__ import annotations

from orchestrator.config.campaign.sections import DeploymentSection, ObjectiveSection
from orchestrator.config.yaml.source import Place, Report
from orchestrator.strategies.deployment.objectives import Objective, Objectives
from sim_engine.space import Space
from sim_engine.task import Scene

BELONGS_TO = {"scale": "time", "volume": "target_volume", "tolerance": "target_volume"}
"""Keys that only one objective has."""

STOPS = ("max_angle", "hold_time")
"""Dimensions of an action that end a pour before the pourer is empty."""


def resolve_objectives(
    section: DeploymentSection, place: Place, scene: Scene, actions: Space, report: Report
) -> Objectives | None:
    """What is minimised in place of a loss; None where nothing is said, or something is wrong."""
    before, parts = len(report.problems), section.objectives
    if parts is None:
        for key in ("pareto", "floor"):
            if section.value(key) is not None and not report.is_broken(place.at("objectives")):
                report.add(place.at(key), "belongs to 'objectives'; name some, or remove it", key=True)
        return None
    if place.at("loss").loc in place.document.marks:
        report.add(place.at("loss"), "stands beside 'objectives'; keep one of them", key=True)
    at = place.at("objectives")
    if not parts:
        report.add(at, "is empty; name at least one, for example '- {name: spillage}'")
    if section.pareto and len(parts) == 1:
        report.add(place.at("pareto"), "needs two objectives that can't both be had", key=True)
    seen: set[str] = set()
    for i, part in enumerate(parts):
        if part.name in seen:
            report.add(at.at(i), f"{part.name} stands twice in the list; keep one of them")
        seen |= {part.name} if part.name is not None else set()
        _check(part, at.at(i), scene, actions, report)
    if {"retained", "target_volume"} <= seen:
        i = next(i for i, part in enumerate(parts) if part.name == "retained")
        text = "wants the pourer to be emptied, and target_volume what is over to stay in it; keep one of them"
        report.add(at.at(i), text)
    if len(report.problems) > before or any(part.name is None for part in parts):
        return None
    floor = 0.5 if section.floor is None else section.floor
    return Objectives(tuple(_objective(part) for part in parts), floor, bool(section.pareto))


def _check(part: ObjectiveSection, at: Place, scene: Scene, actions: Space, report: Report) -> None:
    for key, name in BELONGS_TO.items():
        if part.value(key) is not None and part.name not in (name, None):
            report.add(at.at(key), f"belongs to {name}, not to {part.name}; remove it", key=True)
    if part.name == "time" and "hold_time" not in actions.names and scene.fixed.get("hold_time") is None:
        text = "needs a hold that lasts a known time; search hold_time, or fix it under motion ('hold_time: 1.5 s')"
        report.add(at, text)
    if part.name != "target_volume":
        return
    if part.volume is None:
        if not report.is_broken(at.at("volume")):
            report.add(at, "key 'volume' is missing; add for example 'volume: 150 mL'", key=True)
    elif part.volume > scene.liquid.volume:
        loaded = f"{scene.liquid.volume * 1e6:.4g} mL"
        report.add(at.at("volume"), f"is {part.volume * 1e6:g} mL, and only {loaded} are loaded (liquid.mass)")
    elif part.tolerance is not None and part.tolerance >= part.volume:
        report.add(at.at("tolerance"), "is as much as the volume: not pouring would do")
    if not set(STOPS) & set(actions.names):
        text = "needs an action that stops the pour; search max_angle or hold_time ('hold_time: [0 s, 3 s]')"
        report.add(at, text)


def _objective(part: ObjectiveSection) -> Objective:
    assert part.name is not None
    return Objective(
        part.name,
        part.weight,
        10.0 if part.scale is None else part.scale,
        part.volume or 0.0,
        part.tolerance or 0.0,
    )
