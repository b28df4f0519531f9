"""`app`: what every command line has: a version, completion, quiet; and what every verb of this one takes."""

from __future__ import annotations

import io
import re
import shlex
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import pytest
from rich.console import Console
from typer.testing import CliRunner

from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.yaml.yaml_errors import Problem
from orchestrator.cli import console as speaking
from orchestrator.cli.app import app
from orchestrator.records.events import LogLine
from orchestrator.reports.console_progress import ProgressDisplay
from tests.support import small_campaign
from tests.support.campaign_files import CAMPAIGN, DEPLOYED, VESSEL, report, write, write_good


@pytest.fixture(autouse=True)
def _loud_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speaking, "_quiet", False)


def invoke(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command), env={"COLUMNS": "120"})


def test_the_version_is_that_of_the_package() -> None:
    result = invoke("--version")
    assert (result.exit_code, result.stdout) == (0, f"decant {version('decant-pouring')}\n")


def test_shells_can_be_taught_to_complete() -> None:
    assert "--install-completion" in invoke("--help").stdout
    words = {"_DECANT_COMPLETE": "complete_bash", "COMP_WORDS": "decant va", "COMP_CWORD": "1"}
    assert CliRunner().invoke(app, [], env=words, prog_name="decant").stdout.split() == ["validate"]


class SeenError(Exception):
    """Raised where a run would begin."""


@pytest.fixture
def campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A good campaign in the working directory, and another laboratory that is called 'other'."""
    small_campaign.write_campaign(tmp_path)
    write(tmp_path, "other.yaml", "name: other\nbench: {liquid: {particles: 400}, time_scale: 0}\nin_process: true\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def begun(monkeypatch: pytest.MonkeyPatch, command: str) -> Any:
    """The plan that a command would begin with."""
    from orchestrator.cli import foreground_run as common

    plans = []

    def begin(request: Any, *args: Any, **kwargs: Any) -> NoReturn:
        plans.append((request.campaign, kwargs["again"](Path("runs/small-1"))))
        raise SeenError

    monkeypatch.setattr(common, "run_at_terminal", begin)
    result = invoke(command)
    assert isinstance(result.exception, SeenError), result.output
    return plans[0]


def test_a_run_takes_another_seed_and_tells_so_in_the_command_that_goes_on(
    campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, again = begun(monkeypatch, "run small.yaml --seed 41")
    assert (plan.seed, plan.resolved["seed"]) == (41, 41)
    assert re.search(r"decant run small\.yaml --resume --run small-1 --seed 41$", again)
    plan, again = begun(monkeypatch, "calibrate small.yaml")
    assert plan.seed == 3
    assert "--seed" not in again


@pytest.mark.parametrize(
    "verb", ["plan small.yaml", "pour small.yaml --set angular_velocity=100 --set x_offset=70", "run small.yaml"]
)
def test_verbs_that_need_a_laboratory_take_another_one(
    verb: str, campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, _ = begun(monkeypatch, f"{verb} --laboratory other.yaml")
    assert plan.laboratory.name == "other"


def test_quiet_leaves_notes_out_and_nothing_else(campaign: Path) -> None:
    write(campaign, "far.yaml", small_campaign.CAMPAIGN.replace("[60 mm, 100 mm]", "[200 mm, 300 mm]"))
    loud, quiet = invoke("validate far.yaml"), invoke("validate --quiet far.yaml")
    assert loud.stderr.startswith("warning: far.yaml:27:64: ")
    assert (quiet.stderr, quiet.stdout) == (loud.stderr, loud.stdout)
    bowl = "--height '50 mm' --diameters '1 mm: 100 mm, 50 mm: 160 mm' --wall '0.4 mm'"
    assert "too thin" in invoke(f"vessel profile bowl.yaml {bowl}").stderr
    assert invoke(f"vessel profile --quiet bowl-2.yaml {bowl}").stderr == ""
    write(campaign, "bad.yaml", small_campaign.CAMPAIGN.replace("pours: 2", "pour: 2"))
    assert "did you mean 'pours'?" in invoke("validate -q bad.yaml").stderr
    assert invoke("validate far.yaml").stderr == loud.stderr, "the next command is as loud as before"


def test_a_quiet_display_still_warns(campaign: Path) -> None:
    shown = io.StringIO()
    display = ProgressDisplay(load_campaign(Path("small.yaml")), console=Console(file=shown), quiet=True)
    with display:
        display(LogLine(level="info", text="the pool is up"))
        display(LogLine(level="warning", text="the balance is gone"))
    assert shown.getvalue() == "the balance is gone\n"


# -- how much is poured ------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What good campaigns refer to."""
    return write_good(tmp_path)


def test_a_load_is_given_by_its_volume_as_well(folder: Path) -> None:
    by_volume = CAMPAIGN.replace("mass: 200 g", "volume: 200 mL, density: 1.2 g/cm^3")
    plan = load_campaign(write(folder, "good.yaml", by_volume))
    assert plan.calibration is not None
    liquid = plan.calibration.scene.liquid
    assert (liquid.mass, liquid.volume) == (pytest.approx(0.24), pytest.approx(2e-4))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("mass: 200 g, volume: 200 mL", "3:36: liquid.volume: the load has a mass already; keep one of 'mass' and"),
        (
            "density: 998 kg/m^3",
            "3:1: liquid: key 'mass' is missing; add for example 'mass: 200 g', or 'volume: 200 mL'",
        ),
        ("volume: 200 g", "liquid.volume: '200 g' is a mass; should be a volume, for example '200 mL'"),
        ("volume: 50 L", "liquid.volume: 50 L is outside 0.1 … 20000 mL"),
    ],
)
def test_a_load_that_is_not_told_is_refused(given: str, said: str, folder: Path) -> None:
    text = report(write(folder, "bad.yaml", CAMPAIGN.replace("mass: 200 g", given)))
    assert said in text
    assert text.count("bad.yaml:") == 1


OBJECTIVE = """\
  objective: {name: target_volume, volume: 50 mL, tolerance: 2 mL}
"""


def test_a_receiver_needs_to_hold_only_what_is_asked_for(folder: Path) -> None:
    cup = VESSEL.replace("beaker", "small").replace("40", "20").replace("100", "60")  # 75 mL
    write(folder, "small.yaml", cup)
    deployed = DEPLOYED.replace("strategy: D3", "strategy: D3\n  receiver: small.yaml").replace(
        "  actions: {angular_velocity: [15 deg/s, 120 deg/s]}\n  pours: 15",
        "  actions: {angular_velocity: [15 deg/s, 120 deg/s], max_angle: [70 deg, 110 deg]}\n  pours: 15",
    )
    deployed = deployed.replace("motion: {max_angle: 110 deg, ", "motion: {").replace(
        "calibration:\n", "calibration:\n  motion: {max_angle: 110 deg}\n"
    )
    (problem,) = check_campaign(load_campaign(write(folder, "all.yaml", deployed)))
    assert "receiver can't hold the water (200 g): small holds 75.4 mL to the brim, 200.4 mL asked for" in str(problem)
    warned: list[Problem] = []
    plan = load_campaign(write(folder, "part.yaml", deployed + OBJECTIVE))
    assert check_campaign(plan, warn=warned.append) == []
    assert "the receiver holds 75.4 mL, enough for what is asked for, not for the water (200 g)" in str(warned[0])
    plan = load_campaign(write(folder, "much.yaml", deployed + OBJECTIVE.replace("50 mL", "90 mL")))
    (problem,) = check_campaign(plan)
    assert "receiver can't hold what is asked for: small holds 75.4 mL to the brim, 90 mL asked for" in str(problem)
