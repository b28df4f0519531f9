"""`line_recording`: raw bytes recorded and played. Nothing here was recorded on a real balance: sources say
'virtual' or 'typed'.
"""

from __future__ import annotations

import csv
import itertools
import time
from pathlib import Path

import pytest
import serial
from typer.testing import CliRunner, Result

from actors.balance.dialect_registry import dialects
from actors.balance.line_recording import LineEvent, LineRecording
from actors.balance.readings import Reading
from actors.balance.serial_balance import SerialBalance
from orchestrator.cli.app import app
from tests.actors.balance.conftest import OF_VOICE, spec_for
from tests.support.recorded_balance import RecordedBalance
from tests.support.waiting import wait_for


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
    assert "best fit: " in result.stdout
    assert "stable weights: 12.3 g\n" in result.stdout, "the recording is explained at its end"
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


@pytest.mark.realtime
def test_what_came_from_an_unknown_balance_is_kept_and_explained(virtual, tmp_path):
    far = virtual("mt-sics")
    path = tmp_path / "unknown.jsonl"
    result = record(far.port, path, "--set", "dialect=ohaus", "--set", "baud=2400")
    assert result.exit_code == 1
    assert f"{path}: number of lines" in result.stdout
    assert "no dialect reads a weight in these lines, such as 'ES'" in result.stderr
    assert explain(path).stdout == result.stdout


def test_an_existing_recording_is_not_overwritten(tmp_path):
    path = tmp_path / "kept.jsonl"
    path.write_text("kept")
    assert record("/dev/no-balance", path).exit_code == 2
    assert path.read_text() == "kept"


def explain(path: Path, *options: str) -> Result:
    """Run `decant balance record --from`."""
    return CliRunner().invoke(app, ["balance", "record", "--from", str(path), *options])


def test_a_recording_is_explained_in_the_dialect_that_fits_best(tmp_path):
    path = tmp_path / "kern.jsonl"
    KERN_TYPED.save(path)
    result = explain(path)
    assert result.exit_code == 0
    assert "number of lines 3, of different lines 3" in result.stdout
    assert "best fit: kern-swt (3 weights in 3 lines)\n  stable weights: 12.34 g, 0.00 g" in result.stdout
    assert "  dialect: kern-swt   # baud and format: see its menu" in result.stdout


def test_a_line_that_the_best_dialect_refuses_is_shown_with_the_reason(tmp_path):
    path = tmp_path / "damaged.txt"
    path.write_bytes(b"N     +   123.56 g  \r\n" * 3 + b"N     +   12")
    assert "1 × invalid: 'N     +   12': " in explain(path).stdout


def test_a_file_is_explained_without_a_balance(tmp_path):
    path = tmp_path / "kern.jsonl"
    KERN_TYPED.save(path)
    for arguments in (["/dev/balance", "--from", str(path)], ["--from", str(path), "--to", "new.jsonl"], []):
        result = CliRunner().invoke(app, ["balance", "record", *arguments])
        assert result.exit_code == 2
        assert "--from FILE" in result.stderr


SARTORIUS = b"G#    +   213.56 g  \r\nT     +    90.00 g  \r\nN     +   123.56 g  \r\nStat     ERR 054    \r\n"


def each_line(form: str) -> bytes:
    """The lines as a program logs them."""
    raw = "{!r}" in form
    lines = SARTORIUS.splitlines(keepends=raw)
    return "".join(form.format(line if raw else line.decode()) + "\n" for line in lines).encode()


def dump(offset: str, word: int, form: str) -> bytes:
    """The bytes as a program dumps them, in words of so many bytes; negative: the low byte first."""
    rows = []
    for at in range(0, len(SARTORIUS), 16):
        row = SARTORIUS[at : at + 16]
        words = [row[i : i + abs(word)] for i in range(0, len(row), abs(word))]
        digits = " ".join((one if word > 0 else one[::-1]).hex() for one in words)
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in row)
        rows.append(offset.format(at) + form.format(f"{digits:47}" if word == 1 else digits, text))
    return "\n".join([*rows, offset.format(len(SARTORIUS)).rstrip(" :")][: -1 if ":" in offset else None]).encode()


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (SARTORIUS, None),
        (SARTORIUS.replace(b"\r\n", b"\n"), None),
        (SARTORIUS.replace(b"\r\n", b"\r"), "end with CR alone"),
        (b"\xef\xbb\xbf" + SARTORIUS, None),
        (SARTORIUS.decode().encode("utf-16"), "read as UTF-16"),
        (SARTORIUS.hex(" ").encode(), "read as hexadecimal digits"),
        ("".join(f"{line!r}\n" for line in SARTORIUS.splitlines(keepends=True)).encode(), "printed Python bytes"),
        (SARTORIUS.replace(b"\r\n", b"\r\r\n"), "lines end with CR CR LF"),
        (each_line("2026-11-26 10:11:12,123 DEBUG serial rx: {!r}"), "printed Python bytes"),
        (each_line("[2026-11-26 10:11:00.120] {}"), "the times before the lines are left out"),
        (each_line("10:11:00.120 -> {}"), "the times before the lines are left out"),
        (each_line("2026-11-26T10:11:00Z\t{}"), "the times before the lines are left out"),
        (each_line("{}\\r\\n"), "its escaped control characters"),
        (each_line("{}<CR><LF>"), "its escaped control characters"),
        (b'"Nr","Time","Data"\n' + each_line('7,10:11:00,"{}"'), "the last column"),
        (dump("{:08x}: ", 2, "{}  {}"), "a hexadecimal dump"),  # xxd
        (dump("{:08x}  ", 1, "{}  |{}|"), "a hexadecimal dump"),  # hexdump -C
        (dump("{:07x} ", -2, "{}"), "a hexadecimal dump"),  # hexdump
        (dump("{:07o} ", 1, "{}  >{}<"), "a hexadecimal dump"),  # od -t x1z
        (b"=~=~= PuTTY log 2026.05.04 10:11:12 =~=~=\r\n" + SARTORIUS + b"N     +   12", None),
    ],
)
def test_the_files_of_other_programs_are_explained(tmp_path, content, note):
    path = tmp_path / "capture.txt"
    path.write_bytes(content)
    result = explain(path)
    assert result.exit_code == 0, result.stderr
    assert "best fit: sbi (2 weights in " in result.stdout
    assert "  1 × the application tare memory 1 ('T'), not a weight" in result.stdout
    assert "  1 × error, error 054" in result.stdout
    assert "weight: net   # or gross; it sends both" in result.stdout
    assert note is None or note in result.stdout


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (bytes(range(128, 256)) * 20, "They are not text: speed or parity differ"),
        (b"\x02ST,+00123.45  g\x03\r\n" * 3, "Its lines stand between STX and ETX"),
        (b"  123.45 g\x03\n\x02" * 3, "Its lines stand between STX and ETX"),
        (b"\x02  1.250\x03" * 3, "Its lines stand between STX and ETX"),  # Systel, Toledo: no end of line
        (b"G  123.45 g\r\nN  100.00 g\r\nT   23.45 g\r\n", "it sends gross, net and tare in turn"),
        (
            bytes(b | b.bit_count() % 2 << 7 for b in b"ST,+00123.45  g\r\n"),
            "As '7E1' they are weights: set 'format: 7E1'",
        ),
        (b"12 pcs\r\n", "Set the balance to print the weight in g with its unit"),
        (
            bytes(b | b.bit_count() % 2 << 7 for b in b"+   62.916 g  \r\n" * 3),  # a Sartorius prints as 7O1 or 7E1
            "As '7E1' they are weights: set 'format: 7E1'",
        ),
        (b"S S 12 PCS\r\n", "no dialect reads a weight"),
        (b"S D 12:07.50 lb:oz\r\n", "no dialect reads a weight"),  # artisan-roaster-scope/artisan, pull request 2223
        # replies alone, of balances that were sent commands of another protocol, or could not weigh
        (b"ES\r\n" * 5, "They are error replies: the balance does not know, or can't carry out, the commands"),
        (b"EC,E01\r\n" * 3, "Select the protocol of these commands in its menu"),
        (b"S I\r\n" * 4, "It was busy or not at rest each time: record again when its display stands still"),
        (b"S +\r\n" * 4, "Over range: more is on it than it weighs"),
        (b"Err 54\r\n" * 3, "It reports a fault"),
        (
            b"+ 0000.0003\r\n+ 0012.4510\r\n",
            "to print the weight in g with its unit",
        ),  # Denver M: mdpnp/mdpnp, issue 19
        (b"-00.000\r\n 00.165\r\n" * 2, "to print the weight in g with its unit"),  # Dibal, a POS scale of its manual
        (b"\x02A   0.165\r\x03" * 3, "Its lines stand between STX and ETX"),  # qzind/tray, issue 881
        (b"+ ~~~~~~~~GN\r\n" * 3, "no dialect reads a weight"),  # eamars/OpenTrickler-RP2040-Controller, 49: overload
        (b"---\r\n" * 3, "no dialect reads a weight"),  # eamars/OpenTrickler-RP2040-Controller, pull request 79
        # Adam Equipment's manual of the Highland series, output formats 1 and 2
        (b"GS      123.45 g \r\nNo.         01 \r\nTotal   123.45 g \r\n\r\n\r\n", "no dialect reads a weight"),
        (b"GT,NT      123.45 g \r\n\r\n\r\n" * 2, "no dialect reads a weight"),
        (b"       123.45dwt\r\n" * 2, "to print the weight in g with its unit"),
        (b"          125PCS\r\n" * 2, "to print the weight in g with its unit"),
        (b"dear colleague,\nthe balance does not work\n", "no dialect reads a weight"),
    ],
)
def test_lines_without_any_weight_fit_no_dialect(tmp_path, content, said):
    path = tmp_path / "capture.txt"
    path.write_bytes(content)
    result = explain(path)
    assert result.exit_code == 1
    assert said in result.stderr
    assert "best fit" not in result.stdout


def test_counts_and_pennyweights_of_a_balance_in_kerns_columns_are_no_grams(tmp_path):
    """Adam Equipment's Highland, output format 2: 16 characters, as an older Kern's."""
    path = tmp_path / "capture.txt"
    path.write_bytes(b"       123.45 g \r\n          125PCS\r\n       123.45dwt\r\n-       23.45 g \r\n")
    result = explain(path)
    assert "(2 weights in 4 lines)" in result.stdout
    assert "stable weights: 123.45 g, -23.45 g\n" in result.stdout


def test_a_count_among_weights_is_shown_as_a_count(tmp_path):
    path = tmp_path / "capture.txt"
    path.write_bytes(b"       52.320 g  \r\n           10 pcs\r\n")
    assert "1 × 10 pcs, stable" in explain(path).stdout


GG = b"     0.00 GN\r\n-  450.38 GN\r\n    10.30 GN\r\n    0.000 g \r\n-  29.182 g \r\n    0.665 g \r\n"
KERN = b"        0.000 g  \r\n      -29.186 g  \r\n        0.665 g  \r\n"
INTERVAL = b"       0.01 g    00:00:00\r\n     176.30 g ? 00:00:15\r\n     192.21 g\r\n     207.80 g TOTAL\r\n"


def test_lines_of_a_balance_that_does_not_say_whether_its_weight_is_stable_name_it(tmp_path):
    """G&G PLC100BC, eamars/OpenTrickler-RP2040-Controller, issue 15; the manual of G&G's JJ-BC, p. 14: 14 bytes."""
    path = tmp_path / "capture.txt"
    path.write_bytes(GG)
    result = explain(path)
    assert result.exit_code == 1
    assert "no dialect reads a weight in these lines, such as '     0.00 GN'" in result.stderr
    assert "They look like lines of a G&G balance, which do not say whether the weight is stable" in result.stderr


@pytest.mark.parametrize(
    ("content", "weights", "notes"),
    [
        # Kern, eamars/OpenTrickler-RP2040-Controller, issue 15
        (KERN, "0.000 g, -29.186 g, 0.665 g", []),
        # Ohaus RS232 Interface Manual, p. EN-3: interval printing and a sum
        (INTERVAL, "192.21 g", ["2 × a line of interval printing, not a weight", "1 × a sum ('TOTAL'), not a weight"]),
        # Kern SFB-BA-e-1324, p. 51
        (b"ST,GS   1.000KG\r\nUS,GS   1.342KG\r\n", "1.000 KG", []),
    ],
)
def test_what_other_people_have_captured_is_read_or_named_and_never_another_weight(tmp_path, content, weights, notes):
    path = tmp_path / "capture.txt"
    path.write_bytes(content)
    result = explain(path)
    assert result.exit_code == 0, result.stderr
    assert f"  stable weights: {weights}\n" in result.stdout
    for note in notes:
        assert note in result.stdout


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "No such file or directory"),
        (b"", "the file is empty"),
        (b"\r\n \r\n", "the file is empty"),
        (b'{"decant_serial_recording": 1, "source": "typed"}\n{"t": 0, "dir"', ":2: not a recording of a serial line"),
        (b'{"decant_serial_recording": 1, "source": "typed"}\n\xff\n', "not a recording of a serial line"),
    ],
)
def test_a_file_that_can_not_be_read_is_one_error(tmp_path, content, said):
    path = tmp_path / "capture.jsonl"
    if content is not None:
        path.write_bytes(content)
    result = explain(path)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert str(path) in result.stderr
    assert said in result.stderr
    assert explain(tmp_path).exit_code == 2, "a folder"


def test_a_recording_of_a_silent_balance_says_that_nothing_came(tmp_path):
    path = tmp_path / "silent.jsonl"
    LineRecording("hardware", (LineEvent(0.0, "out", b"SI\r\n"),)).save(path)
    result = explain(path)
    assert result.exit_code == 1
    assert "the balance sent nothing" in result.stderr


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


ARRIVALS = Path(__file__).parents[2] / "data" / "balance-arrivals"


def arrivals(number: int) -> list[tuple[float, str]]:
    """Times [s] and displays [g] of a real balance, see the README there."""
    with (ARRIVALS / f"series-{number}.csv").open(encoding="utf-8") as file:
        return [(float(row["arrival_s"]), row["weight_g"]) for row in csv.DictReader(file)]


@pytest.mark.parametrize("number", range(1, 7))
def test_every_arrival_of_a_real_balance_is_read(number):
    dialect = dialects()["kern-continuous"]
    for _, shown in arrivals(number):
        reading = dialect.decode(f"US,GS,{shown:>9} g".encode())
        assert isinstance(reading, Reading)
        assert float(reading.value) == float(shown)


@pytest.mark.realtime
def test_the_driver_reads_irregular_arrivals_in_their_order(tmp_path):
    """Real readings, each as late as it was, twenty times as fast; the second one is the balance's tare.

    The file of the readings has lost the zeros at their ends, which a display of two decimals shows.
    """
    path = tmp_path / "arrivals.jsonl"
    series = arrivals(4)[:80]
    events = []
    for (before, _), (at, shown) in itertools.pairwise([(-0.1, ""), *series]):
        events.append(LineEvent(before + 0.11, "out", b"SI\r\n"))
        events.append(LineEvent(at + 0.1, "in", f"S D {float(shown):9.2f} g\r\n".encode()))
    LineRecording("typed", tuple(sorted(events, key=lambda one: one.time))).save(path)
    far = RecordedBalance.start(path, speed=20.0)
    seen: dict[float, float] = {}
    try:
        driver = SerialBalance(spec_for(far, "kcp"))
        driver.connect()

        def twenty() -> bool:
            weight = driver.read()
            seen[weight.time] = weight.mass
            return len(seen) == 20

        wait_for(twenty, "twenty readings")
        driver.close()
    finally:
        far.close()
    left = iter([round(1e-3 * float(shown), 9) for _, shown in series])
    assert all(round(mass, 9) in left for mass in seen.values())


def test_a_laboratory_can_keep_the_raw_lines_of_its_balance(tmp_path, voices):
    far = voices("kern-swt")
    for _ in range(2):
        driver = SerialBalance(spec_for(far, OF_VOICE["kern-swt"], raw_lines=str(tmp_path / "lines")), "scale")
        driver.connect()
        wait_for(lambda driver=driver: driver.read().shown, "reading")
        driver.close()
    files = sorted((tmp_path / "lines").glob("scale-*.jsonl"))
    assert len(files) == 2
    for file in files:
        kept = LineRecording.load(file)
        assert kept.source == "hardware"
        assert any(event.direction == "in" for event in kept.events)
        assert kept.about["port"] == far.port
        assert kept.about["started"] > 1.7e9
