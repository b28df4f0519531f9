"""Decant for notebooks and other programs: `import decant`. What it can do, with examples: docs/tutorials/notebook.md.

Everything here is imported when it is used first: `import decant` itself starts nothing and costs next to nothing.
Whatever is not named in `__all__` may change without notice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from decant.lazy_names import import_name, names_for_type_checkers

if TYPE_CHECKING:
    from actors.interfaces import LaboratoryError as LaboratoryError
    from decant.ask_tell import AskedPour as AskedPour
    from decant.ask_tell import AskTell as AskTell
    from decant.catalogue_tables import find_pours as find_pours
    from decant.catalogue_tables import find_runs as find_runs
    from decant.run_results import Run as Run
    from decant.run_results import open_run as open_run
    from decant.run_results import publish as publish
    from decant.running import RunningCampaign as RunningCampaign
    from decant.running import build_campaign as build_campaign
    from decant.running import calibrate as calibrate
    from decant.running import check as check
    from decant.running import doctor as doctor
    from decant.running import load_campaign as load_campaign
    from decant.running import load_vessel as load_vessel
    from decant.running import plan as plan
    from decant.running import run as run
    from decant.running import shipped as shipped
    from decant.running import start as start
    from decant.running import starting_set as starting_set
    from decant.simulation import Simulation as Simulation
    from decant.simulation import simulate as simulate
    from decant.simulation import simulate_many as simulate_many
    from decant.station import Station as Station
    from decant.station import StationPour as StationPour
    from orchestrator.campaigns.action_assignments import AssignmentError as AssignmentError
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError as ConfigError
    from orchestrator.learning.campaign_plan import CampaignPlan as CampaignPlan
    from orchestrator.learning.run_errors import RunError as RunError
    from orchestrator.materials.vessel_account import VesselAccount as VesselAccount
    from orchestrator.materials.vessel_account import VesselContent as VesselContent
    from orchestrator.recordings.recording_export import export_recordings as export_recordings
    from orchestrator.recordings.recording_figures import replay_figure as replay_figure
    from orchestrator.recordings.recording_file import PourRecording as PourRecording
    from orchestrator.recordings.recording_file import load_recording as load_recording
    from orchestrator.recordings.recording_file import load_recordings as load_recordings
    from orchestrator.recordings.recording_fit import Fit as Fit
    from orchestrator.recordings.recording_fit import Judgement as Judgement
    from orchestrator.recordings.recording_fit import fit_recordings as fit_recordings
    from orchestrator.recordings.recording_fit import judge_recording as judge_recording
    from orchestrator.recordings.recording_replay import PourReplay as PourReplay
    from orchestrator.recordings.recording_replay import ReplayValues as ReplayValues
    from orchestrator.recordings.recording_replay import replay_recording as replay_recording
    from orchestrator.records import events as events
    from orchestrator.records.events import Event as Event
    from orchestrator.reports.publishing import Published as Published
    from orchestrator.runs.added_pours import add_pour as add_pour
    from orchestrator.runs.added_pours import correct_pour as correct_pour
    from orchestrator.runs.bench_check import BenchReport as BenchReport
    from orchestrator.runs.run_service import CheckReport as CheckReport
    from sim_engine.errors import DecantError as DecantError
    from sim_engine.errors import InvalidArgumentError as InvalidArgumentError
    from sim_engine.liquids import SimulationParameters as SimulationParameters
    from sim_engine.resources import MissingExtraError as MissingExtraError
    from sim_engine.vessel.shapes import VesselSpec as VesselSpec

_HOMES = names_for_type_checkers(__file__)

if not TYPE_CHECKING:  # else a type checker would take a misspelt name for Any
    __all__ = list(_HOMES)

    def __getattr__(name: str) -> Any:
        return import_name(__name__, name, _HOMES)


def __dir__() -> list[str]:
    return list(_HOMES)
