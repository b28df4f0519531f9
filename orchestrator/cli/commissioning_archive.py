"""The archive of a commissioning day: one file with every recording, which can be replayed without the rig.

A `CommissioningArchive` is a zip of readouts of the controller (`decant robot check --record`), recordings of the
balance (`decant balance check --record`) and run folders. Next to each recording it keeps the results that Decant read
from it on that day. A replay reads the recording again, with today's code, and compares. Nothing is connected.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from actors.arm.arm_settings import ArmDiagnostics, SafetyRecord, arm_kind
from actors.balance.dialect_registry import dialects
from actors.balance.line_recording import LineRecording
from actors.interfaces import DeviceCheck
from orchestrator.campaigns.prior_data import read_former_run
from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_check import LEDGER_NAME
from orchestrator.records.journal_file import JournalError

FORMAT = 1
INDEX = "index.json"
EMPTY_POUR = "pour.json"
_KEPT = (JOURNAL_NAME, LEDGER_NAME, EMPTY_POUR)
"""Files of a run folder that are kept: the measurements, without pictures and without paths of the machine."""


class ArchiveError(RunError):
    """A file is no recording, or the archive cannot be read or written."""

    exit_code = 2


@dataclasses.dataclass(frozen=True)
class ArchivedRecording:
    """One recording of an archive.

    Attributes:
        name: file or folder in the archive.
        kind: 'robot check', 'balance', 'run' or 'empty pour'.
        source: 'hardware' or 'virtual'.
        read: what was read from it when it was added; JSON-ready.
    """

    name: str
    kind: str
    source: str
    read: Any


def write_robot_check(
    path: Path,
    laboratory: Path,
    look: ArmDiagnostics,
    record: SafetyRecord | None,
    *,
    virtual: bool,
) -> None:
    """Write the readout of a controller, to judge it again later.

    Args:
        path: of the new file; must not exist.
        laboratory: file of the laboratory, whose text is kept.
        look: the readout.
        record: the accepted safety settings.
        virtual: the controller is virtual.

    Raises:
        ArchiveError: this kind of arm offers no readout.
        OSError: a file cannot be read or written.
    """
    readout = look.recorded()
    if not readout:
        raise ArchiveError("the driver of this arm has no readout that could be recorded")
    data = {
        "decant_robot_check": FORMAT,
        "source": "virtual" if virtual else "hardware",
        "date": time.strftime("%Y-%m-%d"),
        "laboratory": laboratory.read_text(encoding="utf-8"),
        "accepted": None if record is None else dataclasses.asdict(record),
        "readout": readout,
    }
    with path.open("x", encoding="utf-8") as file:
        json.dump(data, file, indent=1, ensure_ascii=False)


class CommissioningArchive:
    """An archive.

    Args:
        path: of the zip file; it need not exist.

    Raises:
        ArchiveError: the file is no archive.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.recordings: list[ArchivedRecording] = []
        if not path.exists():
            return
        try:
            with zipfile.ZipFile(path) as archive:
                index = json.loads(archive.read(INDEX))
            if index["decant_archive"] != FORMAT:
                raise ValueError("written by another version")
            self.recordings = [ArchivedRecording(**entry) for entry in index["recordings"]]
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
            raise ArchiveError(f"{path}: not an archive of recordings ({error})") from error

    def add(self, paths: Sequence[Path]) -> list[ArchivedRecording]:
        """Add recordings: files or run folders. The archive is unchanged if one of them cannot be read.

        Raises:
            ArchiveError: one is no recording, or its name is in the archive already.
            OSError: the archive cannot be written.
        """
        added: list[ArchivedRecording] = []
        for path in paths:
            if path.name in {r.name for r in (*self.recordings, *added)}:
                raise ArchiveError(f"{path.name} is in the archive already; give the new recording another name")
            kind, source, read = read_recording(path)
            added.append(ArchivedRecording(path.name, kind, source, read))
        fresh = self.path.with_name(self.path.name + ".new")
        with zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
            if self.path.exists():
                with zipfile.ZipFile(self.path) as old:
                    for name in old.namelist():
                        if name != INDEX:
                            archive.writestr(name, old.read(name))
            for path in paths:
                for file in [path / name for name in _KEPT] if path.is_dir() else [path]:
                    if file.exists():
                        archive.write(file, file.relative_to(path.parent).as_posix())
            self.recordings += added
            entries = [dataclasses.asdict(r) for r in self.recordings]
            archive.writestr(INDEX, json.dumps({"decant_archive": FORMAT, "recordings": entries}, indent=1))
        fresh.replace(self.path)
        return added

    def replay(self) -> Iterator[DeviceCheck]:
        """Read every recording again, and compare the results with those of the day: one line for each."""
        with tempfile.TemporaryDirectory() as folder:
            with zipfile.ZipFile(self.path) as archive:
                archive.extractall(folder)
            for r in self.recordings:
                try:
                    _, _, read = read_recording(Path(folder) / r.name)
                except ArchiveError as error:
                    yield DeviceCheck(r.name, "fail", str(error), "this version does not read it any more")
                    continue
                different = list(_differences(r.read, read))
                text = f"{r.kind}, {r.source}: {_summary(r)}"
                if different:
                    yield DeviceCheck(r.name, "fail", f"{text}; {different[0]}", "this version reads it differently")
                else:
                    yield DeviceCheck(r.name, "ok", f"{text}; read as on the day")


def read_recording(path: Path) -> tuple[str, str, Any]:
    """Kind, source and results of a recording; see `ArchivedRecording`.

    Raises:
        ArchiveError: it is none, or cannot be read.
    """
    if not path.exists():
        raise ArchiveError(f"{path}: there is no such file")
    try:
        if path.is_dir():
            return _read_run(path)
        if path.suffix == ".jsonl":
            return _read_balance(path)
        return _read_robot_check(path)
    except (OSError, ValueError, KeyError, TypeError, JournalError) as error:
        raise ArchiveError(
            f"{path}: not a recording ({error}); recordings are written by 'decant robot check --record' and 'decant "
            "balance check --record', or are run folders"
        ) from error


def _read_balance(path: Path) -> tuple[str, str, Any]:
    recording = LineRecording.load(path)
    names = dialects()
    name = recording.about.get("dialect", "")
    weights = recording.weights(names[name]) if name in names else []
    return "balance", recording.source, {"dialect": name, "weights": weights}


def _read_run(path: Path) -> tuple[str, str, Any]:
    if not (path / JOURNAL_NAME).exists():
        record = json.loads((path / EMPTY_POUR).read_text(encoding="utf-8"))
        fields = {name: record[name] for name in ("action", "slow", "tracking")}
        return "empty pour", "virtual" if record["mode"] == "virtual" else "hardware", fields
    run = read_former_run(path)
    pours = [
        {
            "scene": scene,
            "action": pour.action.values(),
            "poured": pour.poured,
            "spilled": pour.spilled,
            "retained": pour.retained,
        }
        for scene, pour in run.pours
    ]
    return "run", "virtual" if run.mode == "virtual" else "hardware", {"pours": pours}


def _read_robot_check(path: Path) -> tuple[str, str, Any]:
    from orchestrator.campaigns.file_loading import load_laboratory
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError

    data = json.loads(path.read_text(encoding="utf-8"))
    if data["decant_robot_check"] != FORMAT:
        raise ValueError("written by another version")
    folder = Path(tempfile.mkdtemp())
    try:
        file = folder / "laboratory.yaml"
        file.write_text(data["laboratory"], encoding="utf-8")
        arm = load_laboratory(file, stored=False).arm
    except ConfigError as error:
        raise ValueError(f"its laboratory: {error}") from error
    finally:
        shutil.rmtree(folder)
    if arm is None:
        raise ValueError("its laboratory has no arm")
    accepted = data["accepted"]
    record = None if accepted is None else SafetyRecord(**accepted)
    look = arm_kind(arm).diagnostics_of(data["readout"])
    checks = look.checks(record, accept="decant robot check --accept-safety", virtual=data["source"] == "virtual")
    return "robot check", data["source"], {"checks": [dataclasses.asdict(check) for check in checks]}


def _summary(recording: ArchivedRecording) -> str:
    read = recording.read
    match recording.kind:
        case "robot check":
            failed = sum(check["state"] == "fail" for check in read["checks"])
            return f"{len(read['checks'])} checks, {failed} fail"
        case "balance":
            return f"{read['dialect'] or 'unknown dialect'}, {len(read['weights'])} stable weights"
        case "run":
            return f"{len(read['pours'])} pours"
    return "one cycle"


_SENTENCES = ("found", "advice")
"""What a check says in words: another wording is no other reading, so only their figures are compared."""
_FIGURE = re.compile(r"[\w.]*\d[\w.]*")


def _differences(before: Any, now: Any, place: str = "") -> Iterator[str]:
    """Places where two JSON values differ, as text."""
    if isinstance(before, dict) and isinstance(now, dict) and before.keys() == now.keys():
        for key in before:
            yield from _differences(before[key], now[key], f"{place}.{key}".strip("."))
    elif isinstance(before, list) and isinstance(now, list | tuple) and len(before) == len(now):
        for number, (a, b) in enumerate(zip(before, now, strict=True)):
            yield from _differences(a, b, f"{place}[{number}]")
    elif before != now and not (place.endswith(_SENTENCES) and _figures(before) == _figures(now)):
        yield f"{place} was {json.dumps(before)[:200]}, is {json.dumps(now)[:200]}"


def _figures(text: Any) -> list[str]:
    return _FIGURE.findall(str(text))
