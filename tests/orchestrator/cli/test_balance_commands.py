"""`balance_commands`: `decant balance check`: for a virtual laboratory it asks nobody; otherwise it says what it
needs.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from actors.balance import balance_check
from actors.balance.dialect_registry import dialects
from actors.balance.line_recording import LineRecording
from orchestrator.cli import balance_commands, motion_control
from orchestrator.cli.app import app

SHIPPED = Path(__file__).parents[3] / "configs" / "laboratories"


def check(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["balance", "check", *arguments], catch_exceptions=False)


@pytest.mark.slow
@pytest.mark.realtime
def test_the_balance_of_a_virtual_laboratory_is_checked_and_recorded_without_a_person(tmp_path, monkeypatch):
    monkeypatch.setattr(balance_check, "REST_TIME", 5.0)
    monkeypatch.setattr(balance_check, "STEP_TIME", 6.0)
    path = tmp_path / "day.jsonl"
    result = check(str(SHIPPED / "virtual.yaml"), "--record", str(path))
    assert result.exit_code == 0, result.stderr
    assert all(f"  {name}" in result.stdout for name in ("lag", "drift", "linearity", "vibration"))
    day = LineRecording.load(path)
    assert day.source == "virtual"
    assert day.weights(dialects()[day.about["dialect"]]) == day.about["weights"]


def test_a_mass_that_is_mistyped_is_asked_for_again(monkeypatch, capsys):
    typed = iter(["200", "200 g", ""])
    monkeypatch.setattr(motion_control, "typed_line", lambda prompt: next(typed))
    person = balance_commands.CheckingPerson()
    assert (person.reference(), person.reference()) == (0.2, None)
    assert "type '200 g' if that is what is meant" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["/dev/no-balance"], "asks for loads at a terminal"),
        (["127.0.0.1:4001", "--set", "dialect"], "should be a key and a value, as dialect=kcp"),
        (["127.0.0.1:4001", "--set", "dialect=latin"], "kern-continuous"),
        (["/dev/x", "--set", "bauds=9600"], "did you mean 'baud'?"),
        (["127.0.0.1:4001", "--set", "dtr=false"], "has no effect over TCP; set it in the serial server"),
        ([str(SHIPPED / "virtual.yaml"), "--set", "baud=9600"], "a laboratory file has the settings"),
        ([str(SHIPPED / "twin.yaml")], "no balance on a serial line or over TCP"),
    ],
)
def test_a_check_that_can_not_begin_says_why(arguments, said):
    result = check(*arguments)
    assert result.exit_code == 2
    assert said in result.stderr
