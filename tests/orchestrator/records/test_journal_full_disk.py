"""`journal`: a full disk takes no weighing away. The disk is a real one: a small file system in memory, filled to
the brim.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import DoseSource, DoseTarget, Notice, ProgressCallback
from actors.runtime.child_process import child_environment
from orchestrator.cli.foreground_run import RefusalError, new_run
from orchestrator.learning.campaign_plan import OutputSettings
from orchestrator.learning.requests import Poured
from orchestrator.records.events import Event, LogLine
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.records.journal_file import MB, RESERVE, TO_BEGIN, JournalError, NoSpaceError, Reserve
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from tests.support.scripted_strategy import Script, one_stage, pour, run, states
from tests.support.toy_campaign import ToyBench, ToyLaboratory, toy_plan

SIZE = 60 * MB


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 60 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(place)],
        capture_output=True,
        check=False,
        env=child_environment(),
    )
    if mounted.returncode != 0:
        pytest.skip("only root may mount a small disk")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True, env=child_environment())


def fill(disk: Path, leave: int = 0) -> None:
    """Write until nothing more goes onto a disk, then take `leave` bytes back."""
    with (disk / "other people's").open("ab", buffering=0) as file:
        for size in (1 << 20, 4096, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue
        if leave:
            file.truncate(file.tell() - leave - 4096)  # of which the last page is not a whole one


def tidy(disk: Path) -> None:
    (disk / "other people's").unlink()


class WeighingBench(ToyBench):
    """Weighs three times on the way, and says so; something happens when the pour has begun."""

    happens: Callable[[], None] = staticmethod(lambda: None)
    hear: Callable[[Notice], None] = staticmethod(lambda notice: None)
    remark = ""

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        self.happens()
        for key in ("pourer_full", "pourer_after", "tray_after"):
            self.hear(Notice("note", f"weighed, {key}: 123.4 g{self.remark}"))
        measured = await super().pour(scene, action, seed=seed, progress=progress)
        return replace(measured, notes={"remark": self.remark})


class TellingLaboratory(ToyLaboratory):
    def listen(self, hear: Callable[[Notice], None]) -> None:
        assert isinstance(self.bench, WeighingBench)
        self.bench.hear = hear


def weighed(directory: Path) -> list[str]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        return [e.body["text"] for e in journal.entries(kinds=[Kind.NOTE]) if e.body["text"].startswith("weighed")]


def test_with_the_disk_full_from_just_after_the_pour_began_no_weighing_is_lost(disk: Path) -> None:
    bench = WeighingBench()
    bench.happens = lambda: fill(disk)
    script = Script(pour(1), pour(2))
    with pytest.raises(
        NoSpaceError, match=r"run: 1[12].\d MB are free on its disk, and 20 MB are needed before anything"
    ):
        run(disk / "run", TellingLaboratory(bench=bench), stages=one_stage(script))
    assert weighed(disk / "run") == [f"weighed, {k}: 123.4 g" for k in ("pourer_full", "pourer_after", "tray_after")]
    with JournalReader(disk / "run" / JOURNAL_NAME) as journal:
        assert sum(entry.kind == Kind.POUR_FINISHED for entry in journal.entries()) == 1
    assert [type(outcome) for _, outcome in script.told] == [Poured]
    assert bench.poured == [101]  # the second one was refused: its records would have had no room
    assert states(disk / "run")[-1] == "paused"

    tidy(disk)
    bench.happens = lambda: None
    again = Script(pour(1), pour(2))
    run(disk / "run", TellingLaboratory(bench=bench), resume=True, stages=one_stage(again))
    assert [type(outcome) for _, outcome in again.told] == [Poured, Poured]
    assert bench.poured == [101, 102]


def test_what_finds_no_room_even_in_the_reserve_is_on_the_screen(disk: Path) -> None:
    bench = WeighingBench()
    bench.happens, bench.remark = lambda: fill(disk), " " + "x" * 2 * RESERVE
    events: list[Event] = []
    with pytest.raises(
        JournalError, match=r"Pour 1 was made and weighed.*200.0 g loaded, \d.*answer: weighed [\d.]+ 1.0"
    ):
        run(
            disk / "run", TellingLaboratory(bench=bench), stages=one_stage(Script(pour(1))), subscribers=[events.append]
        )
    shown = [event.text[:50] for event in events if isinstance(event, LogLine)]
    assert sum("weighed, " in text and "can't be written down" in text for text in shown) == 3


def test_no_pour_begins_without_room_for_its_records(disk: Path) -> None:
    fill(disk, leave=RESERVE + 3 * MB)
    laboratory = TellingLaboratory(bench=WeighingBench())
    with pytest.raises(
        NoSpaceError, match=r"2.\d MB are free on its disk, and 8 MB are needed before anything is poured"
    ):
        run(disk / "run", laboratory, stages=one_stage(Script(pour(1))))
    assert laboratory.bench is not None
    assert laboratory.bench.poured == []
    assert states(disk / "run")[-1] == "paused"
    with JournalReader(disk / "run" / JOURNAL_NAME) as journal:
        assert not any(entry.kind == Kind.POUR_STARTED for entry in journal.entries())


def test_a_run_says_at_once_which_disk_is_full_and_how_much_it_needs(disk: Path) -> None:
    fill(disk, leave=3 * MB)
    plan = toy_plan(disk, outputs=OutputSettings(directory=str(disk / "runs")))
    with pytest.raises(
        RefusalError, match=rf"runs: 3.\d MB are free on its disk, and {TO_BEGIN // MB} MB are needed"
    ) as e:
        new_run(plan)
    assert e.value.exit_code == 2
    assert not (disk / "runs").exists()


def test_the_reserve_is_held_while_a_run_runs_and_given_back(tmp_path: Path) -> None:
    sizes = []
    bench = WeighingBench()
    bench.happens = lambda: sizes.append((tmp_path / "run" / "journal.reserve").stat().st_blocks * 512)
    run(tmp_path / "run", TellingLaboratory(bench=bench), stages=one_stage(Script(pour(1))))
    assert sizes[0] >= RESERVE
    assert not (tmp_path / "run" / "journal.reserve").exists()


def test_a_reserve_is_held_anew_before_the_next_pour(tmp_path: Path) -> None:
    reserve = Reserve(tmp_path / "reserve")
    reserve.take()
    assert reserve.release()
    assert not reserve.release()
    reserve.check_pour()
    assert reserve.release()


class DosingBench(ToyBench):
    """Pours a wanted amount, with the signals of a long dose in its record; the disk fills while it flows."""

    happens: Callable[[], None] = staticmethod(lambda: None)

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        self.happens()
        measured = await super().pour(scene, action, seed=seed, progress=progress)
        signals = {name: [round(1.2345 * k, 3) for k in range(600)] for name in SIGNALS}
        return replace(measured, notes={"dose": {"received": 0.05, "left": [0.2, 1e-3], "end": "reached", **signals}})


SIGNALS = ("times", "tilt_deg", "read_at", "readings_g")


def test_with_the_disk_full_in_the_flow_the_amount_of_a_dose_is_kept(disk: Path) -> None:
    bench = DosingBench()
    bench.happens = lambda: fill(disk)
    source = DoseSource("beaker", 0.25, 1e-3, fill=False, constants=1)
    wanted = [replace(one, dose=DoseTarget(0.05, source=source)) for one in (pour(1), pour(2))]
    script = Script(*wanted)
    with pytest.raises(NoSpaceError, match="20 MB are needed before anything"):
        run(disk / "run", ToyLaboratory(bench=bench), stages=one_stage(script))
    (outcome,) = [outcome for _, outcome in script.told]
    assert isinstance(outcome, Poured)
    with JournalReader(disk / "run" / JOURNAL_NAME) as journal:
        (entry,) = [entry for entry in journal.entries() if entry.kind == Kind.POUR_FINISHED]
    about = entry.body["outcome"]["measurement"]["notes"]["dose"]
    assert (about["received"], len(about["readings_g"])) == (0.05, 600)
    assert states(disk / "run")[-1] == "paused"
