"""`stage_result`: what stages learnt, written and read back by its kind; and what is written after a run, whoever
drove it.
"""

from __future__ import annotations

import asyncio
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import StageResult
from orchestrator.records.codec import decode_result, encode_result, result_of
from orchestrator.reports.publishing import publish
from tests.support import example_run
from tests.support.example_results import changed
from tests.support.toy_campaign import run_toy


def test_results_read_back_as_they_were_bit_for_bit(results: dict[str, Any]) -> None:
    for result in results.values():
        assert decode_result(json.loads(json.dumps(encode_result(result), allow_nan=False))) == result


def test_a_number_that_is_none_survives_the_journal(results: dict[str, Any]) -> None:
    spoilt = changed(results["calibration"].trials[0], discrepancy=math.nan)
    result = changed(results["calibration"], trials=[spoilt])
    again = decode_result(json.loads(json.dumps(encode_result(result), allow_nan=False)))
    assert isinstance(again, Calibrated)
    assert again.trials[0].discrepancy is not None
    assert math.isnan(again.trials[0].discrepancy)


def test_a_kind_that_nobody_knows_is_said_with_those_that_are_known() -> None:
    with pytest.raises(RunError, match=r"kind 'guess' is not known; is the package installed .* calibration"):
        decode_result({"kind": "guess"})
    with pytest.raises(RunError, match="'calibration' can't be read: strategy: Field required"):
        decode_result({"kind": "calibration"})


def test_two_kinds_of_one_name_and_a_result_without_one_are_refused() -> None:
    with pytest.raises(TypeError, match="Calibrated has the kind 'calibration' already"):

        class Impostor(StageResult):
            kind: Literal["calibration"] = "calibration"

    with pytest.raises(TypeError, match="has to declare its kind"):

        class Nameless(StageResult):
            pass


def test_a_stage_that_learnt_something_else_is_named(results: dict[str, Any]) -> None:
    assert result_of(results, "narrow cup", Deployed) is results["narrow cup"]
    with pytest.raises(RunError, match=r"stage narrow cup should have learnt a Calibrated, but .* 'deployment'"):
        result_of(results, "narrow cup", Calibrated)
    with pytest.raises(RunError, match="stage pours should have learnt a Calibrated, but there is nothing"):
        result_of(results, "pours", Calibrated)


@pytest.mark.slow
def test_publishing_names_the_recording_and_can_be_done_again(tmp_path: Path, results: dict[str, Any]) -> None:
    from dataclasses import replace

    recording = tmp_path / "campaign.rrd"
    result = replace(asyncio.run(run_toy(tmp_path / "run")), results=results)
    published = publish(example_run.campaign(), result, recording, 3)
    assert published.recording == published.summary.files.recording == recording
    assert published.summary.files.dropped_events == 3
    assert published.theta is not None
    assert json.loads(published.theta.read_text())["theta"] == results["calibration"].found.theta.model_dump()
    assert all(path.is_file() for path in published.figures.values())
    summary = (tmp_path / "run" / "summary.json").read_text()
    assert json.loads(summary)["learning"]["theta"] == results["calibration"].found.theta.model_dump()
    publish(example_run.campaign(), result, recording, 3)
    assert (tmp_path / "run" / "summary.json").read_text() == summary


def test_kinds_of_installed_strategies_are_in_the_schema_and_others_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrator.learning import strategy_registry as module
    from orchestrator.reports.run_summary import summary_schema
    from tests.support.scripted_strategy import Scripted

    assert Scripted not in module.result_kinds()
    settings = type("Settings", (), {"__module__": Scripted.__module__})
    monkeypatch.setattr(
        "orchestrator.learning.strategy_registry.STRATEGIES", SimpleNamespace(all={"scripted": settings})
    )
    assert Scripted in module.result_kinds()
    assert "Scripted" in summary_schema()["$defs"]
