"""Each kind of ending of a run, and every place that tells what the run reached: all show the same verdict."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from typer.testing import CliRunner

import decant
from actors.interfaces import InvalidActionError, LaboratoryError, UnknownPourError
from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.cli.app import app
from orchestrator.daemon.integrations.sila_server import OrderFailedError, _has_ended
from orchestrator.daemon.state.notifications import Notifier
from orchestrator.records.run_registry import VARIABLE
from sim_engine.outcome import PourMeasurement
from tests.orchestrator.daemon.state.test_notifications import WebReceiver
from tests.orchestrator.reports.test_mixture_report import MIXTURES
from tests.support.small_campaign import series, write_campaign
from tests.support.toy_campaign import ToyOptimizer, ToySimulators
from tests.support.toy_daemon import CAMPAIGN, HeldBench, HeldLaboratory, run, serving
from tests.support.waiting import wait_for

QUIET = "recording: false, figures: false"
RACK = MIXTURES.replace("outputs: {directory: runs, recording: false}", f"outputs: {{{QUIET}}}")
SERIES = series(20, 25, outputs=QUIET)


class ScriptedBench(HeldBench):
    """Pours what a list says, one entry a pour: the error of a dose [g], or an exception; exactly after its end."""

    def __init__(self, script: list[float | Exception]) -> None:
        super().__init__()
        self._script = script

    async def pour(self, scene: Any, action: Any, *, seed: int, progress: Any = None, dose: Any = None) -> Any:
        step = self._script.pop(0) if self._script else 0.0
        if isinstance(step, Exception):
            raise step
        if dose is None:
            return await super().pour(scene, action, seed=seed, progress=progress)
        received, held = dose.amount + 1e-3 * step, dose.source.mass
        about = {"received": received, "left": [held - received, 1e-3], "deviation": 2e-4, "end": "time limit"}
        return PourMeasurement(held, 0.0, held - received, {"dose": about})


class RecommendingOptimizer(ToyOptimizer):
    """Recommends its last point, if anything was measured."""

    async def suggest(self, query: Any) -> Any:
        found = await super().suggest(query)
        best = {"best_point": found.points[-1], "best_mean": 0.1, "best_deviation": 0.01}
        return replace(found, **best) if len(getattr(query, "data", ())) else found


@dataclass
class Ending:
    """One kind of ending.

    Attributes:
        steps: makes what the bench does; a run uses them up.
        stops: whether the run stops before its end.
    """

    campaign: str
    steps: Callable[[], list[float | Exception]]
    word: str
    text: str
    cups: list[str] = field(default_factory=list)
    stops: bool = False


def refused() -> Exception:
    return InvalidActionError("the gripper would come within 15 mm of rack/A2")


ENDINGS = {
    "all cups reached": Ending(RACK, list, "complete", "2 of 2 cups reached", ["full", "full", "full"]),
    "a dose of five times its amount": Ending(
        RACK, lambda: [0.0, 80.0], "incomplete", "1 of 2 cups reached; 1 missed", ["missed", "missed", "full"]
    ),
    "every cup refused": Ending(
        RACK, lambda: [refused(), refused()], "nothing", "0 of 2 cups reached; 2 refused", ["refused"] * 3
    ),
    "the last cup refused": Ending(
        RACK, lambda: [0.0, 0.0, refused()], "incomplete", "1 of 2 cups reached; 1 refused", ["full", "full", "refused"]
    ),
    "a dose failed": Ending(
        RACK,
        lambda: [LaboratoryError("the arm stopped")],
        "incomplete",
        "1 of 2 cups reached; 1 UNKNOWN",
        ["unknown", "unknown", "full"],
    ),
    "an unknown dose": Ending(
        RACK.replace("on_unknown: repeat", "on_unknown: ask"),
        lambda: [0.0, UnknownPourError("the balance was lost")],
        "incomplete",
        "0 of 2 cups reached; 1 UNKNOWN, 1 not poured",
        ["unknown", "unknown", "waiting"],
        stops=True,
    ),
    "a series with a missed dose": Ending(SERIES, lambda: [5.0], "incomplete", "1 of 2 doses reached; 1 missed"),
    "a series that was refused": Ending(
        SERIES, lambda: [refused(), refused()], "nothing", "0 of 2 doses reached; 2 refused"
    ),
    "a deployment": Ending(CAMPAIGN, list, "complete", "3 of 3 pours weighed"),
    "a deployment with a failed pour": Ending(
        CAMPAIGN, lambda: [LaboratoryError("it slid")], "complete", "2 of 3 pours weighed; 1 failed"
    ),
    "a deployment that only failed": Ending(
        CAMPAIGN, lambda: [LaboratoryError("it slid")] * 3, "nothing", "0 of 3 pours weighed; 3 failed"
    ),
}


class NoForecast:
    """Takes the place of the check's prediction of doses, which takes seconds and is not the subject here."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.fills, self.open_time = Counter[str](), 0.0

    def lines(self) -> list[str]:
        return []

    refused = lines


@pytest.fixture(scope="module", autouse=True)
def _no_forecast() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orchestrator.campaigns.mixture_forecast.MixtureForecast", NoForecast)
        yield


def laboratory(ending: Ending) -> HeldLaboratory:
    return HeldLaboratory(ToySimulators(), ScriptedBench(ending.steps()), RecommendingOptimizer())


def of_terminal(folder: Path, ending: Ending) -> tuple[int, list[str], Path]:
    """Exit code, lines of the terminal, and folder of `decant run`."""

    def opened(spec: Any, **arguments: Any) -> HeldLaboratory:
        made = laboratory(ending)
        made.spec = spec
        return made

    path = write_campaign(folder, ending.campaign)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("actors.laboratory.open_laboratory", opened)
        patch.chdir(folder)
        result = CliRunner().invoke(app, ["run", str(path), "--in-process"])
    (directory,) = (folder / "runs").iterdir()
    return result.exit_code, result.output.strip().splitlines(), directory


def as_plain(verdict: Any) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads(verdict.model_dump_json())
    return plain


@pytest.mark.parametrize("name", ENDINGS)
def test_every_place_that_tells_how_a_run_ended_shows_the_same_verdict(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ending = ENDINGS[name]
    for folder in ("terminal", "service"):
        (tmp_path / folder).mkdir()
    code, lines, directory = of_terminal(tmp_path / "terminal", ending)
    verdict = as_plain(decant.open_run(directory).verdict)
    assert (verdict["word"], ending.text in verdict["text"]) == (ending.word, True), verdict["text"]

    # terminal
    if ending.stops:
        assert code not in (0, 4)
    else:
        assert code == (0 if ending.word == "complete" else 4)
        assert lines[-1] == verdict["text"]
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        assert summary["verdict"] == verdict
    # report and tables
    page = decant.open_run(directory).report().read_text(encoding="utf-8")
    body = re.sub(r"<[^>]+>", " ", page.partition("<body")[2])
    assert re.sub(r"\s+", " ", body).index(verdict["text"][1:]) < re.sub(r"\s+", " ", body).index("Summary")
    for goal in verdict["unmet"]:
        assert body.count(goal["reason"]) >= 1
        assert all(cup in body for cup in goal["of"])
    if ending.cups:
        with (directory / "mixtures.csv").open(encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        assert [row["state"] for row in rows] == ending.cups
        assert {row["state"] for row in rows if row["outcome"] == "missed"} <= {"missed"}
        counted = sum(row["outcome"] == "missed" for row in rows)
        assert counted == verdict["doses"]["missed"]
        assert sum(row["outcome"] == "reached" for row in rows) == verdict["doses"]["made"]
    # catalogue
    with Catalogue() as catalogue:
        catalogue.refresh()
        (entry,) = [row for row in catalogue.runs({"verdict": ending.word}) if row["path"] == str(directory)]
    assert (entry["verdict"], entry["reached"]) == (ending.word, verdict)
    # service
    monkeypatch.setenv(VARIABLE, str(tmp_path / "service" / "state"))
    write_campaign(tmp_path / "service", ending.campaign)
    web = WebReceiver()
    notifier = Notifier([web.url])

    async def work() -> None:
        async with serving(tmp_path / "service", lambda: laboratory(ending)) as served:
            key = await served.submit()
            found = await served.until(key, "finished", "failed", "unknown")
            # a run with an UNKNOWN pour goes on at once, in order to ask for its outcome
            assert found["verdict"] == verdict or (ending.stops and found["verdict"] is None)
            assert found["desired_state"] != "pause" or ending.stops
            if not ending.stops:
                assert found["summary"]["verdict"] == verdict
            (run_row,) = await served.get("/runs")
            assert (run_row["verdict"], run_row["reached"]) == (ending.word, verdict)
            rests = [sent async for sent in _events(served, key) if sent["type"] == "CampaignRests"]
            assert rests[-1]["verdict"] == verdict
            notifier.note("CampaignRests", rests[-1], key)
            metrics = await served.http.get("/api/v1/metrics", headers=served.headers())
            counted = {
                sample.labels["outcome"]: sample.value
                for family in text_string_to_metric_families(metrics.text)
                for sample in family.samples
                if sample.name == "decant_campaigns_ended_total" and sample.value
            }
            assert ending.stops or counted == {ending.word: 1.0}
            if found["state"] == "finished" and ending.word != "complete":
                with pytest.raises(OrderFailedError, match=re.escape(verdict["text"][:40])):
                    _has_ended(found)
            elif found["state"] == "finished":
                assert _has_ended(found)

    try:
        run(work())
        wait_for(lambda: bool(web.messages))
    finally:
        notifier.close()
        web.close()
    (message,) = web.messages
    assert message["type"] == ("info" if ending.word == "complete" else "warning")
    if not ending.stops:
        assert message["title"].endswith(f"is {ending.word}")
        assert verdict["text"] in message["message"]


async def _events(served: Any, key: str) -> Any:
    async for sent in served.daemon.feed.read(0, key, beat=0.05):
        if sent is None:
            return
        yield {"type": sent.type, **json.loads(sent.data)}
