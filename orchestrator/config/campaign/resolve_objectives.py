"""Several objectives in place of a loss: each with its own keys, none that another one contradicts."""

from __future__ import annotations

from orchestrator.config.campaign.complaints import PlacedComplaints
from orchestrator.config.campaign.sections import DeploymentSection
from orchestrator.config.yaml.source import Place, Report
from orchestrator.strategies.deployment.objectives import Objectives
from sim_engine.space import Space
from sim_engine.task import Scene


def resolve_objectives(
    section: DeploymentSection, place: Place, scene: Scene, actions: Space, report: Report
) -> Objectives | None:
    """What is minimised in place of a loss; None where nothing is given, or something is wrong."""
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
    names = [part.name for part in parts]
    for i, part in enumerate(parts):
        if report.is_broken(at.at(i, "name")):
            continue
        if part.name in names[:i]:
            report.add(at.at(i), f"{part.name} stands twice in the list; keep one of them")
        beside = frozenset(names[:i] + names[i + 1 :])
        part.check(scene, actions, beside, PlacedComplaints(at.at(i), report, frozenset()))
    if len(report.problems) > before:
        return None
    floor = 0.5 if section.floor is None else section.floor
    return Objectives(tuple(parts), floor, bool(section.pareto))
