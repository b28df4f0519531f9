"""A virtual night over the protocols, with faults, in scaled time.

python -m tests.reliability.night --pours 200 --faults 20    # about an hour; writes build/night.jsonl
python -m tests.reliability.night --resume                   # goes on after what stands there
python -m tests.reliability.night --write                    # no pour: the table of docs/evidence/reliability.md

Arm, gripper and balance are those of `configs/laboratories/night.yaml` behind their protocols; the liquid is a formula.
A run goes on until its consent ends. Then whoever is asked mends the fault and lets the pour go on; the next pour is
made by another run, which asks for a consent of its own.

Checked throughout, against what truly happens on the virtual bench:

- no pour is made twice, and none is left out;
- no vessel is put where another one stands, and each stands where the account says, unless that says UNKNOWN;
- the account of the contents is true within `ACCOUNTED`, and so is what is missing in a cycle;
- whenever somebody is asked, the arm stands still, and it stands there until a motion is agreed to;
- from a consent on, one message is sent in a run with a fault, and none in the others.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import random
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from actors.interfaces import LaboratoryError, NotPouredError, OperatorQuestion, OperatorSettings, UnknownPourError
from actors.laboratory_settings import LaboratorySettings
from actors.places import UnattendedSettings
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.daemon.state.notifications import Notification, Notifier
from orchestrator.materials.vessel_account import LaboratoryPlaces, VesselAccount
from sim_engine.action import DEG, Action
from sim_engine.vessel.shapes import VesselGrip, VesselSpec
from tests.support.wired_bench import ACTION, LABORATORIES, PACE, SCENE, Stage, opened_stage

ROOT = Path(__file__).parents[2]
PAGE, RESULTS = ROOT / "docs" / "evidence" / "reliability.md", ROOT / "build" / "night.jsonl"

ACCOUNTED = 0.5e-3
"""Largest error of an account [kg]."""

STILL = 1e-3
"""Joints that change by less stand still [rad]."""

STANDING = 2.0
"""Time within which an arm stands that nobody controls any more [s of the clock]: half a second of missing heartbeats,
the rest for a busy machine."""

TRIES = 5
"""A pour that is given up so often before it begins is never made."""

PAN, RIGHT, LEFT = "pan", "right", "left"


def carried(vessel: VesselSpec, mass: float) -> VesselSpec:
    """A vessel that states its empty mass [kg]."""
    return vessel.model_copy(update={"grip": VesselGrip(mass=mass)})


HANDLED = replace(SCENE, pourer=carried(SCENE.pourer, 0.312), receiver=carried(SCENE.receiver, 0.186))


def night_spec(pours: int = 200) -> LaboratorySettings:
    """The shipped laboratory of a night, in this process, with a person who needs little time."""
    spec = load_laboratory(LABORATORIES / "night.yaml")
    assert spec.balance is not None
    operator = OperatorSettings(answers="virtual", time=2.0, reminder=60.0, deadline=300.0)
    return spec.with_values(
        in_process=True,
        operator=operator,
        unattended=UnattendedSettings(pours=pours, until="23:59"),
        balance=spec.balance.with_values(reconnect_time=1.0),
    )


def action_of(number: int) -> Action:
    """What is poured in a pour of the night: between a third and nearly all; slowly, so that a tilt can be hit."""
    rng = random.Random(number)
    return ACTION.with_values(angular_velocity=rng.uniform(8.0, 12.0) * DEG, max_angle=rng.uniform(60.0, 95.0) * DEG)


class Watched(LaboratoryPlaces):
    """An account of places that tells when a motion begins or ends.

    Args:
        folder: of the account.
        laboratory: whose places they are.
    """

    def __init__(self, folder: Path, laboratory: str) -> None:
        self.account = VesselAccount(folder / "vessels.sqlite")
        super().__init__(self.account, laboratory)
        self.once: dict[str, Callable[[], Awaitable[Any]]] = {}
        self.tasks: list[asyncio.Future[Any]] = []
        self.stage: Stage | None = None

    def follow(self, stage: Stage) -> None:
        """Compare with the true places whenever one of them changes: then a killed program leaves a true account."""
        move, self.stage = stage.contents.move, stage

        def moved(vessel: str, place: str, *, on_balance: bool) -> None:
            there = [name for name, stands in stage.contents.stands.items() if name != vessel and stands == place]
            assert not place or not there, f"{vessel} was put on the {there[0]}"
            assert self.stands()[vessel] is None, f"{vessel} moves, and is not UNKNOWN"
            move(vessel, place, on_balance=on_balance)

        stage.contents.move = moved  # type: ignore[method-assign]

    def put(self, vessel: str, place: str | None, note: str = "") -> None:
        super().put(vessel, place, note)
        if place and self.stage is not None:
            assert self.stage.contents.stands.get(vessel) == place, f"{vessel} is not at '{place}'"
        if (hook := self.once.pop(f"{vessel}: {note}", None)) is not None:
            self.tasks.append(asyncio.ensure_future(hook()))


# ---- faults


Strike = Callable[[Stage], Awaitable[Any]]


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong in a cycle.

    Attributes:
        kind: in words.
        at: entry of the account at which it happens.
        strike: makes it happen.
        mend: what a person does about it before the first answer; None for nothing.
        when: 'at once', while the arm 'moves', or while the vessel 'tilts'.
        spilt: liquid that is lost by it [kg].
    """

    kind: str
    at: str
    strike: Strike
    mend: Strike | None = None
    when: str = "moves"
    spilt: float = 0.0


def controller(name: str, **arguments: Any) -> Strike:
    return lambda stage: stage.site.fault(name, **arguments)


def fingers(name: str, value: float = 1.0) -> Strike:
    return lambda stage: stage.site.gripper_fault(name, value)


def balance(what: str, **values: Any) -> Strike:
    return lambda stage: stage.site.order(what, **values)


async def kill_driver(stage: Stage) -> None:
    for process in psutil.Process().children():
        if "actors.arm.ur.rtde_worker" in process.cmdline():
            process.kill()


def spill(mass: float) -> Strike:
    async def strike(stage: Stage) -> None:
        stage.contents.spilt_back = mass

    return strike


BARRED, FREE = controller("safeguard"), controller("safeguard", active=False)
TAKE_BACK = f"receiver: the arm began to take it from '{RIGHT}'"
PUT_BACK = f"receiver: the arm began to carry it to '{RIGHT}'"
SET = f"receiver: the arm began to carry it to '{PAN}'"
ASIDE = f"pourer: the arm began to carry it to '{LEFT}'"
TAKE = f"pourer: the arm began to take it from '{LEFT}'"

FAULTS = (
    Fault("nothing grasped", TAKE_BACK, fingers("absent"), fingers("absent", 0.0), "at once"),
    Fault("grasped crooked", TAKE, fingers("crooked"), fingers("crooked", 0.0), "at once"),
    Fault("gripped with too little force", TAKE_BACK, fingers("weak"), fingers("weak", 0.0), "at once"),
    Fault("lost while moving", ASIDE, fingers("lost")),
    Fault("lost while moving", PUT_BACK, fingers("lost")),
    Fault("gripper without power", PUT_BACK, fingers("power", 0.0), fingers("power")),
    Fault("gripper not activated", SET, fingers("not_activated")),
    Fault("protective stop", ASIDE, controller("protective_stop")),
    Fault("protective stop while pouring", TAKE, controller("protective_stop"), when="tilts"),
    Fault("protective stop while pouring back", TAKE_BACK, controller("protective_stop"), when="tilts"),
    Fault("safeguard stop", TAKE_BACK, controller("safeguard"), controller("safeguard", active=False)),
    Fault(
        "safeguard stop while pouring", TAKE, controller("safeguard"), controller("safeguard", active=False), "tilts"
    ),
    Fault("emergency stop", TAKE, controller("emergency_stop"), controller("release_emergency_stop")),
    Fault("connection to the arm lost", PUT_BACK, controller("drop")),
    Fault("connection to the arm refused", SET, controller("refuse"), controller("clear")),
    Fault("controller hangs", ASIDE, controller("stall", motion=False), controller("clear")),
    Fault("arm's driver killed", SET, kill_driver),
    Fault("balance unplugged", SET, balance("unplug"), balance("plug")),
    Fault("balance silent", ASIDE, balance("faults", silent=True), balance("faults", silent=False)),
    Fault("spilled when pouring back", TAKE_BACK, spill(5e-3), when="at once", spilt=5e-3),
)
"""One in a cycle."""


async def seen(stage: Stage, condition: Callable[[], Awaitable[bool]]) -> None:
    while not await condition():
        await asyncio.sleep(0.004)


async def strike(stage: Stage, fault: Fault) -> None:
    """Make a fault happen when its time has come."""

    async def moves() -> bool:
        return max(map(abs, (await stage.site.fault("state"))["speeds"])) > 0.05

    async def tilts() -> bool:
        state = await stage.bench.arm.state()
        if state.phase == "dose":
            return bool((state.tilt or 0.0) > 0.3)
        return bool(state.phase == "tilt" and state.time > 0.3)

    with contextlib.suppress(LaboratoryError):
        if fault.when != "at once":
            await seen(stage, moves if fault.when == "moves" else tilts)
    await fault.strike(stage)


# ---- the night


class Receiver(Notifier):
    """Somebody who is told, with a clock that goes as fast as the bench."""

    def __init__(self) -> None:
        self.messages: list[Notification] = []
        super().__init__([], silence=86_400.0, clock=lambda: PACE * time.monotonic())

    def _send(self, message: Notification) -> None:
        self.messages.append(message)


@dataclass
class Cycle:
    """What came of one try of a pour.

    Attributes:
        number: of the pour.
        fault: that happened in it; '' if none did.
        outcome: 'weighed', 'not poured', 'unknown'.
        first: what was asked about first after the fault; '' if nothing was.
        missing: mass that did not close, less what the fault spilled [kg]; None if nothing was poured back.
        wrong: largest difference between the account of the contents and the truth [kg].
        messages: sent from the consent to the end of the run, if that ended with this try.
        pace: bench seconds per second.
        unplanned: why the consent ended without a fault; '' if it did not.
    """

    number: int
    fault: str
    outcome: str
    first: str = ""
    missing: float | None = None
    wrong: float = 0.0
    messages: int | None = None
    pace: float = 0.0
    bench_s: float = 0.0
    wall_s: float = 0.0
    unplanned: str = ""
    reason: str = ""
    """Why the pour was not made, or not as planned."""


@dataclass
class Night:
    """Pours of a campaign, run after run.

    Args:
        folder: to work in.
        pours: how many.
        faults: by the number of the pour in whose cycle they happen.
        hear: called with each try.
    """

    folder: Path
    pours: int
    faults: dict[int, Fault]
    hear: Callable[[Cycle], None] = lambda cycle: None
    number: int = 1
    runs: int = 0
    cycles: list[Cycle] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    """What should not be."""
    poured: Counter[int] = field(default_factory=Counter)
    """How often liquid left the pourer in the motion of a pour, by its number."""
    receiver: Receiver = field(default_factory=Receiver)

    async def run(self) -> None:
        """All of it."""
        tries = 0
        while self.number <= self.pours:
            before = self.number
            await self._run()
            tries = 0 if self.number > before else tries + 1
            assert tries < TRIES, f"pour {self.number} is never made"
        self.receiver.close()
        if twice := [number for number, count in self.poured.items() if count > 1]:
            self.wrong.append(f"made twice: {twice}")
        if self.faults:
            self.wrong.append(f"did not happen: {[fault.kind for fault in self.faults.values()]}")
        if missed := set(range(1, self.pours + 1)) - set(self.poured):
            self.wrong.append(f"never made: {sorted(missed)}")

    async def _run(self) -> None:
        """From a consent to its end."""
        spec = night_spec(self.pours)
        record = Watched(self.folder, spec.name)
        self.runs += 1
        async with opened_stage(spec=spec, record=record) as stage:
            record.follow(stage)
            self._count(stage)
            person = Person(self, stage)
            person.tray = (record.held("tray") or (0.0, 0.0))[0]
            self.receiver.note("CampaignLeased", {"rig": spec.name}, "night")
            while self.number <= self.pours:
                cycle = await self._cycle(stage, record, person)
                ended = "the consent has ended" in stage.said("warning")
                if ended or cycle.outcome != "weighed":
                    states = {"weighed": "paused", "not poured": "failed", "unknown": "unknown"}
                    reason = "stopped on request" if cycle.outcome == "weighed" else cycle.outcome
                    self.receiver.note("CampaignRests", {"state": states[cycle.outcome], "reason": reason}, "night")
                    cycle.messages = person.messages
                    if not cycle.fault:
                        cycle.unplanned = next(n.text for n in stage.notices if "consent has ended" in n.text)
                    if cycle.messages != 1:
                        self.wrong.append(f"pour {cycle.number}, {cycle.fault}: {cycle.messages} messages")
                    self._done(cycle)
                    break
                if cycle.fault:
                    self.wrong.append(f"pour {cycle.number}, {cycle.fault}: the consent went on")
                if person.messages:
                    self.wrong.append(f"pour {cycle.number}: a message without a reason")
                self._done(cycle)
            self.wrong += [f"hands were invited while something moved: {about}" for about in stage.unsafe]

    def _done(self, cycle: Cycle) -> None:
        self.cycles.append(cycle)
        self.hear(cycle)

    def _count(self, stage: Stage) -> None:
        receive = stage.contents.receive

        def received(spilled: float, retained: float) -> None:
            self.poured[self.number] += 1
            receive(spilled, retained)

        stage.contents.receive = received  # type: ignore[method-assign]

    async def _cycle(self, stage: Stage, record: Watched, person: Person) -> Cycle:
        number = self.number
        due = [at for at in sorted(self.faults) if at <= number and person.poured]
        fault = self.faults.pop(due[0]) if due else None
        struck: list[bool] = []
        if fault is not None:
            person.expect(fault)

            async def hook() -> None:
                await strike(stage, fault)
                struck.append(True)

            record.once[fault.at] = hook
        cycle = Cycle(number, "" if fault is None else fault.kind, "weighed")
        clock, begun = await stage.now(), time.monotonic()
        try:
            measured = await stage.bench.pour(HANDLED, action_of(number), seed=number)
            if "missing_g" in (notes := measured.notes["cycle"]):
                cycle.missing = 1e-3 * notes["missing_g"] - (0.0 if fault is None else fault.spilt)
                if abs(cycle.missing) > ACCOUNTED:
                    self.wrong.append(f"pour {number}: {1e3 * cycle.missing:.2f} g are missing")
            person.poured = True
        except NotPouredError as error:
            cycle.outcome = "not poured"
            cycle.reason = str(error)
        except UnknownPourError as error:
            cycle.outcome, cycle.reason = "unknown", str(error)
        for task in record.tasks if struck else ():
            await task
        if fault is not None and not struck:  # a starved machine has missed its time: it happens later
            for task in record.tasks:
                task.cancel()
            record.tasks.clear()
            record.once.clear()
            cycle.fault = ""
            self.faults[next(at for at in range(number + 2, number + 99) if at not in self.faults)] = fault
        cycle.first, cycle.wrong = person.first, self._misaccounted(stage, record, person.tray)
        cycle.wall_s = time.monotonic() - begun
        with contextlib.suppress(LaboratoryError):
            cycle.bench_s = await stage.now() - clock
        cycle.pace = cycle.bench_s / cycle.wall_s
        if cycle.outcome != "not poured":
            self.number += 1
        return cycle

    def _misaccounted(self, stage: Stage, record: Watched, tray: float) -> float:
        """Compare the account with the truth. Returns the largest difference of a content [kg].

        Args:
            stage, record: of the run.
            tray: mass in the spill tray when the run began [kg], which its virtual bench does not know of.
        """
        contents, worst = stage.contents, 0.0
        true = {"pourer": contents.in_pourer, "receiver": contents.in_receiver}
        for vessel, place in record.stands().items():
            if place is not None and contents.stands.get(vessel) != place:
                self.wrong.append(f"pour {self.number}: the {vessel} stands at {contents.stands.get(vessel)}")
            held = record.account.content(f"night/{vessel}")
            if held is not None and held.mass is not None and place is not None:
                worst = max(worst, abs(held.mass - true[vessel]))
        if (spilled := record.held("tray")) is not None:
            worst = max(worst, abs(spilled[0] - tray - contents.on_tray))
        if worst > ACCOUNTED:
            self.wrong.append(f"pour {self.number}: the account of a content is wrong by {1e3 * worst:.2f} g")
        return worst


class Person:
    """Whoever is asked in a run: is told by messages, mends faults, and looks whether the arm stands still.

    Args:
        night: it is asked in.
        stage: of the run.
    """

    def __init__(self, night: Night, stage: Stage) -> None:
        self._night, self._stage = night, stage
        self._mend: Strike | None = None
        self._stood: np.ndarray | None = None
        self._sent: int | None = None
        self.first = ""
        self.poured, self.tray = False, 0.0
        ask = stage.operator.ask

        async def asked(question: OperatorQuestion) -> str:
            told = {"question": {"text": question.text, "problem": question.problem, "about": question.about}}
            night.receiver.note("QuestionAsked", told, "night")
            await self._look(question)
            if question.about == "unattended":
                self._sent = len(night.receiver.messages)
            answer = await ask(question)
            told["question"]["answer"] = answer
            night.receiver.note("QuestionAnswered", told, "night")
            if question.about == "tray_full":
                self.tray = 0.0
            if question.about in ("move", "start", "home", "untilt", "unattended"):
                self._stood = None
            return answer

        stage.operator.ask = asked  # type: ignore[method-assign]

    @property
    def messages(self) -> int:
        """Sent since the consent."""
        return 0 if self._sent is None else len(self._night.receiver.messages) - self._sent

    def expect(self, fault: Fault) -> None:
        """Mend this one when asked."""
        self._mend, self.first = fault.mend, ""

    async def _look(self, question: OperatorQuestion) -> None:
        wrong, pour = self._night.wrong, f"pour {self._night.number}, asked about {question.about}"
        joints = await self._standing()
        if joints is None:
            wrong.append(f"{pour}: the arm does not come to rest")
        elif self._stood is not None and np.max(np.abs(joints - self._stood)) > STILL:
            wrong.append(f"{pour}: the arm moved without consent")
        if self._sent is not None:
            self.first = self.first or question.about
            if self._mend is not None:
                mend, self._mend = self._mend, None
                await mend(self._stage)
                joints = await self._standing()  # a controller that hung goes on until it misses its client
        self._stood = joints

    async def _standing(self) -> np.ndarray | None:
        """The joints at rest [rad]; None if they are not within the time that a controller needs to miss its client."""
        end, before = time.monotonic() + STANDING, None
        while time.monotonic() < end:
            joints = np.array((await self._stage.site.fault("state"))["joints"])
            if before is not None and np.max(np.abs(joints - before)) < STILL:
                return joints
            before = joints
            await asyncio.sleep(0.1)
        return None


def chosen(pours: int, faults: int, seed: int = 7) -> dict[int, Fault]:
    """In which pours something happens: never in two running, and not in the first."""
    found = sorted(random.Random(seed).sample(range(2, pours - faults + 2), faults))
    return {number + apart: fault for (apart, number), fault in zip(enumerate(found), FAULTS[:faults], strict=True)}


def table(results: Path) -> list[str]:
    """Lines of the page's table, of what was written."""
    rows = [json.loads(line) for line in results.read_text("utf-8").splitlines()]
    cycles = [Cycle(**row) for row in rows if "number" in row]
    ends = [row for row in rows if "runs" in row]
    faulty = [cycle for cycle in cycles if cycle.fault]
    unplanned = [cycle for cycle in cycles if cycle.unplanned]
    poured = Counter(cycle.number for cycle in cycles if cycle.outcome != "not poured")
    missing = max(abs(cycle.missing) for cycle in cycles if cycle.missing is not None)

    def kinds(outcome: str) -> str:
        found = Counter(cycle.fault for cycle in faulty if cycle.outcome == outcome)
        return ", ".join(f"{kind} ({count})" if count > 1 else kind for kind, count in found.items()) or "–"

    return [
        "| | |",
        "|---|---|",
        f"| pours, tries, consents | {len(poured)}, {len(cycles)}, {len(faulty) + len(unplanned) + 1} |",
        f"| made twice | {sum(count > 1 for count in poured.values())} |",
        f"| faults; of them with one message | {len(faulty)}; {sum(cycle.messages == 1 for cycle in faulty)} |",
        f"| a person removed the cause, and the same pour was made and weighed | {kinds('weighed')} |",
        f"| nothing was poured; another run made the pour | {kinds('not poured')} |",
        f"| the pour is UNKNOWN, and its masses were weighed | {kinds('unknown')} |",
        f"| largest imbalance of a cycle, besides injected spills [g] | {1e3 * missing:.2f} |",
        f"| largest error of the account of contents and spill tray [g] | {1e3 * max(c.wrong for c in cycles):.2f} |",
        f"| other than it should be | {len([text for end in ends for text in end['wrong']])} |",
    ]


def write(page: Path, name: str, lines: Sequence[str]) -> None:
    """Replace what stands between the marks of a measurement on a page."""
    text, (begin, end) = page.read_text("utf-8"), (f"<!-- measured: {name} -->\n", "<!-- end of what was measured -->")
    head, rest = text.split(begin)
    page.write_text(head + begin + "\n".join(lines) + "\n" + end + rest.partition(end)[2], encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pours", type=int, default=200)
    parser.add_argument("--faults", type=int, default=20, choices=range(len(FAULTS) + 1))
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.write:
        write(PAGE, "night", table(options.results))
        return 0
    options.results.parent.mkdir(exist_ok=True)
    begun = time.monotonic()
    lines = options.results.read_text("utf-8").splitlines() if options.resume else []
    before = [json.loads(line) for line in lines]
    tries = [Cycle(**row) for row in before if "number" in row]
    faults = chosen(options.pours, options.faults)
    with tempfile.TemporaryDirectory() as folder, options.results.open("a" if before else "w", encoding="utf-8") as out:

        def hear(cycle: Cycle) -> None:
            out.write(json.dumps(asdict(cycle)) + "\n")
            out.flush()
            print(cycle, flush=True)

        if not before:
            out.write(json.dumps({"pours": options.pours, "faults": {n: f.kind for n, f in faults.items()}}) + "\n")
        night = Night(Path(folder), options.pours, faults, hear)
        for cycle in tries:
            night.faults.pop(cycle.number, None)
            night.poured[cycle.number] += cycle.outcome != "not poured"
            night.number = cycle.number + (cycle.outcome != "not poured")
        try:
            asyncio.run(night.run())
        finally:
            end = {"wall_s": time.monotonic() - begun, "runs": night.runs, "wrong": night.wrong}
            out.write(json.dumps(end) + "\n")
            print(*night.wrong, sep="\n")
    return 1 if night.wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
