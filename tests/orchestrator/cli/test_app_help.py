"""`app`: what the command's help teaches, and what it says before anything has begun."""

from __future__ import annotations

import errno
import importlib.util
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn, get_args

import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.cli.command_options import Answer
from orchestrator.runs.resume import LOST, REPEAT
from tests.support.cli_inputs import ROOT, command_tree, invoke, write_inputs

HELP = {
    "": ["decant run configs/campaigns/quickstart.yaml", "2 bad input", "130 interrupted"],
    "run": ["decant run my.yaml --resume", "Ctrl-C pauses", "outputs.directory"],
    "calibrate": ["decant calibrate configs/campaigns/recorded.yaml --json", "theta.json", "N/m"],
    "plan": ["--receiver vase.yaml", "deg/s, mm and s", "Nothing is poured"],
    "simulate": [
        "--set x_offset=90   # deg/s and mm",
        "'angular_velocity=0.7 rad/s'",
        "in_flight",
        "--seeds",
    ],
    "validate": ["decant validate configs/campaigns/*.yaml", "units, bounds"],
    "schema": ["decant schema result > result.json"],
}


@pytest.mark.parametrize("verb", HELP, ids=lambda verb: verb or "decant")
def test_help_teaches_units_and_shows_examples(verb: str) -> None:
    result = invoke(f"{verb} --help")
    assert result.exit_code == 0
    for words in HELP[verb]:
        assert words in result.stdout


def below(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """A command with its words, and everything below it."""
    yield words, command
    for name, found in getattr(command, "commands", {}).items():
        yield from below(found, (*words, name))


def test_help_of_every_command_and_group_ends_with_examples_that_are_understood() -> None:
    program = command_tree()
    for words, command in below(program, ("decant",)):
        text = command.epilog or command.help
        lines = [shlex.split(line.strip(" `"), comments=True) for line in text.splitlines()]
        shown = [line for line in lines if tuple(line[: len(words)]) == words]
        assert shown, f"the help of '{' '.join(words)}' has no example of it"
        for line in shown:
            end = min((line.index(word) for word in ("&&", ">") if word in line), default=None)
            found, rest = program, line[1:end]
            while rest and rest[0] in getattr(found, "commands", {}):
                found = found.commands[rest.pop(0)]  # type: ignore[attr-defined]
            try:
                found.make_context(line[0], rest).close()  # raises on an argument or option that the command lacks
            except Exception as error:
                if not str(error).endswith("does not exist."):  # the reader's own files
                    raise


def test_help_of_answer_names_all_that_may_be_answered() -> None:
    (option,) = get_args(Answer)[1:]
    for answer in (LOST, REPEAT, "weighed"):
        assert f"'{answer}" in option.help


def test_a_full_disk_ends_a_run_with_its_name_and_advises_no_resuming_of_what_had_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from actors import laboratory

    def full(*args: object, **kwargs: object) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device", "campaign.rrd")

    write_inputs(tmp_path)
    monkeypatch.setattr(laboratory, "open_laboratory", full)
    monkeypatch.chdir(tmp_path)
    result = invoke("run small.yaml")
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 1
    assert "MB are free there. A run needs" in result.stderr
    assert "nothing had begun" in result.stderr
    assert "--resume" not in result.stderr


def test_a_campaign_runs_on_another_laboratory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrator.campaigns.file_loading import load_campaign

    twin = ROOT / "configs" / "laboratories" / "twin.yaml"
    plan = load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml", twin)
    assert plan.laboratory.arm is None
    assert plan.laboratory.bench is not None
    campaign = str(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    refused = CliRunner().invoke(app, ["run", campaign, "--laboratory", str(tmp_path / "none.yaml")])
    assert refused.exit_code == 2
    assert "none.yaml" in refused.stderr
    # What the bench is reached with is missed before anything starts.
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "serial" else find(name))
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(app, ["run", campaign])
    assert refused.exit_code == 2
    assert "arm and balance need 'pyserial', not installed here" in refused.stderr
