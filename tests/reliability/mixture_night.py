"""A virtual night of mixtures over the protocols, with faults, at thirty times the clock.

python -m tests.reliability.mixture_night --seed 21               # some 25 minutes; writes build/mixtures-21.jsonl
python -m tests.reliability.mixture_night --seed 22 --faults 6    # one fault in twelve doses
python -m tests.reliability.mixture_night --write 21 22 23        # no dose: the table of docs/evidence/dosing.md

The campaign is run, stopped and resumed as `decant run` does it: 24 cups on the rack of `rack.yaml`, each with water,
70 % ethanol (by mass) and rapeseed oil, 72 doses of 2.5 to 60 g by the formula, two sources for each
liquid. Doses of 2 g are refused for this source and balance (2.1 to 2.4 g are supported). Arm, gripper and balance
are behind their protocols; the liquid of a dose follows the executed motion. After a fault a person removes the
cause, and the run goes on with a new consent; vessels keep what they truly hold from one run to the next.

Questions, as they stood before the first counted night:

1. Each liquid flows into each cup at most once.
2. No vessel is put where another one stands, and each stands where the account says, or that says UNKNOWN.
3. Of each dose, the reported amount differs from the true one by at most 0.5 g; likewise the account of each cup,
   unless it is UNKNOWN. The content of a source is a sum of estimates: it is right within 0.5 g or three of its
   deviations.
4. At least 95 % of the shares of full cups are within their stated intervals (of 90 %).
5. Each fault ends with the arm at rest and exactly one message; without a fault there is none. The arm does not move
   again before a person has agreed.
6. Without faults: mean error of doses of 10 g and more (goal 0.4 g), and of smaller ones (goal 0.25 g).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import random
import statistics
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from actors.interfaces import (
    DoseTarget,
    LaboratoryError,
    Notice,
    NotPouredError,
    OperatorQuestion,
    OperatorSettings,
    UnknownPourError,
)
from actors.laboratory import InProcessLaboratory
from actors.laboratory_settings import LaboratorySettings
from actors.places import UnattendedSettings
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.dispense import Dispensed
from orchestrator.records.run_record import read_result
from orchestrator.records.run_registry import VARIABLE
from orchestrator.records.states import State
from orchestrator.runs.run_service import RunHandle, RunResources, RunService
from orchestrator.runs.run_tasks import run_task
from tests.reliability.night import (
    ACCOUNTED,
    FAULTS,
    ROOT,
    Fault,
    Person,
    Receiver,
    Watched,
    balance,
    controller,
    fingers,
    kill_driver,
    strike,
    write,
)
from tests.support.wired_bench import Stage, Trickle

PAGE = ROOT / "docs" / "evidence" / "dosing.md"
LIQUIDS = ("water", "ethanol", "oil")

SMALLEST, LARGEST, ROOM = 2.5, 60.0, 150.0
"""Amounts of a dose [g], and of a cup [mL]."""

TRIES = 6
"""A dose that is given up so often before it begins is never made."""

LATEST_RUN = 60
"""A night that needs more runs than this never ends."""

TAKE = "{source}: the arm began to take it from '{source}'"


async def heavier(stage: Stage) -> None:
    """The cup that is taken is 5 g heavier than the right one."""
    record = stage.laboratory._record
    assert record is not None
    cup = next(name for name, place in record.stands().items() if place is None and name.startswith("rack/"))
    stage.contents.dry[cup] += 5e-3


def for_mixtures(fault: Fault) -> Fault:
    """A fault of the night with a pourer and a receiver, at the same motion of a source or a cup."""
    names = {"receiver": "{cup}", "'right'": "'{cup}'", "pourer": "{source}", "'left'": "'{source}'"}
    at = fault.at
    for old, new in names.items():
        at = at.replace(old, new)
    return replace(fault, at=at)


KINDS = (
    *(for_mixtures(fault) for fault in FAULTS if "pouring back" not in fault.kind),
    Fault("a cup of another mass", "{cup}: the arm began to take it from '{cup}'", heavier, when="at once"),
    Fault("connection to the arm lost while pouring", TAKE, controller("drop"), when="tilts"),
    Fault("arm's driver killed while pouring", TAKE, kill_driver, when="tilts"),
    Fault("source lost while pouring", TAKE, fingers("lost"), when="tilts"),
    Fault("balance unplugged while pouring", TAKE, balance("unplug"), balance("plug"), "tilts"),
    Fault(
        "balance silent while pouring", TAKE, balance("faults", silent=True), balance("faults", silent=False), "tilts"
    ),
    Fault("emergency stop while pouring", TAKE, controller("emergency_stop"), controller("release_emergency_stop"),
          "tilts"),
)  # fmt: skip


def amounts(cups: int, liquids: Sequence[str], seed: int) -> dict[str, dict[str, float]]:
    """Wanted amounts [g]: evenly spread in their logarithm, as far as a cup has room; each liquid has both ends."""
    rng, names = random.Random(seed), [f"{row}{column}" for row in "ABCD" for column in range(1, 7)][:cups]
    table: dict[str, dict[str, float]] = {name: {} for name in names}
    low, high = math.log(SMALLEST), math.log(LARGEST)
    for liquid in liquids:
        values = [round(2.0 * math.exp(low + (high - low) * k / max(cups - 1, 1))) / 2.0 for k in range(cups)]
        rng.shuffle(values)
        for name, value in zip(names, values, strict=True):
            used = sum(table[name].values())
            table[name][liquid] = value if used + value <= ROOM else SMALLEST
    return table


def write_campaign(folder: Path, cups: int, seed: int, liquids: Sequence[str] = LIQUIDS) -> Path:
    """The shipped campaign and its laboratory with two sources for each liquid."""
    yaml = YAML()
    laboratory = yaml.load(ROOT / "configs" / "laboratories" / "rack.yaml")
    stands = [place for place in laboratory["places"] if place["name"].startswith("source/")]
    others = [place for place in laboratory["places"] if not place["name"].startswith("source/")]
    laboratory["arm"]["limits"]["box"]["low"]["y"] = "-1100 mm"
    sources = [
        {**stands[0], "name": f"source/{liquid}{number}", "pose": {**stands[0]["pose"], "y": f"{y} mm"}}
        for (liquid, number), y in zip(
            ((liquid, number) for liquid in liquids for number in ("", "2")), range(-350, -1100, -140), strict=False
        )
    ]
    laboratory["places"] = [others[0], *sources, *others[1:]]
    laboratory["name"] = "rack"
    laboratory["bench"]["doses"] = "formula"
    yaml.dump(laboratory, folder / "rack.yaml")
    campaign = yaml.load(ROOT / "configs" / "campaigns" / "mixtures.yaml")
    mixtures, seventy = campaign["mixtures"], {"density": "868 kg/m^3", "viscosity": "2.21 mPa*s"}
    for liquid in mixtures["liquids"]:
        liquid["stands"] = [f"source/{liquid['name']}", f"source/{liquid['name']}2"]
        if liquid["name"] == "ethanol":
            liquid["liquid"] = {"name": "ethanol 70 %", "mass": "330 g", "surface_tension": "25.5 mN/m", **seventy}
    mixtures["liquids"] = [liquid for liquid in mixtures["liquids"] if liquid["name"] in liquids]
    mixtures["wanted"] = {
        cup: {liquid: f"{amount:g} g" for liquid, amount in row.items()}
        for cup, row in amounts(cups, liquids, seed).items()
    }
    campaign |= {"laboratory": "rack.yaml", "seed": seed, "unattended": {"pours": 200, "until": "23:59"}}
    campaign["outputs"] = {"directory": "runs", "recording": False, "figures": False}
    yaml.dump(campaign, folder / "mixtures.yaml")
    return folder / "mixtures.yaml"


def night_plan(folder: Path, cups: int, seed: int, liquids: Sequence[str] = LIQUIDS) -> CampaignPlan:
    """The campaign with a person who needs little time."""
    plan = load_campaign(write_campaign(folder, cups, seed, liquids))
    spec = plan.laboratory
    assert spec.balance is not None
    operator = OperatorSettings(answers="virtual", time=2.0, reminder=60.0, deadline=300.0)
    until = UnattendedSettings(pours=200, until=f"{(time.localtime().tm_hour + 20) % 24:02d}:00")
    quick = spec.balance.with_values(reconnect_time=1.0)
    return replace(plan, laboratory=spec.with_values(operator=operator, balance=quick, unattended=until))


@dataclass
class Try:
    """What came of one try of a dose; masses [g].

    Attributes:
        cup, liquid, source: of the dose.
        wanted, received, true: amounts; None if they are unknown or nothing was poured.
        fault: that happened in it; '' if none did.
        outcome: 'weighed', 'not poured', 'unknown'.
        first: what was asked about first after the fault; '' if nothing was.
        wrong: largest difference between the account of a cup and the truth.
        messages: sent from the consent to the end of the run, if that ended with this try.
        unplanned: why the consent ended without a fault; '' if it did not.
        dose_s: duration of the dose itself [s of bench time].
        reason: why it was not made, or not as planned.
    """

    cup: str
    liquid: str
    source: str
    wanted: float
    received: float | None = None
    true: float | None = None
    fault: str = ""
    outcome: str = "weighed"
    first: str = ""
    wrong: float = 0.0
    messages: int | None = None
    unplanned: str = ""
    dose_s: float | None = None
    bench_s: float = 0.0
    wall_s: float = 0.0
    reason: str = ""


class Attended(InProcessLaboratory):
    """The laboratory of one run, with somebody who looks at it."""

    def __init__(self, spec: LaboratorySettings, night: MixtureNight) -> None:
        super().__init__(spec, Trickle, pours=True, record=night.record)
        self._night, self.stage = night, Stage(self)

    async def __aenter__(self) -> Attended:
        await super().__aenter__()
        self.stage.attend()
        self._night.opened(self.stage)
        return self

    def _report(self, notice: Notice) -> None:
        self.stage.notices.append(notice)
        super()._report(notice)


@dataclass
class MixtureNight:
    """The runs of one campaign of mixtures.

    Args:
        folder: to work in.
        plan: of the campaign.
        faults: with the number of the dose from which on they are due.
        hear: called with each try.
    """

    folder: Path
    plan: CampaignPlan
    faults: list[tuple[int, Fault]] = field(default_factory=list)
    hear: Callable[[Try], None] = lambda attempt: None
    tries: list[Try] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    flowed: Counter[tuple[str, str]] = field(default_factory=Counter)
    """How often a liquid truly flowed into a cup."""
    truth: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(float)))
    """True masses of the liquids in each cup [kg]."""
    receiver: Receiver = field(default_factory=Receiver)
    runs: int = 0
    number: int = 0
    reason: str = ""
    handle: RunHandle = field(init=False)
    stage: Stage = field(init=False)
    person: Person = field(init=False)

    def __post_init__(self) -> None:
        self.record = Watched(self.folder, self.plan.laboratory.name)
        self._held: dict[str, float] = {}
        self._dry: dict[str, float] = {}
        self._owed: Try | None = None

    async def run(self) -> Dispensed:
        """All of it. Returns the doses and cups."""
        resume = False
        while True:
            self.runs, before = self.runs + 1, len(self.tries)
            state = await self._one_run(resume=resume)
            if state is State.FINISHED:
                break
            assert self.runs < LATEST_RUN, f"run {self.runs} did not end: {state}"
            assert len(self.tries) > before or state is State.UNKNOWN, f"a run made nothing: {state}, {self.reason}"
            recent = [(attempt.cup, attempt.liquid) for attempt in self.tries[-TRIES:]]
            assert len(recent) < TRIES or len(set(recent)) > 1, f"a dose is never made: {recent[0]}"
            resume = True
        self.receiver.close()
        self.wrong += [f"flowed twice: {pair}" for pair, count in self.flowed.items() if count > 1]
        self.wrong += [f"did not happen: {fault.kind}" for _, fault in self.faults]
        result = read_result(self.folder / "run").results["doses"]
        assert isinstance(result, Dispensed)
        return result

    async def _one_run(self, *, resume: bool) -> State:
        (self.folder / "run").mkdir(exist_ok=True)
        request = replace(run_task(self.plan), folder=self.folder / "run", resume=resume)
        resources = RunResources(
            in_process=True,
            laboratory=lambda spec, pours: Attended(spec, self),
            ask_operator=lambda question, options, facts: "lost",
        )
        self.handle = RunService().start(request, resources)
        try:
            await self.handle.wait()
        except asyncio.CancelledError:
            pass  # paused
        except Exception as error:
            self.reason = f"{type(error).__name__}: {error}"
        finally:
            self.handle.close()
        self._held |= self.stage.contents.liquids
        self._dry = dict(self.stage.contents.dry)
        self.wrong += [f"hands were invited while something moved: {about}" for about in self.stage.unsafe]
        return read_result(self.folder / "run").state

    # ---- one run

    def opened(self, stage: Stage) -> None:
        """A laboratory is open."""
        self.stage = stage
        stage.contents.dry |= self._dry
        self.record.stage = None
        self.record.follow(stage)
        self.person = Person(self, stage)  # type: ignore[arg-type]
        self.receiver.note("CampaignLeased", {"rig": "rack"}, "night")
        self._keep_truth(stage)
        pour, receive, contents = stage.bench.pour, stage.contents.receive, stage.contents

        def received(spilled: float, retained: float) -> None:
            mass = contents.in_pourer - spilled - retained
            if mass > 0.0:
                liquid = contents.pourer.removeprefix("source/").rstrip("2")
                self.truth[contents.receiver][liquid] += mass
                self.flowed[contents.receiver, liquid] += 1
            receive(spilled, retained)

        async def poured(scene: Any, action: Any, *, seed: int, progress: Any = None, dose: Any = None) -> Any:
            return await self._try(dose, lambda: pour(scene, action, seed=seed, progress=progress, dose=dose))

        stage.contents.receive = received  # type: ignore[method-assign]
        stage.bench.pour = poured  # type: ignore[method-assign]

    def _keep_truth(self, stage: Stage) -> None:
        """Vessels that are laid out again hold what they truly held; a person weighs a cup that is UNKNOWN."""
        ask = stage.operator.ask

        async def asked(question: OperatorQuestion) -> str:
            answer = await ask(question)
            if question.about == "vessels_laid_out":
                again = [name for name in self._held if f"{name} filled_g" not in question.details]
                stage.contents.liquids |= {name: self._held[name] for name in again}
                self._held = {}  # once they are laid out again in the same run, they are as they stand there
                await stage.site.put(stage.contents.carried)
            if question.about == "cup_unknown":
                for name in (name for name in stage.contents.stands if self.record.unknown(name)):
                    mass = stage.contents.liquids.get(name, 0.0)
                    self.record.account.weigh(f"rack/{name}", mass, 1e-4, liquid="mixture" if mass else "", by="night")
            return answer

        stage.operator.ask = asked  # type: ignore[method-assign]

    async def _try(self, dose: DoseTarget, pour: Callable[[], Any]) -> Any:
        stage, source = self.stage, dose.source
        assert source is not None
        liquid = source.vessel.removeprefix("source/").rstrip("2")
        attempt = Try(dose.cup, liquid, source.vessel, 1e3 * dose.amount)
        self.number += not any((t.cup, t.liquid) == (attempt.cup, liquid) for t in self.tries)
        fault, struck = self._due(dose), list[bool]()
        if fault is not None:
            self._expect(fault, dose, struck)
            attempt.fault = fault.kind
        clock, begun, before = await stage.now(), time.monotonic(), self.flowed[dose.cup, liquid]
        error: BaseException | None = None
        try:
            measured = await pour()
            about = measured.notes["dose"]
            attempt.received, attempt.true = 1e3 * about["received"], 1e3 * about["true"]
            attempt.dose_s = about["duration"]
            if abs(attempt.received - attempt.true) > 1e3 * ACCOUNTED:
                self.wrong.append(f"{dose.cup}, {liquid}: {attempt.received:.2f} g, in truth {attempt.true:.2f} g")
        except (NotPouredError, UnknownPourError) as problem:
            error, attempt.reason = problem, str(problem)
            attempt.outcome = "unknown" if isinstance(problem, UnknownPourError) else "not poured"
            if attempt.outcome == "not poured" and self.flowed[dose.cup, liquid] > before:
                self.wrong.append(f"{dose.cup}, {liquid}: flowed, and is said not to be poured")
        if fault is not None and not await self._happened(fault, dose, struck):
            attempt.fault = ""
        attempt.wrong = 1e3 * self._misaccounted(attempt)
        attempt.first, attempt.wall_s = self.person.first if attempt.fault else "", time.monotonic() - begun
        with contextlib.suppress(LaboratoryError):
            attempt.bench_s = await stage.now() - clock
        self._rest(attempt)
        self.tries.append(attempt)
        self.hear(attempt)
        if error is not None:
            raise error
        return measured

    def _rest(self, attempt: Try) -> None:
        """After a fault the run ends, with one message; a run without one goes on."""
        where = f"{attempt.cup}, {attempt.liquid}, {attempt.fault or 'no fault'}"
        ended = "the consent has ended" in self.stage.said("warning")
        if ended and attempt.outcome == "weighed" and not self.person.messages and self._owed is None:
            self._owed = attempt  # nobody was asked yet: the next dose begins with a question
            return
        if self._owed is not None:
            attempt, self._owed = self._owed, None
        if ended or attempt.outcome != "weighed":
            states = {"weighed": "paused", "not poured": "failed", "unknown": "unknown"}
            reason = "stopped on request" if attempt.outcome == "weighed" else attempt.outcome
            self.receiver.note("CampaignRests", {"state": states[attempt.outcome], "reason": reason}, "night")
            attempt.messages = self.person.messages
            if not attempt.fault:
                texts = [notice.text for notice in self.stage.notices if "consent has ended" in notice.text]
                attempt.unplanned = (texts or [attempt.reason])[0]
            if attempt.messages != 1:
                self.wrong.append(f"{where}: {attempt.messages} messages")
            if attempt.outcome == "weighed":
                self.handle.pause()
        elif attempt.fault:
            self.wrong.append(f"{where}: the consent went on")
        elif self.person.messages:
            self.wrong.append(f"{where}: a message without a reason")

    # ---- faults

    def _due(self, dose: DoseTarget) -> Fault | None:
        """The first fault that is due and whose motion this dose has."""
        on_pan = self.stage.contents.stands.get(dose.cup) == "pan"
        if not self.stage.contents.stands:  # everything is laid out first
            return None
        for entry in self.faults:
            number, fault = entry
            first = "take it from '{cup}'" in fault.at or "carry it to 'pan'" in fault.at
            last = "carry it to '{cup}'" in fault.at
            if self.number >= number and not (first and on_pan) and not (last and dose.stays):
                self.faults.remove(entry)
                return fault
        return None

    def _expect(self, fault: Fault, dose: DoseTarget, struck: list[bool]) -> None:
        assert dose.source is not None
        stage, self.person.first = self.stage, ""
        self.person.expect(fault)

        async def hook() -> None:
            await strike(stage, fault)
            struck.append(True)

        self.record.once[fault.at.format(cup=dose.cup, source=dose.source.vessel)] = hook

    async def _happened(self, fault: Fault, dose: DoseTarget, struck: list[bool]) -> bool:
        """Whether it happened; on a starved machine it may have missed its moment, and is due again."""
        tasks, self.record.tasks = list(self.record.tasks), []
        self.record.once.clear()
        if struck:
            await asyncio.gather(*tasks, return_exceptions=True)
            return True
        for task in tasks:
            task.cancel()
        self.person._mend = None
        self.faults.insert(0, (self.number, fault))
        return False

    # ---- comparisons

    def _misaccounted(self, attempt: Try) -> float:
        """Compare the account with the truth. Returns the largest difference of a cup's content [kg]."""
        contents, worst = self.stage.contents, 0.0
        where = f"{attempt.cup}, {attempt.liquid}, {attempt.fault or 'no fault'}"
        for vessel, place in self.record.stands().items():
            if place is not None and contents.stands.get(vessel) != place:
                self.wrong.append(f"{where}: {vessel} stands at '{contents.stands.get(vessel)}', not '{place}'")
            held = self.record.held(vessel)
            if held is None or vessel not in contents.liquids:
                continue
            error = abs(held[0] - contents.liquids[vessel])
            cup = vessel.startswith("rack/")
            worst = max(worst, error if cup else 0.0)
            if error > (ACCOUNTED if cup else max(ACCOUNTED, 3.0 * held[1])):
                texts = [f"{1e3 * mass:.2f} g" for mass in (held[0], held[1], contents.liquids[vessel])]
                self.wrong.append(f"{where}: {vessel} holds {texts[0]} ± {texts[1]}, in truth {texts[2]}")
        return worst

    def shares(self, result: Dispensed) -> list[tuple[float, float, float]]:
        """Share, half of its stated interval and true share, of every liquid in every full cup."""
        rows = []
        for part in result.components():
            if part.share is not None and part.share_half_interval is not None:
                true = self.truth[part.cup]
                rows.append((part.share, part.share_half_interval, true[part.liquid] / sum(true.values())))
        return rows


def chosen(doses: int, faults: int, seed: int) -> list[tuple[int, Fault]]:
    """Faults with the number of the dose from which on they are due: one in every `doses` / `faults`, all different."""
    rng = random.Random(seed)
    every = doses // max(faults, 1)
    numbers = [2 + every * k + rng.randrange(max(every - 5, 1)) for k in range(faults)]
    return list(zip(numbers, rng.sample(KINDS, faults), strict=True))


def played(folder: Path, seed: int, cups: int, faults: int, hear: Callable[[Try], None]) -> dict[str, Any]:
    """One night. Returns its last row."""
    os.environ[VARIABLE] = str(folder)
    begun, plan = time.monotonic(), night_plan(folder, cups, seed)
    RunService().check(run_task(plan)).require()
    night = MixtureNight(folder, plan, chosen(len(LIQUIDS) * cups, faults, seed), hear)
    shares: list[tuple[float, float, float]] = []
    try:
        result = asyncio.run(night.run())
        shares = night.shares(result)
        states = Counter(cup.state for cup in result.cups)
    except AssertionError as error:
        night.wrong.append(str(error))
        states = Counter()
    within = sum(abs(share - true) <= half for share, half, true in shares)
    return {"wall_s": time.monotonic() - begun, "runs": night.runs, "wrong": night.wrong, "shares": len(shares),
            "within": within, "cups": dict(states)}  # fmt: skip


def results(seed: int) -> Path:
    """The file of one night."""
    return ROOT / "build" / f"mixtures-{seed}.jsonl"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--cups", type=int, default=24)
    parser.add_argument("--faults", type=int, default=0, choices=range(len(KINDS) + 1))
    parser.add_argument("--write", type=int, nargs="+")
    options = parser.parse_args()
    if options.write:
        write(PAGE, "mixtures", table(options.write))
        return 0
    results(options.seed).parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, results(options.seed).open("w", encoding="utf-8") as out:

        def hear(row: Try | dict[str, Any]) -> None:
            out.write(json.dumps(asdict(row) if isinstance(row, Try) else row) + "\n")
            out.flush()
            print(row, flush=True)

        last = played(Path(folder), options.seed, options.cups, options.faults, hear)
        hear(last)
    return 1 if last["wrong"] else 0


def table(seeds: Sequence[int]) -> list[str]:
    """Lines of the page's table, of what was written: a column for each night."""
    columns = [_column([json.loads(line) for line in results(seed).read_text("utf-8").splitlines()]) for seed in seeds]
    return [
        "Mixtures on `rack.yaml`: cups of water, 70 % ethanol and rapeseed oil, doses of 2.5 to 60 g, over the",
        "protocols of the emulated devices. All nights but the first have a fault in twelve doses. A forecast refuses",
        "doses below 2.1 g.",
        "",
        f"| seed | {' | '.join(map(str, seeds))} |",
        f"|---|{'---|' * len(seeds)}",
        *(f"| {name} | {' | '.join(column[name] for column in columns)} |" for name in columns[0]),
        "",
        "`python -m tests.reliability.mixture_night`; its docstring has the questions.",
    ]


def _column(rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    tries, end = [Try(**row) for row in rows if "cup" in row], next(row for row in rows if "runs" in row)
    faulty = [attempt for attempt in tries if attempt.fault]
    weighed = [attempt for attempt in tries if attempt.received is not None and attempt.true is not None]

    def errors(low: float, high: float) -> str:
        values = [abs((t.true or 0.0) - t.wanted) for t in weighed if low <= t.wanted < high]
        return f"{statistics.fmean(values):.2f}, {max(values):.2f} ({len(values)})" if values else "–"

    def kinds(outcome: str) -> str:
        counts = Counter(attempt.fault for attempt in faulty if attempt.outcome == outcome)
        return ", ".join(f"{kind} ({count})" if count > 1 else kind for kind, count in counts.items()) or "–"

    return {
        "doses weighed, tries, consents": f"{len(weighed)}, {len(tries)}, {end['runs']}",
        "cups": ", ".join(f"{count} {state}" for state, count in end["cups"].items()),
        "a person removed the cause; the dose was weighed": kinds("weighed"),
        "nothing was poured; another run made the dose": kinds("not poured"),
        "the dose is UNKNOWN, and its cup gets nothing more": kinds("unknown"),
        "error of doses of 10 g and more [g]: mean, largest (number); goal 0.4": errors(10.0, 1e3),
        "error of doses below 10 g [g]: mean, largest (number); goal 0.25": errors(0.0, 10.0),
        "shares within their stated 90 % intervals": f"{end['within']} of {end['shares']}",
    }


if __name__ == "__main__":
    raise SystemExit(main())
