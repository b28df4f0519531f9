"""`dose_flows`: a simulated dose out of a vessel that is no straight cup, in `validate` and `dose --dry-run`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

from actors.interfaces import LaboratoryError
from orchestrator.campaigns import dose_flows as module
from orchestrator.campaigns.dose_flows import dose_flows, simulated_knowledge
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.dispense import Dispense, SourcesRead
from orchestrator.learning.requests import Pour
from orchestrator.learning.strategy import Slots
from orchestrator.runs.stages import DOSES, SOURCES, stages_of
from tests.orchestrator.cli.test_dose_command import decant
from tests.support import small_campaign
from tests.support.equation_pours import EquationPours

FLASK = "name: flask\nprofile: {unit: mm, inner: [[0, 0], [35, 0], [35, 60], [25, 70]], wall: 4 mm, floor: 4 mm}\n"


@pytest.fixture
def flask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign whose source narrows towards its rim; nothing was simulated before."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_compared_before", {})
    text = small_campaign.series(20, 12).replace(
        "liquid: {particles: 400}", "liquid: {particles: 4000}, doses: particles"
    )
    path = small_campaign.write_campaign(tmp_path, text)
    (tmp_path / "beaker.yaml").write_text(FLASK, encoding="utf-8")
    return path


def poured_as(monkeypatch: pytest.MonkeyPatch, pours: EquationPours) -> None:
    monkeypatch.setattr(module, "LivePourProcess", lambda: pours)
    monkeypatch.setattr(EquationPours, "begun", 0)


def test_validate_and_a_dry_run_show_one_simulated_dose_and_its_picture(
    flask: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poured_as(monkeypatch, EquationPours(math.radians(2.0), 0.8))
    checked = decant("validate", str(flask))
    assert checked.exit_code == 0
    assert "water out of 'flask', simulated with 2000 particles: the flow begins" in checked.stderr
    picture = Path("runs") / "series-flask-water-into-narrow-flow.png"
    assert str(picture) in checked.stderr.replace("\n", "")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "warning" not in checked.stderr
    predicted = decant("dose", str(flask), "--dry-run")
    assert "simulated with 2000 particles" in predicted.stderr
    assert EquationPours.begun == 1


def test_an_equal_dose_is_simulated_once_and_another_one_again(flask: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poured_as(monkeypatch, EquationPours(math.radians(2.0)))
    plan = load_campaign(flask)
    (first,) = dose_flows(plan)
    monkeypatch.setattr(module, "_compared_before", {})  # as in another process
    (again,) = dose_flows(dataclasses.replace(plan, name="another"))
    assert (EquationPours.begun, again.text()) == (1, first.text())
    assert plan.dispense is not None
    fuller = tuple(
        dataclasses.replace(scene, liquid=scene.liquid.model_copy(update={"mass": 0.11}))
        for scene in plan.dispense.scenes
    )
    dose_flows(dataclasses.replace(plan, dispense=dataclasses.replace(plan.dispense, scenes=fuller)))
    assert EquationPours.begun == 2


@pytest.mark.parametrize(
    ("pours", "text"),
    [
        (EquationPours(stops=1.0), "from the equation of the dose controller"),
        (EquationPours(missed=0.4), "fall next to 'narrow': change x_offset or height, or use a wider receiver"),
    ],
)
def test_what_may_spoil_doses_is_a_warning(
    flask: Path, monkeypatch: pytest.MonkeyPatch, pours: EquationPours, text: str
) -> None:
    poured_as(monkeypatch, pours)
    checked = decant("validate", str(flask))
    assert checked.exit_code == 0
    assert checked.stderr.count("warning: ") == 1
    assert text in checked.stderr


def test_a_stream_that_misses_the_receiver_in_the_simulation_is_refused(
    flask: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poured_as(monkeypatch, EquationPours(missed=0.9))
    checked = decant("run", str(flask))
    assert checked.exit_code == 2
    assert checked.stderr.count("fall next to 'narrow': change x_offset or height") == 1
    assert not Path("runs").exists()


def test_a_simulation_that_fails_is_a_warning_and_no_picture(flask: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> EquationPours:
        raise LaboratoryError("no solver here")

    monkeypatch.setattr(module, "LivePourProcess", fails)
    checked = decant("validate", str(flask))
    assert checked.exit_code == 0
    assert "the flow could not be compared with a simulation: no solver here" in checked.stderr
    assert not Path("runs").exists()
    assert simulated_knowledge(load_campaign(flask)) == {}


def test_a_straight_cup_is_not_simulated(flask: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poured_as(monkeypatch, EquationPours())
    (flask.parent / "beaker.yaml").write_text(small_campaign.BEAKER, encoding="utf-8")
    assert decant("validate", str(flask)).exit_code == 0
    assert EquationPours.begun == 0
    assert not Path("runs").exists()


def test_the_first_dose_begins_with_the_simulated_difference_as_an_error(
    flask: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poured_as(monkeypatch, EquationPours(math.radians(3.0)))
    stages = {stage.name: stage for stage in stages_of(load_campaign(flask))}
    read = stages[SOURCES].build({}, 5).result()
    assert isinstance(read, SourcesRead)
    assert set(read.simulated) == {"flask"}
    strategy = stages[DOSES].build({SOURCES: SourcesRead.model_validate_json(read.model_dump_json())}, 5)
    assert isinstance(strategy, Dispense)
    (pour,) = strategy.ask(Slots(0, 1))
    assert isinstance(pour, Pour)
    assert pour.dose is not None
    assert pour.dose.source is not None
    knowledge = pour.dose.source.knowledge
    assert knowledge == simulated_knowledge(load_campaign(flask))["flask"]
    assert math.degrees(math.sqrt(knowledge.covariance[0])) > 2.0
