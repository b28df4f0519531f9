"""`json_output`: commands with --json print their models; catalogue and daemon return what their documented schema
says.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.cli.json_output import OUTPUTS
from tests.orchestrator.catalogue.test_catalogue import made
from tests.support import small_campaign
from tests.support.cli_inputs import CSV, ROOT, process
from tests.support.daemon_thread import Real
from tests.support.output_schema import validated

ACTION = "--set angular_velocity=100 --set x_offset=70"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outputs")
    small_campaign.write_campaign(folder)
    (folder / "pours.csv").write_text(CSV)
    return folder


def commands(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    if isinstance(getattr(command, "commands", None), dict):
        for name, below in command.commands.items():
            yield from commands(below, (*words, name))
    else:
        yield " ".join(words), command


def test_every_command_with_json_has_a_schema() -> None:
    printing = {
        name
        for name, command in commands(typer.main.get_command(app))
        if any("--json" in option.opts for option in command.params)
    }
    assert printing == set(OUTPUTS)


def said(command: str) -> str:
    done = CliRunner().invoke(app, shlex.split(command), catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "options"),
    [
        pytest.param("run", "--in-process", marks=pytest.mark.slow),
        pytest.param("calibrate", "--in-process", marks=pytest.mark.slow),
        pytest.param("plan", "--in-process --iterations 2 --seeds 2", marks=pytest.mark.slow),
        ("simulate", f"{ACTION} --seeds 2"),
    ],
)
def test_work_on_a_campaign_prints_what_is_documented(campaign: Path, command: str, options: str) -> None:
    done = process(f"{command} small.yaml {options} --json", campaign)
    assert done.returncode == 0, done.stderr
    found = validated(command, done.stdout)
    if command == "plan":
        assert (
            found["prediction_interval"]["low"] <= found["predicted_spillage"] <= found["prediction_interval"]["high"]
        )


def test_queries_of_the_catalogue_print_what_is_documented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    run = made(tmp_path)
    assert validated("runs list", said("runs list --json"))["runs"]
    assert validated("runs pours", said("runs pours --json"))["pours"]
    for command in (f"show {run.name}", f"check {run.name}"):
        name = f"runs {command.partition(' ')[0]}"
        validated(name, said(f"runs {command} --json"))


def test_queries_of_a_daemon_print_what_is_documented(tmp_path: Path) -> None:
    real = Real(tmp_path / "state")
    try:
        reach = f"--url {real.url} --state {tmp_path / 'state'}"
        said(f"queue pause {reach}")
        submitted = said(f"queue submit {shlex.quote(str(ROOT / 'configs/campaigns/quickstart.yaml'))} {reach} --json")
        key = validated("queue submit", submitted)["id"]
        assert validated("queue list", said(f"queue list {reach} --json"))["campaigns"]
        assert validated("queue list", said(f"queue list {key} {reach} --json"))["id"] == key
        for line in said(f"queue logs {reach} --json").splitlines():
            validated("queue logs", line)
    finally:
        real.close()
