"""Files of earlier versions get the present names, in place, and keep everything else."""

from __future__ import annotations

import shutil
import stat
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.config.migration import migrate_file
from orchestrator.config.yaml.section_validation import validate
from orchestrator.config.yaml.yaml_source import Document, Place, Report
from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity


class Wheel(Settings):
    retired: ClassVar[dict[str, str]] = {"size": "radius"}
    radius: Annotated[float, Quantity("m", "300 mm", 0.0, 1.0)]


class Cart(Settings):
    retired: ClassVar[dict[str, str]] = {"pace": "speed", "drive: clockwork": "drive: spring", "wheel_list": "wheels"}
    removed: ClassVar[dict[str, str]] = {"horse": "was retired; remove it"}
    speed: Annotated[float, Quantity("m/s", "1 m/s", 0.0, 9.0)]
    drive: Literal["spring", "motor"] = "spring"
    wheels: tuple[Wheel, ...] = ()


OLD = """\
# a cart; its pace: see below
pace: 2 m/s       # pace stays pace in comments
drive: "clockwork"
wheel_list:
  - {size: 300 mm}   # size
  - size: 20 cm
"""

NEW = """\
# a cart; its pace: see below
speed: 2 m/s       # pace stays pace in comments
drive: "spring"
wheels:
  - {radius: 300 mm}   # size
  - radius: 20 cm
"""


def load(path: Path) -> None:
    report = Report()
    validate(Cart, Place(Document.read(path)), report)
    report.raise_if_any()


def test_names_are_replaced_where_they_are_keys_or_values_and_nothing_else_is(tmp_path: Path) -> None:
    file = tmp_path / "cart.yaml"
    file.write_bytes(OLD.replace("\n", "\r\n").encode())
    file.chmod(0o640)
    result = migrate_file(file, load)
    assert file.read_bytes().decode() == NEW.replace("\n", "\r\n")
    assert result.problems == ()
    assert sorted(result.renamed) == [
        (2, "pace", "speed"),
        (3, "clockwork", "spring"),
        (4, "wheel_list", "wheels"),
        (5, "size", "radius"),
        (6, "size", "radius"),
    ]
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert [path.name for path in tmp_path.iterdir()] == ["cart.yaml"]
    assert migrate_file(file, load).renamed == ()


def test_what_has_no_new_name_is_left_to_the_user_with_its_place(tmp_path: Path) -> None:
    file = tmp_path / "cart.yaml"
    file.write_text("horse: brown\npace: 2 m/s\nsped: 3 m/s\n", encoding="utf-8")
    result = migrate_file(file, load)
    assert file.read_text(encoding="utf-8") == "horse: brown\nspeed: 2 m/s\nsped: 3 m/s\n"
    assert [(problem.line, problem.where) for problem in result.problems] == [(1, "horse"), (3, "sped")]


def test_a_new_name_that_is_there_already_does_not_loop(tmp_path: Path) -> None:
    file = tmp_path / "cart.yaml"
    file.write_text("pace: 2 m/s\nspeed: 3 m/s\n", encoding="utf-8")
    result = migrate_file(file, load)
    assert ["duplicate" in problem.message for problem in result.problems] == [True]


@pytest.mark.parametrize("text", ["", "a: [", "just text"])
def test_a_file_that_is_none_stays_as_it_is_and_its_problem_is_reported(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cart.yaml"
    file.write_text(text, encoding="utf-8")
    assert migrate_file(file, load).problems
    assert file.read_text(encoding="utf-8") == text


def test_the_command_reports_what_it_did_and_what_is_left(tmp_path: Path) -> None:
    shutil.copytree("configs", tmp_path / "configs")
    campaign = tmp_path / "configs/campaigns/quickstart.yaml"
    done = CliRunner().invoke(app, ["migrate", str(campaign)])
    assert (done.exit_code, done.stdout) == (0, f"{campaign}: nothing to rename\n")
    campaign.write_text(
        campaign.read_text().replace("  strategy: D3\n", "  strategy: D3\n  trust: always\n"), encoding="utf-8"
    )
    left = CliRunner().invoke(app, ["migrate", str(campaign)])
    assert left.exit_code == 2
    assert "deployment.trust: was retired; remove it" in left.stderr


def test_a_file_of_parameters_gets_the_present_names(tmp_path: Path) -> None:
    theta = tmp_path / "theta.yaml"
    theta.write_text("cohesion: 0.05 N/m\nviscosity: 6 1/s  # of XSPH\neddies: 0.1\n", encoding="utf-8")
    done = CliRunner().invoke(app, ["migrate", str(theta)])
    assert done.exit_code == 0, done.stderr
    assert theta.read_text(encoding="utf-8") == (
        "cohesion: 0.05 N/m\nxsph_rate: 6 1/s  # of XSPH\nsmagorinsky_constant: 0.1\n"
    )
