"""Raw bytes recorded and played. Nothing here was recorded on a real balance: sources say 'virtual' or 'typed'."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import serial
from typer.testing import CliRunner, Result

from actors.balance.dialect_registry import dialects
from actors.balance.line_recording import LineEvent, LineRecording
from actors.balance.serial_balance import SerialBalance
from actors.emulators.serial_balance.balance_process import RecordedBalance
from orchestrator.cli.app import app
from tests.support.waiting import wait_for

from .conftest import spec_for


def record(port: str, path: Path, *options: str) -> Result:
    """Run `decant balance record`."""
    return CliRunner().invoke(app, ["balance", "record", port, "--to", str(path), "--virtual", *options])


def recorded(port: str, path: Path, *options: str) -> Result:
    """Record, which succeeds."""
    line = ["--set", "baud=9600", "--set", "format=8N1"]
    result = record(port, path, *line, *options)
    assert result.exit_code == 0, result.stderr
    return result


KERN_TYPED = LineRecording(
    "typed",
    (
        LineEvent(0.00, "out", b"w"),
        LineEvent(0.05, "in", b"        12"),
        LineEvent(0.07, "in", b".30    \r\n"),
        LineEvent(0.20, "out", b"w"),
        LineEvent(0.25, "in", b"        12.34 g  \r\n"),
        LineEvent(0.40, "out", b"t"),
        LineEvent(0.60, "out", b"w"),
        LineEvent(0.65, "in", b"         0.00 g  \r\n"),
    ),
    {"balance": "layout of Kern PCB-BA-e-1315, p. 35"},
)


def test_a_file_holds_every_byte_its_time_and_where_it_comes_from(tmp_path):
    path = tmp_path / "kern.jsonl"
    recording = LineRecording(
        "typed", (*KERN_TYPED.events, LineEvent(1.5, "in", bytes(range(256)))), {"remarks": "größer"}
    )
    recording.save(path)
    assert LineRecording.load(path) == recording
    assert '"text": "w"' in path.read_text()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello\n",
        '{"decant_serial_recording": 2, "source": "typed"}\n',
        '{"decant_serial_recording": 1, "source": "somewhere"}\n',
        '{"decant_serial_recording": 1, "source": "typed"}\n{"t": 0, "dir": "up", "hex": ""}\n',
        '{"decant_serial_recording": 1, "source": "typed"}\n{"t": 0, "dir": "in", "hex": "5"}\n',
        "[]\n",
    ],
)
def test_what_is_no_recording_is_refused_with_its_line(tmp_path, text):
    path = tmp_path / "file.jsonl"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"file\.jsonl:\d: not a recording of a serial line"):
        LineRecording.load(path)


@pytest.mark.realtime
def test_the_driver_weighs_what_was_recorded(tmp_path):
    path = tmp_path / "kern.jsonl"
    KERN_TYPED.save(path)
    far = RecordedBalance.start(path, speed=20.0)
    try:
        driver = SerialBalance(spec_for(far, "kern-swt"))
        driver.connect()
        first = driver.read()
        second = wait_for(lambda: later if (later := driver.read()).stable else None, "stable reading")
        driver.close()
    finally:
        far.close()
    assert (first.shown, first.stable) == ("12.30", False)
    assert (second.shown, second.stable) == ("12.34 g", True)


@pytest.mark.realtime
def test_a_unit_that_lost_a_letter_once_is_no_other_unit(tmp_path):
    path = tmp_path / "damaged.jsonl"
    lines = [b"S S 0.01230 kg", b"S S 0.01230 k", b"S S 12.30 g", *[b"S S 0.01230 kg"] * 40]  # longer than `hold`
    events = [
        event
        for i, line in enumerate(lines)
        for event in (LineEvent(i, "out", b"SI\r\n"), LineEvent(i + 0.01, "in", line + b"\r\n"))
    ]
    LineRecording("typed", tuple(events)).save(path)
    far = RecordedBalance.start(path, speed=20.0)
    try:
        driver = SerialBalance(spec_for(far, "kcp"))
        assert driver.weigh().mass == pytest.approx(0.0123)
        driver.close()
    finally:
        far.close()


@pytest.mark.realtime
def test_a_late_answer_to_another_command_is_not_taken_for_the_one_awaited(tmp_path):
    path = tmp_path / "late.jsonl"
    events = [
        LineEvent(0.0, "out", b"T\r\n"),
        LineEvent(0.01, "in", b"Z +\r\n"),
        LineEvent(0.1, "in", b"T S 350.00 g\r\n"),
    ]
    for i in range(5):
        events += [LineEvent(1.0 + i, "out", b"SI\r\n"), LineEvent(1.01 + i, "in", b"S S 0.00 g\r\n")]
    LineRecording("typed", tuple(events)).save(path)
    far = RecordedBalance.start(path, speed=20.0)
    try:
        driver = SerialBalance(spec_for(far, "kcp"))
        driver.tare()
        driver.close()
    finally:
        far.close()


@pytest.mark.realtime
def test_answers_come_in_the_pieces_and_at_the_pace_of_then(tmp_path):
    path = tmp_path / "slow.jsonl"
    LineRecording(
        "typed", (LineEvent(0.0, "out", b"w"), LineEvent(0.1, "in", b"12"), LineEvent(0.5, "in", b"34"))
    ).save(path)
    far = RecordedBalance.start(path)
    try:
        with serial.Serial(far.port, 9600, timeout=2.0) as port:
            assert port.in_waiting == 0
            started = time.monotonic()  # before the question: the pace counts from when it arrives
            port.write(b"w")
            assert port.read(2) == b"12"
            assert port.read(2) == b"34"
            assert time.monotonic() - started >= 0.5
    finally:
        far.close()


@pytest.mark.realtime
def test_a_question_that_was_never_asked_gets_no_answer_and_the_next_one_does(tmp_path):
    path = tmp_path / "kern.jsonl"
    KERN_TYPED.save(path)
    far = RecordedBalance.start(path, speed=100.0)
    try:
        with serial.Serial(far.port, 9600, timeout=0.2) as port:
            port.write(b"P")
            assert port.read(1) == b""
            port.write(b"w")
            assert port.read_until(b"\n") == b"        12.30    \r\n"
            assert far.order("state") == {"played": 1, "of": 8}
    finally:
        far.close()


@pytest.mark.realtime
def test_a_session_with_a_balance_is_recorded_and_played_back_to_the_driver(virtual, tmp_path):
    far = virtual("mt-sics")
    far.put(0.0123)
    far.advance(10.0)
    path = tmp_path / "session.jsonl"
    result = recorded(far.port, path, "--seconds", "1", "--set", "dialect=mt-sics")
    assert "12.3 g" in result.stderr
    recording = LineRecording.load(path)
    assert recording.source == "virtual"
    assert recording.about["dialect"] == "mt-sics"
    assert recording.about["weights"] == ["12.3 g"]
    assert {event.data for event in recording.events if event.direction == "out"} == {b"SI\r\n"}
    player = RecordedBalance.start(path, speed=20.0)
    try:
        driver = SerialBalance(spec_for(player, "mt-sics"))
        assert driver.weigh().mass == pytest.approx(0.0123)
        driver.close()
    finally:
        player.close()


def test_listening_records_what_comes_unasked(virtual, tmp_path):
    far = virtual("kern-swt")
    far.faults(unasked=0.05)
    path = tmp_path / "heard.jsonl"
    recorded(far.port, path, "--set", "dialect=kern-swt", "--seconds", "0.5", "--listen")
    events = LineRecording.load(path).events
    assert {event.direction for event in events} == {"in"}
    assert b"".join(event.data for event in events).count(b"\n") >= 3


def test_the_recorder_says_why_it_can_not(tmp_path):
    result = record("/dev/no-balance", tmp_path / "x.jsonl")
    assert result.exit_code == 1
    assert "/dev/no-balance): there is no such port" in result.stderr


def test_an_existing_recording_is_not_overwritten(tmp_path):
    path = tmp_path / "kept.jsonl"
    path.write_text("kept")
    assert record("/dev/no-balance", path).exit_code == 2
    assert path.read_text() == "kept"


DAYS = sorted((Path(__file__).parents[2] / "data" / "balances").glob("*.jsonl"))
"""Recordings of `decant balance record` and `decant balance check --record`."""


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("path", DAYS, ids=lambda path: path.stem)
def test_a_recorded_day_reads_as_it_did(path):
    """Add the file of a real balance to tests/data/balances; nothing else is needed."""
    day = LineRecording.load(path)
    dialect, weights = dialects()[day.about["dialect"]], day.about["weights"]
    assert day.weights(dialect) == weights
    far = RecordedBalance.start(path, speed=50.0)
    try:
        driver = SerialBalance(spec_for(far, dialect.name, interval=0.02, time_scale=50.0))
        driver.connect()
        queries = sum(event.data == dialect.query for event in day.events)
        seen = [weight.shown for _ in range(queries) if (weight := driver.read()).stable]
        driver.close()
    finally:
        far.close()
    assert seen
    assert set(seen) <= set(weights), "never a weight that was not recorded"
