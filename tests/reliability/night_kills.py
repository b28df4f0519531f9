"""The daemon of an unattended campaign is killed at random points of the cycle.

python -m tests.reliability.night_kills --kills 30    # some twenty minutes; writes build/night-kills.jsonl
python -m tests.reliability.night_kills --mixtures    # the same for doses; writes build/mixture-kills.jsonl
python -m tests.reliability.night_kills --write       # no kill: the table of docs/evidence/reliability.md

The daemon is in a process of its own; a client answers its questions over HTTP, and resumes the campaign. Arm, gripper
and balance are emulated behind their protocols, the liquid is a formula. In each life the daemon ends by SIGKILL soon
after a motion of random number has begun, counted from its first one. Afterwards the account is compared with what
truly stood where and what it held:

- a vessel stands where the account says, or that says UNKNOWN; likewise its content, within `ACCOUNTED`;
- the next life moves nothing before its own consent was given;
- no pour is made twice, no liquid is dosed into a cup twice, and no process of a killed daemon is left.

With `--mixtures` the campaign is that of `tests.reliability.mixture_night`. Vessels keep what they truly hold from one
life to the next, except the cup and the source of a dose that was killed while liquid flowed; their cup has to be
UNKNOWN, and the source right within three of its stated deviations, here and everywhere. Every other vessel has an id
at the station.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

from ruamel.yaml import YAML

from actors.arm.arm_device import DeviceArm
from actors.bench.bench_operators import BenchContents, Hands
from actors.bench.liquid_supply import LiquidSupply
from actors.bench.virtual_bench import FollowedBench
from actors.laboratory import WarmSimulators
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.rigs.submissions import pack
from orchestrator.daemon.server_process import serve
from orchestrator.daemon.state.daemon_settings import load_settings
from orchestrator.materials.vessel_account import FILE_NAME, VesselAccount
from tests.reliability import mixture_night, strikes
from tests.reliability.formula import LOG, Formula
from tests.reliability.night import ACCOUNTED, PAGE, ROOT, write
from tests.reliability.rig import LEAVING, PATIENCE, leftovers, warm_up

RESULTS, MIXTURES = ROOT / "build" / "night-kills.jsonl", ROOT / "build" / "mixture-kills.jsonl"

MOTIONS, DOSES = 61, 33
"""Motions of the arm from the first consent to the end of the second pour, and of the third dose."""

LATEST = 0.5
"""Longest time from the begin of a motion to the kill [s]: on an idle machine a motion takes a third of it. A dose
takes longer: times `DOSED`."""

DOSED = 14.0

SEED = 11


@dataclass
class Killed:
    """A life of the daemon, and what it left.

    Attributes:
        motion: number of the motion that had begun.
        during: what it was.
        places, contents: of the vessels: 'right', 'UNKNOWN', or 'wrong'.
        wrong: what should not be.
    """

    motion: int
    during: str
    places: dict[str, str]
    contents: dict[str, str]
    wrong: list[str]


class KilledNight:
    """A campaign in a daemon that is killed again and again.

    Args:
        place: folder to work in.
        write: writes the campaign there.
    """

    def __init__(self, place: Path, write: Callable[[Path], Path] | None = None) -> None:
        self.place, self.state, self._log = place, place / "state", place / "log"
        (place / "tmp").mkdir()
        self._log.touch()
        self._finished = False
        self._campaign = (write or _write_campaign)(place)
        self.plan = load_campaign(self._campaign)

    def kill(self, motion: int, delay: float) -> Killed | None:
        """One life: until it is killed so long [s] after a motion has begun. None if the campaign ended before."""
        (self.state / "url").unlink(missing_ok=True)
        self._note("life", "")
        child = os.fork()
        if child == 0:
            self._serve(motion, delay)
        wrong, end = [], time.monotonic() + PATIENCE
        while os.waitpid(child, os.WNOHANG)[0] == 0:
            time.sleep(0.05)
            if self._finished:
                strikes.kill([child])
                os.waitpid(child, 0)
                return None
            if time.monotonic() > end:
                strikes.kill([child])
                os.waitpid(child, 0)
                wrong.append("it was not killed in time")
                break
            if (self.state / "url").exists():
                with contextlib.suppress(DaemonError, OSError), Client(state=self.state) as client:
                    self._attend(client)
        twice = [f"a pour was made twice: {seed}" for seed in self._twice()]
        return self._look(motion, [*wrong, *twice, *self._left()])

    def _lines(self) -> list[list[Any]]:
        return [json.loads(line) for line in self._log.read_text("utf-8").splitlines()]

    def _twice(self) -> list[str]:
        poured = self.place / "poured"
        made = Counter(poured.read_text("utf-8").split()) if poured.exists() else Counter[str]()
        made.update(f"{flow[1]} into {flow[2]}" for what, flow in self._lines() if what == "flows")
        return [seed for seed, count in made.items() if count > 1]

    def _true(self) -> dict[str, float]:
        """What vessels truly hold [kg]; those that liquid flowed from or into at a kill are absent."""
        held: dict[str, float] = {}
        flowing: set[str] = set()
        for what, value in self._lines():
            if what == "flows":
                flowing = {value[0], value[2]}
            elif what == "life":
                held = {name: mass for name, mass in held.items() if name not in flowing}
                flowing = set()
            elif what == "true":
                held |= value[1]
                flowing = flowing if value[2] else set()
        return {name: mass for name, mass in held.items() if name not in flowing}

    def _note(self, what: str, value: Any) -> None:
        with self._log.open("a", encoding="utf-8") as file:
            file.write(json.dumps([what, value]) + "\n")

    # ---- the client

    def _attend(self, client: Client) -> None:
        items = client.get("/campaigns")
        if not items:
            text, files = pack(load_campaign(self._campaign))
            client.post("/campaigns", {"text": text, "files": files})
            return
        for question in client.get("/questions"):
            if question["about"] == "cup_unknown":
                self._weigh_unknown()
            answer = {"done": "done", "yes or no": "yes", "option": "lost"}[question["wants"]]
            self._note("answered", question["about"])
            client.post(f"/questions/{question['id']}/answer", {"answer": answer})
        if items[0]["state"] in ("failed", "paused", "unknown") and not items[0]["progress"]:
            client.post(f"/campaigns/{items[0]['id']}/resume")
        self._finished = items[0]["state"] == "finished"

    def _weigh_unknown(self) -> None:
        """A person weighs the cups whose content is UNKNOWN, and enters what they hold."""
        account, true = VesselAccount(self.state / FILE_NAME), self._true()
        for name in account.stands(self.plan.laboratory.name):
            vessel = f"{self.plan.laboratory.name}/{name}"
            if (content := account.content(vessel)) is not None and content.mass is None:
                mass = true.get(name, 0.0)
                account.weigh(vessel, mass, 1e-4, liquid="mixture" if mass else "", by="somebody")

    # ---- the daemon's process

    def _serve(self, motion: int, delay: float) -> NoReturn:
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(os.open(self.place / "errors", os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
            os.environ |= {"TMPDIR": str(self.place / "tmp"), LOG: str(self.place / "poured")}
            tempfile.tempdir = None
            WarmSimulators.__init__.__kwdefaults__["make"] = Formula
            self._follow_truth()
            self._count_motions(motion, delay)
            serve(replace(load_settings(None, state=self.state, port=0, in_process=True), keep_free=0))
        finally:
            os._exit(1)

    def _follow_truth(self) -> None:
        """Write down each change of what truly stands where and what it holds."""

        flowing = False

        def tell(contents: BenchContents) -> None:
            self._note("true", [contents.stands, contents.liquids, flowing])

        for name in ("move", "pour_back", "receive", "do"):
            change: Callable[..., Any] = getattr(BenchContents, name)

            def told(contents: BenchContents, *values: Any, _change: Any = change, **named: Any) -> None:
                nonlocal flowing
                _change(contents, *values, **named)
                flowing = flowing and _change.__name__ != "receive"
                tell(contents)

            setattr(BenchContents, name, told)
        top_up = LiquidSupply.top_up

        async def topped(supply: LiquidSupply, *values: Any) -> bool:
            done = await top_up(supply, *values)
            if supply._contents is not None:
                tell(supply._contents)
            return done

        LiquidSupply.top_up = topped  # type: ignore[method-assign]
        flows, lay_out, before = FollowedBench.flows, Hands._lay_out, self._true()

        async def flown(bench: FollowedBench, *show: Any) -> None:
            nonlocal flowing
            assert bench._dose is not None
            scene, _, _ = bench._dose
            flowing = True
            self._note("flows", [bench.contents.pourer, scene.liquid.name, bench.contents.receiver])
            await flows(bench, *show)

        def laid_out(hands: Hands, details: Any) -> None:
            lay_out(hands, details)
            hands.contents.liquids |= {name: m for name, m in before.items() if f"{name} filled_g" not in details}

        FollowedBench.flows, Hands._lay_out = flown, laid_out  # type: ignore[method-assign]

    def _count_motions(self, motion: int, delay: float) -> None:
        """Write down each motion when it begins, and end this process in one of them."""
        count = 0
        for name in ("carry", "move_to_start", "execute", "dose", "retreat"):
            move: Callable[..., Any] = getattr(DeviceArm, name)

            async def moved(
                arm: DeviceArm, path: Any, *values: Any, _move: Any = move, _name: str = name, **named: Any
            ) -> Any:
                nonlocal count
                count += 1
                where = f" {'from' if path.homewards else 'to'} '{path.place}'" if _name == "carry" else ""
                self._note("motion", f"{_name}{where}{' with a vessel' if named.get('loaded') else ''}")
                if count == motion:
                    wait = delay * (DOSED if _name == "dose" else 1.0)
                    threading.Timer(wait, os.kill, (os.getpid(), 9)).start()
                return await _move(arm, path, *values, **named)

            setattr(DeviceArm, name, moved)

    # ---- afterwards

    def _look(self, motion: int, wrong: list[str]) -> Killed:
        lines = self._lines()
        life = lines[max(n for n, (what, _) in enumerate(lines) if what == "life") :]
        moved = next((n for n, (what, _) in enumerate(life) if what == "motion"), len(life))
        if ["answered", "unattended"] not in life[:moved]:
            wrong.append("the arm moved before a consent")
        motions = [value for what, value in life if what == "motion"]
        stands, true, flowing = next((value for what, value in reversed(life) if what == "true"), ({}, {}, False))
        account, prefix = VesselAccount(self.state / FILE_NAME), f"{self.plan.laboratory.name}/"
        places: dict[str, str] = {}
        contents: dict[str, str] = {}
        for vessel, at in stands.items():
            place, held = account.stands(self.plan.laboratory.name)[vessel], account.content(prefix + vessel)
            places[vessel] = "UNKNOWN" if place is None else "right" if place == at else "wrong"
            mass, mixed = None if held is None else held.mass, flowing and vessel.startswith("rack/")
            mixed = mixed and vessel == next(value[2] for what, value in reversed(life) if what == "flows")
            allowed = ACCOUNTED if held is None or vessel.startswith("rack/") else max(ACCOUNTED, 3.0 * held.deviation)
            right = mass is not None and not mixed and abs(mass - true.get(vessel, 0.0)) <= allowed
            contents[vessel] = "UNKNOWN" if mass is None else "right" if right else "wrong"
            if "wrong" in (places[vessel], contents[vessel]):
                wrong.append(f"the {vessel}: {place}, {mass}; in truth {at}, {true.get(vessel)}")
        return Killed(motion, motions[-1] if motions else "", places, contents, wrong)

    def _left(self) -> list[str]:
        end = time.monotonic() + LEAVING
        while (left := leftovers(self.place)) and time.monotonic() < end:
            time.sleep(0.1)
        strikes.kill([process.pid for process in left])
        return [f"left running: {[process.cmdline() for process in left]}"] if left else []


def _write_mixtures(folder: Path) -> Path:
    """The campaign of a night of mixtures, with a person at its laboratory."""
    yaml, path = YAML(), mixture_night.write_campaign(folder, 24, SEED)
    laboratory, campaign = yaml.load(folder / "rack.yaml"), yaml.load(path)
    laboratory["operator"] = {"answers": "person"}
    yaml.dump(laboratory, folder / "rack.yaml")
    yaml.dump(campaign | {"on_unknown": "ask"}, path)
    account, plan = VesselAccount.open(folder / "state"), load_campaign(path)
    for vessel in plan.laboratory.vessels[::2]:
        account.assign(vessel.name.replace("/", "-"), (plan.laboratory.name, vessel.name), by="somebody")
    return path


def _write_campaign(folder: Path) -> Path:
    """The shipped campaign of a night, with a person at its laboratory and many short pours."""
    yaml = YAML()
    laboratory = yaml.load(ROOT / "configs" / "laboratories" / "night.yaml")
    laboratory["operator"] = {"answers": "person"}
    yaml.dump(laboratory, folder / "lab.yaml")
    campaign = yaml.load(ROOT / "configs" / "campaigns" / "night.yaml")
    campaign["laboratory"] = "lab.yaml"
    campaign["unattended"]["until"] = "23:59"
    campaign["outputs"] = {"directory": "runs", "recording": False, "figures": False}
    campaign["on_unknown"] = "ask"
    yaml.dump(campaign, folder / "night.yaml")
    return folder / "night.yaml"


def table(results: Path) -> list[str]:
    """Lines of the page's table, of what was written."""
    found = [Killed(**json.loads(line)) for line in results.read_text("utf-8").splitlines()]
    moments = {
        "the arm carried a vessel": lambda text: "with a vessel" in text,
        "the arm moved to a vessel, or away from it": lambda text: text.startswith("carry") and "with" not in text,
        "the arm poured, or poured back": lambda text: not text.startswith("carry"),
    }
    lines = [
        "| killed while or after | kills | places right, UNKNOWN | contents right, UNKNOWN | wrong |",
        "|---|---|---|---|---|",
    ]
    for words, holds in moments.items():
        these = [one for one in found if holds(one.during)]
        counts = [
            ", ".join(
                str(sum(list(getattr(one, what).values()).count(how) for one in these)) for how in ("right", "UNKNOWN")
            )
            for what in ("places", "contents")
        ]
        lines.append(f"| {words} | {len(these)} | {counts[0]} | {counts[1]} | {sum(len(one.wrong) for one in these)} |")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--mixtures", action="store_true")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    options.results = options.results or (MIXTURES if options.mixtures else RESULTS)
    if options.write:
        command = "python -m tests.reliability.night_kills --mixtures"
        about = [f"Nights of mixtures, their daemon killed 30 times (`{command}`):", ""]
        lines = table(options.results)
        write(PAGE, *(("mixture kills", [*about, *lines]) if options.mixtures else ("night kills", lines)))
        return 0
    options.results.parent.mkdir(exist_ok=True)
    place = Path(tempfile.mkdtemp(prefix="n", dir="/tmp"))
    rng, found = random.Random(options.seed), list[Killed]()
    try:
        night = KilledNight(place, _write_mixtures if options.mixtures else None)
        warm_up(load_campaign(_small(place)))
        with options.results.open("w", encoding="utf-8") as out:
            for _ in range(options.kills):
                motions = DOSES if options.mixtures else MOTIONS
                if (life := night.kill(rng.randint(1, motions), rng.uniform(0.0, LATEST))) is None:
                    break
                found.append(life)
                out.write(json.dumps(asdict(found[-1])) + "\n")
                out.flush()
                print(found[-1], flush=True)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return 1 if any(one.wrong for one in found) else 0


def _small(folder: Path) -> Path:
    from tests.support.small_campaign import write_campaign

    return write_campaign(folder)


if __name__ == "__main__":
    raise SystemExit(main())
