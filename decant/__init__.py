"""Decant for notebooks and other programs: `import decant`. What it can do, with examples: docs/tutorials/notebook.md.

Everything here is imported when it is used first: `import decant` itself starts nothing and costs next to nothing.
Whatever is not named in `__all__` may change without notice.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from actors.interfaces import LaboratoryError
    from decant.ask_tell import AskedPour, AskTell
    from decant.catalogue_tables import find_pours, find_runs
    from decant.run_results import Run, open_run, publish
    from decant.running import (
        RunningCampaign,
        build_campaign,
        calibrate,
        check,
        doctor,
        load_campaign,
        load_vessel,
        plan,
        run,
        shipped,
        start,
        starting_set,
    )
    from decant.simulation import Simulation, simulate
    from decant.station import Station, StationPour
    from orchestrator.campaigns.action_assignments import AssignmentError
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError
    from orchestrator.learning.campaign_plan import CampaignPlan
    from orchestrator.learning.run_errors import RunError
    from orchestrator.materials.vessel_account import VesselAccount, VesselContent
    from orchestrator.records import events
    from orchestrator.records.events import Event
    from orchestrator.reports.publishing import Published
    from orchestrator.reports.recording_export import export_recordings
    from orchestrator.reports.recording_figures import replay_figure
    from orchestrator.reports.recording_file import PourRecording, load_recording, load_recordings
    from orchestrator.reports.recording_fit import Fit, Judgement, fit_recordings, judge_recording
    from orchestrator.reports.recording_replay import PourReplay, ReplayValues, replay_recording
    from orchestrator.runs.added_pours import add_pour
    from orchestrator.runs.bench_check import BenchReport
    from orchestrator.runs.run_service import CheckReport
    from sim_engine.errors import DecantError, InvalidArgumentError
    from sim_engine.liquids import SimulationParameters
    from sim_engine.resources import MissingExtraError
    from sim_engine.vessel.shapes import VesselSpec

__all__ = [
    "AskTell",
    "AskedPour",
    "AssignmentError",
    "BenchReport",
    "CampaignPlan",
    "CheckReport",
    "ConfigError",
    "DecantError",
    "Event",
    "Fit",
    "InvalidArgumentError",
    "Judgement",
    "LaboratoryError",
    "MissingExtraError",
    "PourRecording",
    "PourReplay",
    "Published",
    "ReplayValues",
    "Run",
    "RunError",
    "RunningCampaign",
    "Simulation",
    "SimulationParameters",
    "Station",
    "StationPour",
    "VesselAccount",
    "VesselContent",
    "VesselSpec",
    "add_pour",
    "build_campaign",
    "calibrate",
    "check",
    "doctor",
    "events",
    "export_recordings",
    "find_pours",
    "find_runs",
    "fit_recordings",
    "judge_recording",
    "load_campaign",
    "load_recording",
    "load_recordings",
    "load_vessel",
    "open_run",
    "plan",
    "publish",
    "replay_figure",
    "replay_recording",
    "run",
    "shipped",
    "simulate",
    "start",
    "starting_set",
]

_HOMES = {
    "decant.ask_tell": ("AskTell", "AskedPour"),
    "decant.catalogue_tables": ("find_pours", "find_runs"),
    "decant.running": (
        *("build_campaign", "load_campaign", "load_vessel", "shipped", "starting_set"),
        *("calibrate", "check", "doctor", "plan", "run", "start", "RunningCampaign"),
    ),
    "decant.run_results": ("Run", "open_run", "publish"),
    "decant.simulation": ("Simulation", "simulate"),
    "decant.station": ("Station", "StationPour"),
    "actors.interfaces": ("LaboratoryError",),
    "orchestrator.runs.bench_check": ("BenchReport",),
    "orchestrator.materials.vessel_account": ("VesselAccount", "VesselContent"),
    "orchestrator.campaigns.action_assignments": ("AssignmentError",),
    "orchestrator.campaigns.yaml.yaml_errors": ("ConfigError",),
    "orchestrator.learning.run_errors": ("RunError",),
    "orchestrator.runs.run_service": ("CheckReport",),
    "orchestrator.runs.added_pours": ("add_pour",),
    "orchestrator.records.events": ("Event",),
    "orchestrator.learning.campaign_plan": ("CampaignPlan",),
    "orchestrator.reports.recording_export": ("export_recordings",),
    "orchestrator.reports.recording_file": ("PourRecording", "load_recording", "load_recordings"),
    "orchestrator.reports.recording_fit": ("Fit", "Judgement", "fit_recordings", "judge_recording"),
    "orchestrator.reports.recording_replay": ("PourReplay", "ReplayValues", "replay_recording"),
    "orchestrator.reports.publishing": ("Published",),
    "orchestrator.reports.recording_figures": ("replay_figure",),
    "sim_engine.errors": ("DecantError", "InvalidArgumentError"),
    "sim_engine.resources": ("MissingExtraError",),
    "sim_engine.liquids": ("SimulationParameters",),
    "sim_engine.vessel.shapes": ("VesselSpec",),
}
"""Module → the names that it gives."""

_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


if not TYPE_CHECKING:  # else a type checker would take a misspelt name for Any

    def __getattr__(name: str) -> Any:
        """Import a name when it is asked for (PEP 562)."""
        if name == "events":
            return import_module("orchestrator.records.events")
        if name not in _HOME_OF:
            raise AttributeError(f"module 'decant' has no attribute '{name}'; it has {', '.join(__all__)}")
        return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
