"""A night of mixtures that a daemon runs over the protocols, and the places that tell how it ended.

python -m tests.reliability.night_verdict --cups 24 --liquids water ethanol oil     # some 25 minutes

A cup is refused, because a colleague has entered the first liquid in the account already; doses miss a tolerance that
is narrower than the dosing is exact; the balance is unplugged in two doses, whose masses are UNKNOWN: a person enters
one, and leaves the other one. `told` collects the verdict from every place. A page in a browser has tests of its own.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import re
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import openpyxl
import pytest
from prometheus_client.parser import text_string_to_metric_families
from ruamel.yaml import YAML

import decant
from actors.interfaces import DoseTarget, OperatorSettings
from actors.laboratory import InProcessLaboratory
from actors.laboratory_settings import LaboratorySettings
from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.cli.foreground_run import conclude
from orchestrator.daemon.state.notifications import Notifier
from orchestrator.materials.vessel_account import VesselAccount
from orchestrator.records.run_registry import VARIABLE
from tests.orchestrator.daemon.state.test_notifications import WebReceiver
from tests.reliability.mixture_night import KINDS, write_campaign
from tests.reliability.night import strike
from tests.support.toy_daemon import Served, serving
from tests.support.waiting import wait_for
from tests.support.wired_bench import Stage, Trickle

UNPLUGGED = next(fault for fault in KINDS if fault.kind == "balance unplugged while pouring")

TOLERANCE = "0.5 g"

REFUSED, ENTERED, LEFT = 2, 3, 4
"""Which cup of the night is refused, and in the first doses of which cups the balance is unplugged: a person enters the
mass in the one, and leaves the other one UNKNOWN."""


@dataclass
class Events:
    """What happened in the night: the cups in the order of their first doses, and those of which something befell."""

    cups: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)


class NightLaboratory(InProcessLaboratory):
    """The laboratory over the protocols, with a liquid of one rule, and what happens in it."""

    def __init__(self, events: Events, spec: LaboratorySettings, *, plain_processes: bool, **arguments: Any) -> None:
        assert spec.balance is not None
        person = OperatorSettings(answers="virtual", time=2.0, reminder=60.0, deadline=300.0)
        quick = spec.with_values(operator=person, balance=spec.balance.with_values(reconnect_time=1.0))
        super().__init__(quick, **arguments | {"make": Trickle})
        self._events = events

    async def __aenter__(self) -> NightLaboratory:
        await super().__aenter__()
        if self.opened is not None:
            stage = Stage(self)
            stage.attend()
            stage.bench.pour = partial(self._pour, stage, stage.bench.pour)  # type: ignore[method-assign]
        return self

    async def _pour(self, stage: Stage, pour: Any, scene: Any, action: Any, *, dose: DoseTarget, **options: Any) -> Any:
        events, fault = self._events, None
        first = dose.cup not in events.cups
        if first:
            events.cups.append(dose.cup)
        if first and len(events.cups) == REFUSED:
            vessel = f"{self._spec.name}/{dose.cup}"
            VesselAccount.open().weigh(vessel, 0.012, 1e-4, liquid=scene.liquid.name, by="a colleague")
            events.refused.append(dose.cup)
        if first and len(events.cups) in (ENTERED, LEFT):
            fault = asyncio.ensure_future(strike(stage, UNPLUGGED))
            events.unknown.append(dose.cup)
        try:
            return await pour(scene, action, dose=dose, **options)
        finally:
            if fault is not None and UNPLUGGED.mend is not None:
                await fault
                await UNPLUGGED.mend(stage)


def campaign(folder: Path, cups: int, liquids: Sequence[str], seed: int) -> Path:
    """The shipped campaign with a narrow tolerance; a person is asked about an UNKNOWN dose."""
    path, yaml = write_campaign(folder, cups, seed, liquids), YAML()
    written = yaml.load(path)
    written["mixtures"]["tolerance"] = TOLERANCE
    del written["unattended"]
    yaml.dump(written, path)
    return path


async def answered(served: Served, key: str) -> dict[str, Any]:
    """Answer the questions about UNKNOWN doses, until the campaign has ended. Returns it."""
    answers = ["received 2.4"]
    while True:
        found: dict[str, Any] = await served.get(f"/campaigns/{key}")
        if found["state"] in ("finished", "failed"):
            return found
        for question in await served.get("/questions"):
            await served.post(f"/questions/{question['id']}/answer", {"answer": answers.pop(0) if answers else "lost"})
        await asyncio.sleep(0.5)  # a person who looks at the page now and then


@dataclass(frozen=True)
class Told:
    """What every place tells of the night: its verdict, and rows of the table of mixtures."""

    events: Events
    state: str
    exit_code: int
    verdicts: dict[str, Any]
    words: dict[str, str]
    rows: dict[str, list[dict[str, str]]]


async def night(folder: Path, cups: int, liquids: Sequence[str], seed: int = 21) -> Told:
    """Run it in a daemon, and read every place afterwards."""
    events, web = Events(), WebReceiver()
    notifier, path = Notifier([web.url]), campaign(folder, cups, liquids, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, str(folder / "state"))
        async with serving(folder) as served:
            served.campaign = path
            patch.setattr("actors.laboratory.open_laboratory", partial(NightLaboratory, events))
            key = await served.submit()
            found = await answered(served, key)
            (listed,) = await served.get("/runs")
            text = (await served.http.get("/api/v1/metrics", headers=served.headers())).text
            async for sent in served.daemon.feed.read(0, key, beat=0.05):
                if sent is None:
                    break
                if sent.type == "CampaignRests":
                    rests = json.loads(sent.data)
        notifier.note("CampaignRests", rests, key)
        wait_for(lambda: bool(web.messages))
        notifier.close()
        web.close()
        run = decant.open_run(Path(listed["path"]))
        assert run.verdict is not None
        report = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", run.report().read_text("utf-8").partition("<body")[2]))
        with Catalogue() as catalogue:
            catalogue.refresh()
            (entry,) = catalogue.runs({"verdict": "incomplete"})
    try:
        conclude(run.verdict)
        code = 0
    except SystemExit as ended:
        code = int(str(ended.code))
    sheet = openpyxl.load_workbook(run.directory / "mixtures.xlsx").active
    assert sheet is not None
    header, *lines = sheet.iter_rows(values_only=True)
    counted = (
        sample.labels["outcome"]
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name == "decant_campaigns_ended_total" and sample.value
    )
    with (run.directory / "mixtures.csv").open(encoding="utf-8") as stream:
        of_csv = list(csv.DictReader(stream))
    return Told(
        events,
        found["state"],
        code,
        {
            "journal": json.loads(run.verdict.model_dump_json()),
            "summary.json": json.loads((run.directory / "summary.json").read_text("utf-8"))["verdict"],
            "GET /campaigns": found["verdict"],
            "GET /runs": listed["reached"],
            "catalogue": entry["reached"],
            "event": rests["verdict"],
        },
        {
            "webhook": web.messages[0]["message"],
            "metric": next(counted),
            "report": report[: report.index("Summary")],
        },
        {
            "csv": of_csv,
            "json": json.loads((run.directory / "mixtures.json").read_text("utf-8")),
            "xlsx": [dict(zip(map(str, header), line, strict=True)) for line in lines],
        },
    )


def compare(told: Told) -> list[str]:
    """What is not as it should be; one line each."""
    verdict, events = told.verdicts["journal"], told.events
    wrong = [f"{place}: {found}" for place, found in told.verdicts.items() if found != verdict]
    for place, said in told.words.items():
        wanted = verdict["word"] if place == "metric" else verdict["text"][1:]  # the report begins with a capital
        if wanted not in said:
            wrong.append(f"{place}: {said}")
    if (told.state, told.exit_code, verdict["word"]) != ("finished", 4, "incomplete"):
        wrong.append(f"{told.state}, exit code {told.exit_code}, {verdict['word']}")
    for name, rows in told.rows.items():
        states = {row["cup"]: row["state"] for row in rows}
        if states[events.refused[0]] != "refused" or states[events.unknown[1]] != "unknown":
            wrong.append(f"{name}: {states}")
        outcomes = Counter(row["outcome"] for row in rows)
        counts = {"made": outcomes["reached"], "missed": outcomes["missed"], "unknown": outcomes["unknown"]}
        if any(verdict["doses"][key] != count for key, count in counts.items()):
            wrong.append(f"{name}: {outcomes}, {verdict['doses']}")
        if any(row["state"] == "full" and row["outcome"] == "missed" for row in rows):
            wrong.append(f"{name}: a full cup has a missed dose")
    if verdict["doses"]["by_hand"] != 1 or not verdict["doses"]["missed"]:
        wrong.append(f"no dose by hand or none missed: {verdict['doses']}")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cups", type=int, default=24)
    parser.add_argument("--liquids", nargs="+", default=["water", "ethanol", "oil"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        told = asyncio.run(night(Path(folder), options.cups, options.liquids))
        print(told.verdicts["journal"]["text"], told.events, *compare(told), sep="\n")


if __name__ == "__main__":
    main()
