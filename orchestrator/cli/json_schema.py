"""JSON schemas: of input files, for editors; of `summary.json` and the output of commands, for programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.campaign_file import CampaignFile
from orchestrator.campaigns.file_references import VesselFile
from sim_engine.settings.model import SchemaGenerator, Settings
from sim_engine.settings.plugin_registry import file_kind

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def campaign_schema() -> dict[str, Any]:
    """Schema of campaign files."""
    return _schema(CampaignFile, "Campaign")


def vessel_schema() -> dict[str, Any]:
    """Schema of vessel files."""
    return _schema(VesselFile, "Vessel")


def laboratory_schema() -> dict[str, Any]:
    """Schema of laboratory files."""
    return _schema(LaboratorySettings, "Laboratory")


def study_schema() -> dict[str, Any]:
    """Schema of study files."""
    return _schema(file_kind("study").settings(), "Study")


def daemon_schema() -> dict[str, Any]:
    """Schema of the settings file of a daemon."""
    from orchestrator.daemon.state.daemon_settings import DaemonFile

    return _schema(DaemonFile, "Daemon")


def recording_schema() -> dict[str, Any]:
    """Schema of the YAML file of a recorded pour."""
    return _schema(file_kind("recording").settings(), "Recording")


def result_schema() -> dict[str, Any]:
    """Schema of a run's `summary.json`, with every kind of result."""
    from orchestrator.reports.run_summary import summary_schema

    return {"$schema": DIALECT, **summary_schema()}


def output_schema() -> dict[str, Any]:
    """Schema of the output of commands with `--json`; its properties are the commands."""
    from orchestrator.cli import json_output

    return {"$schema": DIALECT, **json_output.output_schema()}


SCHEMAS: dict[str, Callable[[], dict[str, Any]]] = {
    "campaign": campaign_schema,
    "vessel": vessel_schema,
    "laboratory": laboratory_schema,
    "study": study_schema,
    "daemon": daemon_schema,
    "recording": recording_schema,
    "result": result_schema,
    "output": output_schema,
}
"""Functions that create the schemas, by the names of the schema files."""


def write_schemas(directory: Path) -> list[Path]:
    """Write all schemas into a directory, each as NAME.json; returns the paths."""
    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, schema in SCHEMAS.items():
        path = directory / f"{name}.json"
        path.write_text(schema_text(schema()), encoding="utf-8")
        paths.append(path)
    return paths


def schema_text(schema: dict[str, Any]) -> str:
    """The schema as text of its file."""
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _schema(model: type[Settings], title: str) -> dict[str, Any]:
    schema = model.model_json_schema(by_alias=True, schema_generator=SchemaGenerator)
    return {"$schema": DIALECT, **schema, "title": title}
