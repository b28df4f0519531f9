"""Recordings of a serial line: raw bytes with their times, in a readable file that tests can replay.

`LineRecording` reads and writes such files; `Recorder` writes one during a connection. `Capture` holds the lines of any
file with a balance's traffic: a recording, the log of a terminal program, hexadecimal digits, or printed Python bytes.
"""

from __future__ import annotations

import ast
import json
import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TextIO

from actors.balance.dialects.dialect import Dialect
from actors.balance.readings import LineError, Reading, ReadingStatus

Direction = Literal["out", "in"]
Source = Literal["hardware", "virtual", "typed"]
"""Origin of the bytes: a real balance, an emulated one, or a person who typed them from a manual."""

FORMAT = 1


@dataclass(frozen=True)
class LineEvent:
    """Bytes that were transferred together.

    Attributes:
        time: since the start of the recording [s].
        direction: 'out' to the balance, 'in' from it.
        data: the bytes.
    """

    time: float
    direction: Direction
    data: bytes


@dataclass(frozen=True)
class LineRecording:
    """A recording.

    Attributes:
        source: origin of the bytes.
        events: in order of time.
        about: metadata: balance, line settings, dialect, date, remarks, and the stable weights as they were read.
    """

    source: Source
    events: tuple[LineEvent, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> LineRecording:
        """Read a file.

        Raises:
            ValueError: it is not a recording, or a line is invalid; the text names the line.
        """
        lines = path.read_text(encoding="utf-8").splitlines()
        number = 0
        try:
            head = json.loads(lines[0])
            if head.pop("decant_serial_recording") != FORMAT:
                raise ValueError("written by another version")
            source = head.pop("source")
            if source not in ("hardware", "virtual", "typed"):
                raise ValueError(f"source {source!r}")
            events = []
            for line in lines[1:]:
                number += 1
                entry = json.loads(line)
                if "about" in entry:
                    head.update(entry["about"])
                    continue
                if entry["dir"] not in ("in", "out"):
                    raise ValueError(f"direction {entry['dir']!r}")
                events.append(LineEvent(float(entry["t"]), entry["dir"], bytes.fromhex(entry["hex"])))
        except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}:{number + 1}: not a recording of a serial line ({error})") from error
        return cls(source, tuple(events), head)

    @property
    def received(self) -> bytes:
        """All bytes from the balance."""
        return b"".join(event.data for event in self.events if event.direction == "in")

    def weights(self, dialect: Dialect) -> list[str]:
        """The stable weights in it as a dialect reads them, each as long as it stays: ['0.0 g', '200.0 g']."""
        texts: list[str] = []
        for line in split_lines(self.received):
            try:
                reading = dialect.decode(line)
            except LineError:
                continue
            if isinstance(reading, Reading) and reading.status is ReadingStatus.STABLE and reading.value is not None:
                shown = f"{reading.value} {reading.unit}"
                if texts[-1:] != [shown]:
                    texts.append(shown)
        return texts

    def save(self, path: Path) -> None:
        """Write a file."""
        with path.open("w", encoding="utf-8") as file:
            file.write(header(self.source, self.about))
            for event in self.events:
                file.write(line_of(event))


class Recorder:
    """Writes the bytes of a line as they arrive; use it as a wire's tap.

    Args:
        file: open for writing.
        source: origin of the bytes.
        about: metadata.
    """

    def __init__(self, file: TextIO, source: Source, about: dict[str, Any]) -> None:
        self._file = file
        self._start = time.monotonic()
        self.count = 0
        file.write(header(source, about))

    @classmethod
    def in_folder(cls, folder: Path, name: str, source: Source, port: str) -> Recorder:
        """A recorder of a new file in a folder, which is made if needed; the file has the time in its name.

        Args:
            folder: of recordings.
            name: of the balance.
            source: origin of the bytes.
            port: of the balance.

        Raises:
            OSError: the file can't be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        now = time.time()
        stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S', time.localtime(now))}"
        number = 1
        while True:
            path = folder / (f"{stem}.jsonl" if number == 1 else f"{stem}-{number}.jsonl")
            try:
                file = path.open("x", encoding="utf-8")
                break
            except FileExistsError:
                number += 1
        return cls(file, source, {"port": port, "started": round(now, 3)})

    def __call__(self, direction: str, data: bytes) -> None:
        """Record bytes."""
        self.count += len(data)
        way: Direction = "out" if direction == "out" else "in"
        self._file.write(line_of(LineEvent(time.monotonic() - self._start, way, data)))
        self._file.flush()

    def add(self, **about: Any) -> None:
        """Add metadata that was not known at the start."""
        self._file.write(json.dumps({"about": about}, ensure_ascii=False) + "\n")
        self._file.flush()


LARGEST_CAPTURE = 4 << 20
"""Bytes of a foreign file that are read; hours of traffic."""

_HEX_LINE = re.compile(rb"\s*(?:[0-9A-Fa-f]{2}[ :,]?)*[0-9A-Fa-f]{2}\s*")
_DUMP_LINE = re.compile(rb"[0-9A-Fa-f]{6,8}(?::((?: [0-9A-Fa-f]{2,4})+)  .*|((?: +[0-9A-Fa-f]{2,4})+)(?: *[|>].*| *)|)")
"""A line of xxd (1), or of hexdump or od (2)."""

_TIME = rb"(?:\d{4}-\d\d-\d\d[ T])?\d{1,2}:\d\d:\d\d(?:[.,]\d+)?(?:Z|[-+]\d\d:?\d\d)?"
_TIMED_LINE = re.compile(rb"(?:\[" + _TIME + rb"\]|" + _TIME + rb")(?: (?:->|<-|[<>|]))?[ \t](.*)")
_BYTES_LINE = re.compile(rb".*?\b(b(['\"]).*\2)\s*")
_QUOTED_LINE = re.compile(rb'[^"]*[,;\t]"([^"]*)"\s*')
_NAMES = {name: bytes([number]) for number, name in ((2, b"STX"), (3, b"ETX"), (10, b"LF"), (13, b"CR"))}
_ESCAPED = re.compile(rb"\\r|\\n|\\x[0-9A-Fa-f]{2}|<(?:STX|ETX|CR|LF)>", re.IGNORECASE)


@dataclass(frozen=True)
class Capture:
    """The lines that a balance sent, from a file of any program.

    Attributes:
        lines: without their ends; empty lines are left out.
        about: metadata of a recording; empty for a foreign file.
        notes: how the file was read, if that was not plain.
    """

    lines: tuple[bytes, ...]
    about: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path) -> Capture:
        """Read a recording, or any other file with lines as they came.

        Raises:
            ValueError: it can't be read, is no file, is empty, or is a damaged recording; the text names the file.
        """
        try:
            if path.exists() and not path.is_file():
                raise ValueError(f"{path}: not a file")
            with path.open("rb") as file:
                data = file.read(LARGEST_CAPTURE + 1)
        except OSError as error:
            raise ValueError(f"{path}: {error.strerror or error}") from error
        if not data.strip():
            raise ValueError(f"{path}: the file is empty")
        if b'"decant_serial_recording"' in data.partition(b"\n")[0]:
            try:
                recording = LineRecording.load(path)
            except UnicodeDecodeError as error:
                raise ValueError(f"{path}: not a recording of a serial line ({error})") from error
            return cls._of(recording.received, recording.about, [])
        notes = [f"only the first {LARGEST_CAPTURE >> 20} MiB were read"] if len(data) > LARGEST_CAPTURE else []
        return cls._of(_unwrapped(data[:LARGEST_CAPTURE], notes), {}, notes)

    @classmethod
    def _of(cls, data: bytes, about: dict[str, Any], notes: list[str]) -> Capture:
        if b"\r" in data and b"\n" not in data:
            notes = [*notes, "the lines end with CR alone; choose CR LF as their end in the balance's menu"]
        if b"\r\r\n" in data:
            notes = [*notes, "lines end with CR CR LF: read as CR LF"]
        return cls(tuple(line for line in split_lines(data) if line.strip()), about, tuple(notes))


def split_lines(data: bytes) -> list[bytes]:
    """Return the lines of received bytes, without their ends (CR LF, CR CR LF, LF, or CR alone), the last one, too."""
    if b"\n" not in data:
        return data.split(b"\r")
    return [line.rstrip(b"\r") for line in data.split(b"\n")]


def _unwrapped(data: bytes, notes: list[str]) -> bytes:
    """Return the bytes that a foreign file shows, and note its form."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        notes.append("read as UTF-16")
        data = data.decode("utf-16", "replace").encode("utf-8")
    data = data.removeprefix(b"\xef\xbb\xbf")
    lines = [line for line in data.splitlines() if line.strip()]
    if (rows := [_DUMP_LINE.fullmatch(line) for line in lines]) and all(rows):
        notes.append("read as a hexadecimal dump")
        return b"".join(_undumped(row) for row in rows if row)
    if (timed := [_TIMED_LINE.fullmatch(line) for line in lines]) and all(timed):
        notes.append("the times before the lines are left out")
        lines = [match[1] for match in timed if match]
        data = b"\n".join(lines) + b"\n"
    quoted = [match[1] for match in map(_QUOTED_LINE.fullmatch, lines[1:]) if match]
    if quoted and len(quoted) == len(lines) - 1:
        notes.append("read as a table: the last column")
        return b"\n".join(quoted) + b"\n"
    if printed := [match[1] for match in map(_BYTES_LINE.fullmatch, lines) if match]:
        if len(printed) == len(lines):
            try:
                shown = [ast.literal_eval(line.decode("ascii")) for line in printed]
            except (ValueError, SyntaxError):
                return data
            notes.append("read as printed Python bytes")
            return b"".join(line if line.endswith((b"\n", b"\r")) else line + b"\n" for line in shown)
    elif all(map(_ESCAPED.search, lines)):
        notes.append("read with its escaped control characters")
        return b"".join(_ESCAPED.sub(_unescaped, line) for line in lines)
    if all(map(_HEX_LINE.fullmatch, lines)):
        plain = bytes.fromhex(re.sub(rb"[^0-9A-Fa-f]", b"", data).decode("ascii"))
        if plain.rstrip().count(b"\r") or plain.endswith((b"\r", b"\n")):
            notes.append("read as hexadecimal digits")
            return plain
    return data


def _undumped(row: re.Match[bytes]) -> bytes:
    words = [bytes.fromhex(word.decode("ascii")) for word in (row[1] or row[2] or b"").split()]
    return b"".join(word if row[1] else word[::-1] for word in words)  # hexdump's words have the low byte first


def _unescaped(match: re.Match[bytes]) -> bytes:
    text = match[0]
    if text.startswith(b"<"):
        return _NAMES[text[1:-1].upper()]
    return {b"r": b"\r", b"n": b"\n"}.get(text[1:2]) or bytes.fromhex(text[2:].decode("ascii"))


def header(source: Source, about: dict[str, Any]) -> str:
    """Return the first line of a file."""
    return json.dumps({"decant_serial_recording": FORMAT, "source": source, **about}, ensure_ascii=False) + "\n"


def line_of(event: LineEvent) -> str:
    """Return a line of a file. The text is for readers; only the hexadecimal digits are read back."""
    text = event.data.decode("ascii", "backslashreplace")
    entry = {"t": round(event.time, 4), "dir": event.direction, "hex": event.data.hex(), "text": text}
    return json.dumps(entry) + "\n"
