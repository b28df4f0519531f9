"""`validity_warnings`: what is not simulated is told where people meet it: once per campaign, for its best actions,
for a single pour.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import pytest
from typer.testing import CliRunner

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.app import app
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.reports.console_view import summary_table
from orchestrator.reports.summarise import summarise
from orchestrator.reports.validity_warnings import (
    best_action_warnings,
    campaign_warnings,
    not_simulated,
    numbers_line,
    regimes_of,
)
from sim_engine.action import DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.model_validity import NotCovered
from sim_engine.search_space import Axis, Space
from tests.support import example_run, small_campaign
from tests.support.example_results import changed, shown

CAMPAIGNS = Path(__file__).parents[3] / "configs" / "campaigns"
SLOW = Space((Axis("angular_velocity", 5 * DEG, 10 * DEG), Axis("max_angle", 70 * DEG, 75 * DEG)))
QUICK = Space((Axis("angular_velocity", 80 * DEG, 120 * DEG), Axis("max_angle", 110 * DEG, 120 * DEG)))


def deploying(actions: Space, **changes: float) -> CampaignPlan:
    """A campaign without calibration, in one scene, with many particles."""
    plan = example_run.campaign()
    assert plan.deployment is not None
    liquid = example_run.NARROW.liquid.model_copy(update=changes)
    scene = replace(example_run.NARROW, liquid=liquid, fixed={"height": 0.05, "x_offset": 0.09})
    deployment = replace(plan.deployment, scenes=(scene,), actions=actions)
    parameters = plan.parameters.model_copy(update={"particles": 20_000})
    return replace(plan, calibration=None, deployment=deployment, parameters=parameters)


def test_a_space_of_slow_pours_is_warned_of_and_one_of_quick_pours_is_not() -> None:
    (warnings,) = campaign_warnings(deploying(SLOW)).values()
    assert {one.kind for one in warnings} == {"dribbling", "wetting"}
    assert all((one.hit, one.tried) == (5, 5) for one in warnings)
    assert campaign_warnings(deploying(QUICK)) == {}


def test_a_warning_names_the_worst_action_and_how_many_were_tried() -> None:
    mixed = Space((Axis("angular_velocity", 40 * DEG, 90 * DEG), Axis("max_angle", 66 * DEG, 120 * DEG)))
    warnings = campaign_warnings(deploying(mixed))
    (dribbling,) = (one for one in warnings["narrow cup"] if one.kind == "dribbling")
    assert dribbling.action_si["max_angle"] == pytest.approx(66 * DEG)
    assert (dribbling.hit, dribbling.tried) == (3, 5)  # the middle of 93° and those to 66°, not those to 120°
    (header, *told) = not_simulated(deploying(mixed), print)
    assert header.startswith("not simulated")
    assert any("into narrow, dribbling: " in line and "3 of 5 actions tried)" in line for line in told)
    assert any("max angle 66 deg" in line for line in told)


def test_the_quickstart_begins_without_a_warning_and_its_report_has_those_of_the_corners() -> None:
    plan = load_campaign(CAMPAIGNS / "quickstart.yaml")
    assert not_simulated(plan, print) == []
    ((corner,),) = campaign_warnings(plan).values()
    assert (corner.kind, corner.hit, corner.tried) == ("thin_stream", 2, 5)


def test_a_viscous_liquid_is_told_by_its_viscosity_alone() -> None:
    (warnings,) = campaign_warnings(deploying(QUICK, dynamic_viscosity=3.0)).values()
    assert [one.kind for one in warnings] == ["viscous"]


def test_calibration_counts_with_the_middle_of_the_particles_that_it_searches() -> None:
    plan = load_campaign(CAMPAIGNS / "quickstart.yaml")
    assert plan.calibration is not None

    def thin(lower: int, upper: int) -> bool:
        axis = Axis("particles", lower, upper, "log", integer=True)
        assert plan.calibration is not None
        calibration = replace(plan.calibration, parameters=Space((axis,)))
        found = campaign_warnings(replace(plan, calibration=calibration, deployment=None))
        return "thin_stream" in {one.kind for one in found.get("calibration", ())}

    assert thin(300, 600)
    assert not thin(20_000, 50_000)


def test_the_recommended_action_is_judged_with_the_calibrated_number_of_particles(results: dict[str, Any]) -> None:
    plan = deploying(QUICK)
    best = {"angular_velocity": 90 * DEG, "max_angle": 115 * DEG}
    learnt = results["narrow cup"]
    deployed = changed(learnt, recommended=changed(learnt.recommended, action_si=best))
    assert best_action_warnings(plan, {"narrow cup": deployed}) == {"narrow cup": []}
    coarse = changed(
        results["calibration"], found=changed(results["calibration"].found, theta=SimulationParameters(particles=200))
    )
    (told,) = best_action_warnings(plan, {"calibration": coarse, "narrow cup": deployed})["narrow cup"]
    assert told.kind == "thin_stream"
    assert best_action_warnings(plan, {"narrow cup": changed(deployed, recommended=None)}) == {}


def test_the_summary_has_them_for_people_and_for_programs(results: dict[str, Any]) -> None:
    plan = example_run.campaign()
    spaces = campaign_warnings(deploying(SLOW))
    deployed = {"narrow cup": results["narrow cup"]}
    best = {"narrow cup": [NotCovered(one.kind, one.share, one.text) for one in spaces["narrow cup"]]}
    summary = summarise(plan, deployed, not_covered=spaces, best_not_covered=best)
    written = summary.model_dump(mode="json")["outcome"]
    assert [one["kind"] for one in written["not_covered"]["narrow cup"]] == ["dribbling", "wetting"]
    assert [one["kind"] for one in written["receivers"]["narrow cup"]["not_covered"]] == [
        "dribbling",
        "wetting",
    ]
    text = " ".join(shown(summary_table(summary)).split())
    assert "Not simulated at this action, dribbling: " in text
    assert "at this action, dribbling" not in shown(summary_table(summarise(plan, deployed)))


def test_numbers_are_told_with_digits_that_mean_something() -> None:
    scene = example_run.NARROW
    found = regimes_of(scene, example_run.ACTION, 2_000, 0.0)
    assert found.lip is not None
    line = numbers_line(found)
    assert f"We {found.lip.weber.smallest:.2g} … {found.lip.weber.largest:.2g}" in line
    assert "e+" not in line
    nothing = regimes_of(scene, example_run.ACTION.with_values(max_angle=10 * DEG), 2_000, 0.0)
    assert numbers_line(nothing) == "nothing leaves the pourer, as far as hydrostatics tells"


# -- the commands ------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign of slow pours in a working directory in which no laboratory opens."""
    from actors import laboratory

    def closed(*args: object, **kwargs: object) -> NoReturn:
        raise OSError(28, "No space left on device", "campaign.rrd")

    slow = small_campaign.CAMPAIGN.replace("[60 deg/s, 180 deg/s], x_offset", "[5 deg/s, 10 deg/s], x_offset")
    small_campaign.write_campaign(tmp_path, slow.replace("max_angle: 115 deg", "max_angle: 60 deg"))
    monkeypatch.setattr(laboratory, "open_laboratory", closed)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def invoke(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command), env={"COLUMNS": "120"})


@pytest.mark.parametrize("verb", ["run", "plan"])
def test_a_campaign_begins_with_what_is_not_simulated_in_it_each_kind_once(verb: str, folder: Path) -> None:
    told = invoke(f"{verb} small.yaml").stderr.splitlines()
    assert sum(line.startswith("not simulated") for line in told) == 1
    assert sum(line.strip().startswith("into narrow, dribbling: ") for line in told) == 1


def test_a_resumed_run_does_not_say_it_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from orchestrator.cli.foreground_run import run_at_terminal
    from orchestrator.runs.run_service import RunResources
    from orchestrator.runs.run_tasks import run_task
    from sim_engine.errors import DecantError

    request = replace(run_task(load_campaign(folder / "small.yaml")), folder=folder)
    resumed = replace(request, resume=True)
    for each, times in ((request, 1), (resumed, 0)):
        with pytest.raises(DecantError, match="No space left"):
            run_at_terminal(each, RunResources(), again=str)
        assert capsys.readouterr().err.count("not simulated (docs") == times


def test_calibrate_is_silent_about_a_deployment_that_it_does_not_make(folder: Path) -> None:
    assert "into narrow" not in invoke("calibrate small.yaml").stderr


def test_a_vessel_that_can_t_be_judged_stops_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrator.reports import validity_warnings as regimes

    def broken(*args: object) -> NoReturn:
        raise ValueError("the pourer has no lip")

    monkeypatch.setattr(regimes, "campaign_warnings", broken)
    result = invoke("run small.yaml")
    assert "could not be worked out: the pourer has no lip" in result.stderr
    assert "No space left on device" in result.stderr  # it went on to where this test ends it
