"""Decant for notebooks and other programs: `import decant`. What it can do, with examples: docs/library.md.

Everything here is imported when it is used first: `import decant` itself starts nothing and costs next to nothing.
Whatever is not named in `__all__` may change without notice.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from actors.protocols import LaboratoryError
    from decant.campaigns import build_campaign, load_campaign, load_vessel, shipped, starting_set
    from decant.catalogue import find_pours, find_runs
    from decant.driving import calibrate, plan, run
    from decant.runs import Run, open_run, publish
    from decant.simulating import Simulation, simulate
    from orchestrator import events
    from orchestrator.config.campaign.assignments import AssignmentError
    from orchestrator.config.yaml.errors import ConfigError
    from orchestrator.errors import RunError
    from orchestrator.events import Event
    from orchestrator.plan import CampaignPlan
    from orchestrator.publish import Published
    from sim_engine.errors import DecantError, InvalidArgumentError
    from sim_engine.extras import MissingExtraError
    from sim_engine.liquid import SimulationParameters
    from sim_engine.vessel.spec import VesselSpec

__all__ = [
    "AssignmentError",
    "CampaignPlan",
    "ConfigError",
    "DecantError",
    "Event",
    "InvalidArgumentError",
    "LaboratoryError",
    "MissingExtraError",
    "Published",
    "Run",
    "RunError",
    "Simulation",
    "SimulationParameters",
    "VesselSpec",
    "build_campaign",
    "calibrate",
    "events",
    "find_pours",
    "find_runs",
    "load_campaign",
    "load_vessel",
    "open_run",
    "plan",
    "publish",
    "run",
    "shipped",
    "simulate",
    "starting_set",
]

_HOMES = {
    "decant.campaigns": ("build_campaign", "load_campaign", "load_vessel", "shipped", "starting_set"),
    "decant.catalogue": ("find_pours", "find_runs"),
    "decant.driving": ("calibrate", "plan", "run"),
    "decant.runs": ("Run", "open_run", "publish"),
    "decant.simulating": ("Simulation", "simulate"),
    "actors.protocols": ("LaboratoryError",),
    "orchestrator.config.campaign.assignments": ("AssignmentError",),
    "orchestrator.config.yaml.errors": ("ConfigError",),
    "orchestrator.errors": ("RunError",),
    "orchestrator.events": ("Event",),
    "orchestrator.plan": ("CampaignPlan",),
    "orchestrator.publish": ("Published",),
    "sim_engine.errors": ("DecantError", "InvalidArgumentError"),
    "sim_engine.extras": ("MissingExtraError",),
    "sim_engine.liquid": ("SimulationParameters",),
    "sim_engine.vessel.spec": ("VesselSpec",),
}
"""Module → the names that it gives."""

_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


if not TYPE_CHECKING:  # else a type checker would take a misspelt name for Any

    def __getattr__(name: str) -> Any:
        """Import a name when it is asked for (PEP 562)."""
        if name == "events":
            return import_module("orchestrator.events")
        if name not in _HOME_OF:
            raise AttributeError(f"module 'decant' has no attribute '{name}'; it has {', '.join(__all__)}")
        return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
