"""What version 0.3.0 wrote is read by this version, as docs/reference/formats.md promises."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import decant
from actors.balance import line_recording
from actors.runtime.child_process import child_environment
from orchestrator.catalogue import catalogue
from orchestrator.daemon.state import daemon_store, state_backup
from orchestrator.materials import vessel_account
from orchestrator.materials.vessel_account import VesselAccount
from orchestrator.records import journal_file
from orchestrator.records.journal import JournalReader

ROOT = Path(__file__).parents[1]
WRITTEN = ROOT / "tests" / "data" / "formats" / "0.3.0"
PAGE = ROOT / "docs" / "reference" / "formats.md"
FILES = ("beaker", "campaign", "daemon", "laboratory", "study", "tumbler")


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """The state of a daemon with a finished campaign and a queued one, restored from its backup."""
    state_backup.restore(WRITTEN / "state.zip", tmp_path / "state")
    return tmp_path / "state"


def run_of(state: Path) -> Path:
    (folder,) = (state / "runs").iterdir()
    return folder


def command(*arguments: str, state: Path) -> str:
    code = f"import sys; sys.argv = {['decant', *arguments]!r}; from orchestrator.cli.app import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=child_environment({"DECANT_STATE": str(state)}),
        capture_output=True,
        text=True,
        timeout=250,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_page_has_the_versions_that_this_program_writes() -> None:
    rows = re.findall(r"^\| (.+?) \| (\d+|–) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    stated = {name.split(":")[0].split(" (")[0]: version for name, version in rows}
    assert stated["run"] == str(journal_file.FORMAT)
    assert stated["state of a daemon"] == str(daemon_store.FORMAT)
    assert stated["account of vessels"] == str(vessel_account.FORMAT)
    assert stated["backup of a state"] == str(state_backup.FORMAT)
    assert stated["catalogue of a machine"] == str(catalogue.FORMAT)
    assert stated["recorded lines of a balance"] == str(line_recording.FORMAT)


def test_its_files_are_valid(tmp_path: Path) -> None:
    files = [str(WRITTEN / f"{name}.yaml") for name in FILES]
    assert command("validate", *files, state=tmp_path).count(": ok (") == len(FILES)


def test_its_table_of_pours_is_read(tmp_path: Path) -> None:
    campaign = (WRITTEN / "campaign.yaml").read_text(encoding="utf-8")
    campaign = campaign.replace("count: 4, holdout: 1", f"from: {WRITTEN / 'pours.csv'}, holdout: 1")
    for name in FILES:
        (tmp_path / f"{name}.yaml").write_text((WRITTEN / f"{name}.yaml").read_text("utf-8"), encoding="utf-8")
    (tmp_path / "campaign.yaml").write_text(campaign, encoding="utf-8")
    calibration = decant.load_campaign(tmp_path / "campaign.yaml").calibration
    assert calibration is not None
    assert calibration.records is not None
    assert [round(1e3 * pour.spilled, 1) for pour in calibration.records.pours] == [1.2, 3.4, 9.8, 12.1]


def test_its_run_is_read_checked_and_reported(state: Path, tmp_path: Path) -> None:
    folder = run_of(state)
    with JournalReader(folder / "journal.sqlite") as journal:
        assert journal.header.name == "cup"
    run = decant.open_run(folder)
    assert run.verdict is not None
    assert (len(run.pours), run.verdict.word) == (6, "complete")
    assert run.theta is not None
    assert json.loads(command("runs", "check", str(folder), "--json", state=state))["problems"] == []
    command("report", str(folder), "--output", str(tmp_path / "report.html"), state=state)
    assert "Recommended" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_its_runs_and_pours_are_in_the_catalogue(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_STATE", str(state))
    command("runs", "add", str(state / "runs"), state=state)
    found = decant.find_runs("tray was dry")
    assert list(found["campaign"]) == ["cup"]
    assert len(decant.find_pours(campaign="cup")) == 6


def test_its_posterior_and_its_theta_are_used(state: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    command("runs", "add", str(WRITTEN / "posterior.yaml"), state=other)
    assert "friction" in command("runs", "known", state=other)
    theta = run_of(state) / "theta.json"
    action = {"angular_velocity": "110 deg/s", "x_offset": "112 mm"}
    simulation = decant.simulate(decant.load_campaign(WRITTEN / "campaign.yaml"), action, theta=theta)
    assert simulation.prediction["spillage"].mean < 0.2


def test_the_state_of_its_daemon_is_opened(state: Path) -> None:
    store = daemon_store.Store(state / "daemon.sqlite")
    try:
        assert {item.caller_id: item.state for item in store.items()} == {"first": "finished", "second": "queued"}
    finally:
        store.close()
    account = VesselAccount.open(state)
    contents = {name: account.content(name) for name in ("beaker-1", "cup-1")}
    assert {name: None if one is None else round(1e3 * one.mass) for name, one in contents.items()} == {
        "beaker-1": 150,
        "cup-1": 30,
    }


def test_every_event_of_its_stream_has_its_type_and_fields() -> None:
    page = (ROOT / "docs" / "reference" / "events.md").read_text(encoding="utf-8")
    documented = {
        section.partition("\n")[0]: set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))
        for section in re.split(r"^## ", page, flags=re.MULTILINE)[1:]
    }
    written: dict[str, list[str]] = json.loads((WRITTEN / "events.json").read_text(encoding="utf-8"))
    assert len(written) >= 10
    for name, fields in written.items():
        assert name in documented, name
        assert set(fields) <= documented[name] | documented["Event"] | {"type", "campaign"}, name


def fields_of(schema: dict[str, Any], description: dict[str, Any]) -> list[str]:
    """Names of the fields of a schema of OpenAPI, through its references."""
    if "$ref" in schema:
        schema = description["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return sorted(schema.get("properties", {}))


def routes(description: dict[str, Any]) -> dict[str, dict[str, list[str]]]:
    """Parameters, and fields of request and response, of each route."""
    found = {}
    for path, methods in description["paths"].items():
        for method, route in methods.items():
            body = route.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
            replies = (code.get("content", {}).get("application/json", {}) for code in route["responses"].values())
            reply = next((one["schema"] for one in replies if "schema" in one), {})
            found[f"{method.upper()} {path}"] = {
                "parameters": sorted(one["name"] for one in route.get("parameters", [])),
                "request": fields_of(body, description),
                "response": fields_of(reply, description),
            }
    return found


def test_every_route_of_its_api_has_its_parameters_and_fields() -> None:
    now = routes(json.loads((ROOT / "docs" / "openapi.json").read_text(encoding="utf-8")))
    written: dict[str, dict[str, list[str]]] = json.loads((WRITTEN / "api.json").read_text(encoding="utf-8"))
    assert len(written) >= 40
    for route, names in written.items():
        assert route in now, route
        for kind, fields in names.items():
            assert set(fields) <= set(now[route][kind]), f"{route}: {kind}"
