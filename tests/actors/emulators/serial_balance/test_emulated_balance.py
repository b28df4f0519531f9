"""`emulated_balance`: virtual balances on serial lines: physics, pace, gibberish, and that none outlives its test."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import serial

from actors.balance.readings import ReadingStatus
from actors.balance.scale_model import EmulatedScale, Load, ScaleSettings
from actors.balance.serial_balance import SerialBalance
from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.emulators.serial_balance.emulated_balance import Emulation
from actors.interfaces import LaboratoryError
from actors.runtime.child_process import child_environment
from tests.actors.balance.conftest import spec_for
from tests.support.waiting import PATIENCE, alive


def test_a_display_comes_within_a_hundredth_in_the_settling_time_and_then_to_rest():
    scale = EmulatedScale(ScaleSettings(resolution=1e-5, settling_time=1.5))
    scale.put(Load((0.0,), (1.0,)))
    scale.advance(1.5)
    assert float(scale.reading().value) == pytest.approx(990.0, abs=0.5)
    assert scale.reading().status is ReadingStatus.UNSTABLE
    scale.advance(5.0)
    assert (str(scale.reading().value), scale.stable) == ("1000.00", True)


def test_a_pour_is_followed_with_the_same_result_in_one_stride_or_many():
    shown = []
    for strides in (1, 7, 1000):
        scale = EmulatedScale(ScaleSettings())
        scale.put(Load((0.0, 2.0, 4.0), (0.0, 0.05, 0.2)))
        for _ in range(strides):
            scale.advance(20.0 / strides)
        shown.append(scale.reading())
    assert shown[0] == shown[1] == shown[2]
    assert str(shown[0].value) == "200.0"


def test_weighing_the_same_thing_again_scatters_by_the_noise_and_looking_again_does_not():
    scale = EmulatedScale(ScaleSettings(resolution=1e-5, noise=1e-3, settling_time=0.1))
    seen = []
    for _ in range(400):
        scale.put(Load((0.0,), (0.2,)))
        scale.advance(2.0)
        first = scale.reading()
        scale.advance(5.0)
        assert scale.reading() == first
        seen.append(float(first.value))
    mean = sum(seen) / len(seen)
    deviation = (sum((x - mean) ** 2 for x in seen) / (len(seen) - 1)) ** 0.5
    assert mean == pytest.approx(200.0, abs=4 * 1.0 / 20)
    assert deviation == pytest.approx(1.0, rel=4 / 800**0.5)


def test_the_zero_drifts_with_bench_time_and_steps_may_be_fives():
    scale = EmulatedScale(ScaleSettings(resolution=5e-4, drift=1e-6))
    scale.advance(2000.0)
    assert str(scale.reading().value) == "2.0"
    scale.put(Load((0.0,), (0.1004,)))
    scale.advance(5.0)
    assert str(scale.reading().value) == "102.5"


def test_over_and_under_range_have_no_weight():
    scale = EmulatedScale(ScaleSettings(capacity=6.2))
    for mass, status in ((6.3, ReadingStatus.OVER), (-2.0, ReadingStatus.UNDER)):
        scale.put(Load((0.0,), (mass,)))
        scale.advance(10.0)
        assert scale.reading().status is status
        assert scale.reading().value is None


def test_same_seed_and_loads_weigh_the_same_however_often_one_looks(virtual):
    def weighings(glances: int, seed: int) -> list[float]:
        far = virtual("kcp")
        far.prepare((seed,))
        driver = SerialBalance(spec_for(far, "kcp"))
        masses = []
        for grams in (50.0, 62.3, 112.9):
            far.put(grams / 1e3)
            for _ in range(glances):
                driver.read()
            masses.append(driver.weigh().mass)
        driver.close()
        return masses

    assert weighings(0, 5) == weighings(7, 5)


@pytest.mark.realtime
def test_a_pour_whose_time_passes_by_order_weighs_the_same_to_the_bit_however_the_clock_runs():
    """What a virtual bench needs: drift and settling depend on bench time, and bench time on nothing else."""
    sheet = ScaleSettings(resolution=1e-5, noise=1e-4, drift=1e-6, settling_time=1.5)
    far = VirtualSerialBalance.start("kern-swt", baud=0, scale=sheet, time_scale=0.0)
    try:
        masses = []
        for pause in (0.0, 0.3):
            far.prepare((3,))
            driver = SerialBalance(spec_for(far, "kern-swt"))
            far.put(0.41)
            far.advance(85.0)
            driver.tare()
            far.put(Load((0.0, 4.0), (0.41, 0.4157)))
            for _ in range(5):
                far.advance(1.7)
                time.sleep(pause)  # wall time, which must not show in the masses
                driver.read()
            masses.append(driver.weigh().mass)
            driver.close()
    finally:
        far.close()
    assert masses[0] == masses[1]
    assert masses[0] == pytest.approx(5.7e-3, abs=5e-4)


def test_bench_time_goes_on_from_where_it_is_when_its_pace_changes():
    balance = Emulation("kern-swt", ScaleSettings(), 30.0, 0.0, (0,))
    balance.control({"do": "advance", "seconds": 0.0}, 10.0)
    before = balance.control({"do": "state"}, 11.0)["time"]
    balance.control({"do": "pace", "scale": 1.0}, 11.0)
    after = balance.control({"do": "state"}, 13.0)["time"]
    assert (before, after - before) == (pytest.approx(30.0), pytest.approx(2.0))


@pytest.mark.realtime
def test_noise_of_a_seed_is_the_same_over_the_line_and_another_with_another_seed():
    far = VirtualSerialBalance.start(
        "mt-sics", baud=0, scale=ScaleSettings(resolution=1e-6, noise=1e-3), time_scale=20.0
    )
    try:
        driver = SerialBalance(spec_for(far, "mt-sics"))
        masses = []
        for seed in (5, 5, 6):
            far.prepare((seed,))
            far.put(0.2)
            masses.append(driver.weigh().mass)
        driver.close()
    finally:
        far.close()
    assert masses[0] == masses[1] != masses[2]


@pytest.mark.realtime
def test_characters_take_their_time_on_the_line():
    far = VirtualSerialBalance.start("mt-sics", baud=1200, latency=0.0)
    try:
        with serial.Serial(far.port, 1200, timeout=2.0) as port:
            started = time.monotonic()
            port.write(b"SI\r\n")
            line = port.read_until(b"\n")
            passed = time.monotonic() - started
    finally:
        far.close()
    assert line == b"S S        0.0 g\r\n"
    assert passed >= len(line) * 10 / 1200


@pytest.mark.realtime
def test_at_another_speed_it_hears_nothing_and_says_gibberish():
    far = VirtualSerialBalance.start("mt-sics", baud=9600)
    try:
        with serial.Serial(far.port, 4800, timeout=0.3) as port:
            port.write(b"SI\r\n")
            assert port.read(100) == b""
            far.faults(unasked=0.02)
            assert b"S S" not in port.read(60)
        assert far.state()["questions"] == 0
    finally:
        far.close()


@pytest.mark.realtime
def test_repeated_output_goes_on_until_it_is_cancelled():
    far = VirtualSerialBalance.start("mt-sics", baud=0, time_scale=20.0)
    try:
        with serial.Serial(far.port, 9600, timeout=1.0) as port:
            port.write(b"SIR\r\n")
            assert [port.read_until(b"\n")[:3] for _ in range(5)] == [b"S S"] * 5
            port.write(b"@\r\n")
            while (line := port.read_until(b"\n")).startswith(b"S "):
                pass
            assert line == b'I4 A "0123456789"\r\n'
            assert port.read(1) == b""
    finally:
        far.close()


@pytest.mark.parametrize(
    ("voice", "asked", "answered"),
    [
        ("mt-sics", b"TA\r\n", b"TA A        0.0 g\r\n"),
        ("mt-sics", b"TI\r\n", b"TI S        0.0 g\r\n"),
        ("mt-sics", b"TAC\r\n", b"TAC A\r\n"),
        ("mt-sics", b"ZI\r\n", b"ZI S\r\n"),
        ("mt-sics", b"WHAT\r\n", b"ES\r\n"),
        ("mt-sics", b"S\r\n", b"S S        0.0 g\r\n"),
        ("kern-swt", b"s", b"         0.0 g  \r\n"),
        ("kern-swt", b"xw", b"         0.0 g  \r\n"),
        ("sbi", b"\x1bx1_\r\n", b"VIRTUAL-SBI\r\n"),
        ("sbi", b"P\r\n\x1bP", b"+      0.0 g  \r\n"),
    ],
)
def test_commands_beyond_the_driver_s_are_answered_too(virtual, voice, asked, answered):
    far = virtual(voice)
    far.advance(5.0)
    with serial.Serial(far.port, 9600, timeout=1.0) as port:
        port.write(asked)
        assert port.read_until(b"\n") == answered


class Terminal:
    """A virtual balance without a line or a clock: time passes when a test says so."""

    def __init__(self, voice: str = "mt-sics", **sheet: Any) -> None:
        self.balance = Emulation(voice, ScaleSettings(**sheet), time_scale=1.0, latency=0.0, seed=(1,))
        self.now = 0.0

    def ask(self, command: str) -> list[str]:
        """Send a command. Returns the lines that come at once."""
        self.balance.hear(command.encode() + b"\r\n", self.now)
        return self.lines()

    def lines(self, seconds: float = 0.0) -> list[str]:
        """Lines that come within a time."""
        got, end = b"", self.now + seconds
        while True:
            got += self.balance.speak(self.now)
            if self.now >= end:
                return got.decode("ascii").split("\r\n")[:-1]
            self.now = min(self.now + 0.05, end)

    def put(self, mass: float, seconds: float = 10.0) -> None:
        self.balance.control({"do": "put", "times": [0.0], "masses": [mass]}, self.now)
        self.now += seconds


LEVELS_0_AND_1 = {
    "@": 'I4 A "0123456789"',
    "I1": 'I1 A "01" "2.30" "2.22"',
    "I2": 'I2 A "VIRTUAL 6200.0 g"',
    "I3": 'I3 A "1.00 1.2.3.4"',
    "I4": 'I4 A "0123456789"',
    "I5": 'I5 A "12345678A"',
    "S": "S S       12.3 g",
    "SI": "S S       12.3 g",
    "SIR": "S S       12.3 g",
    "SIRU": "S S       12.3 g",
    "SR": "S S       12.3 g",
    "SR 1 g": "S S       12.3 g",
    "SR 1 furlong": "SR L",
    "SRU": "S S       12.3 g",
    "SNR": "S S       12.3 g",
    "SNR 1 g": "S S       12.3 g",
    "SC 500": "S S       12.3 g",
    "SC soon": "SC L",
    "Z": "Z A",
    "ZI": "ZI S",
    "ZC 500": "ZC S",
    "T": "T S       12.3 g",
    "TI": "TI S       12.3 g",
    "TC 500": "TC S       12.3 g",
    "TA": "TA A        0.0 g",
    "TA 5 g": "TA A        5.0 g",
    "TA 5": "TA L",
    "TA 9 kg": "TA L",
    "TAC": "TAC A",
    'D "hello"': "D A",
    "D hello": "D L",
    "DW": "DW A",
    "K 1": "K A",
    "K 9": "K L",
    "M21": "M21 B 0 0|M21 A 1 0",
    "M21 0 0": "M21 A",
    "M21 0 7": "M21 L",
    "M21 5 0": "M21 L",
    "C": "C B|C A",
    "SI 5": "ES",
    "si": "ES",
    "JAK": "ES",
}
"""Commands with what a balance with 12.3 g on it answers."""


@pytest.mark.parametrize("command", list(LEVELS_0_AND_1))
def test_mt_sics_answers_every_command_of_levels_0_and_1(command: str) -> None:
    terminal = Terminal()
    terminal.put(0.0123)
    assert "|".join(terminal.ask(command)) == LEVELS_0_AND_1[command]


def test_every_listed_command_is_known_and_every_known_one_is_listed() -> None:
    terminal = Terminal()
    listed = [line.split() for line in terminal.ask("I0")]
    assert [line[:2] for line in listed] == [["I0", "B"]] * (len(listed) - 1) + [["I0", "A"]]
    commands = {line[3].strip('"'): int(line[2]) for line in listed}
    assert set(commands) == {"I0", *(command.split()[0] for command in LEVELS_0_AND_1)} - {"si", "JAK"}
    assert {name for name, level in commands.items() if level == 0} >= {"@", "I4", "S", "SI", "Z", "ZI"}
    assert commands["M21"] == 2


def test_kcp_has_the_common_commands_and_none_of_mt_sics_own() -> None:
    terminal = Terminal("kcp")
    assert terminal.ask("DW") == ["DW A"]
    assert terminal.ask("I2") == ['I2 A "KERN VIRTUAL 6200-2"']
    assert [terminal.ask(command) for command in ("M21 0 0", "SC 500", "C")] == [["ES"]] * 3


@pytest.mark.parametrize(
    ("number", "weight", "tare"),
    [
        ("0", "      12.3 g", "       0.5 g"),
        ("1", "    0.0123 kg", "    0.0005 kg"),
        ("3", "     12300 mg", "       500 mg"),
        ("5", "      61.5 ct", "       2.5 ct"),
    ],
)
def test_the_host_unit_holds_for_weights_and_tares_and_survives_a_reset(number: str, weight: str, tare: str) -> None:
    terminal = Terminal()
    terminal.put(0.0128)
    assert terminal.ask(f"M21 0 {number}") == ["M21 A"]
    terminal.ask("@")
    assert terminal.ask("M21") == [f"M21 B 0 {number}", "M21 A 1 0"]
    assert terminal.ask("TA 500 mg") == [f"TA A {tare}"]
    for command in ("S", "SI", "SIR", "SR", "SC 10"):
        assert terminal.ask(command) == [f"S S {weight}"]
    assert terminal.ask("SIRU") == ["S S       12.3 g"]
    assert terminal.ask("I2") == ['I2 A "VIRTUAL 6200.0 g"']


def test_commands_with_a_time_limit_wait_for_rest_no_longer_than_that() -> None:
    terminal = Terminal(settling_time=60.0)
    terminal.put(0.1, seconds=0.5)
    for command, answer in (("SC 1000", "S D "), ("TC 1000", "TC D "), ("ZC 1000", "ZC D")):
        assert terminal.ask(command) == []
        assert terminal.lines(0.9) == []
        (line,) = terminal.lines(0.2)
        assert line.startswith(answer)
    assert terminal.ask("S") == []
    assert terminal.lines(4.9) == []
    assert terminal.lines(0.2) == ["S I"]


def test_sr_reports_changes_and_snr_only_where_they_end() -> None:
    for command, moving in (("SR", True), ("SNR", False), ("SR 50 g", True)):
        terminal = Terminal()
        assert terminal.ask(command) == ["S S        0.0 g"]
        terminal.put(0.002, seconds=0.0)
        assert terminal.lines(10.0) == []  # less than 30 digits
        terminal.put(0.1, seconds=0.0)
        states = [line[:3] for line in terminal.lines(10.0)]
        assert states == (["S D", "S S"] if moving else ["S S"])
        assert terminal.ask("C") == ["C B", "C A"]
        terminal.put(0.2, seconds=0.0)
        assert terminal.lines(10.0) == []


@pytest.mark.parametrize("command", ["@", "C"])
def test_a_cancelled_command_is_not_carried_out_later(command: str) -> None:
    terminal = Terminal(settling_time=60.0)
    terminal.put(0.1, seconds=0.5)
    assert terminal.ask("T") == []
    assert terminal.ask(command) == LEVELS_0_AND_1[command].split("|")
    assert terminal.lines(100.0) == []
    assert terminal.ask("TA") == ["TA A        0.0 g"]


def test_what_the_drivers_of_others_send_is_answered() -> None:
    """The commands of PyLabRobot's backend, in the order in which it sends them: set up, weigh, tare, zero, display."""
    terminal = Terminal()
    terminal.put(0.25)
    for command in ("@", "I0", "I1", "I2", "I3", "M21 0 0", "I4", "I5"):
        assert terminal.ask(command)[-1].split()[1] == "A", command
    assert [terminal.ask(command)[0].split()[-2:] for command in ("S", "SI", "SC 1000")] == [["250.0", "g"]] * 3
    assert [terminal.ask(command)[0].split() for command in ("T", "TA", "S", "TAC", "S")] == [
        ["T", "S", "250.0", "g"],
        ["TA", "A", "250.0", "g"],
        ["S", "S", "0.0", "g"],
        ["TAC", "A"],
        ["S", "S", "250.0", "g"],
    ]
    terminal.put(0.01)
    for command in ("Z", "ZI", "ZC 1000", "TI", "TC 1000", 'D "text"', "DW", "C"):
        assert terminal.ask(command)[-1].split()[1] in "AS", command


def test_a_command_that_finds_no_rest_is_given_up_where_the_dialect_has_words_for_it(virtual):
    far = virtual("kcp")
    far.faults(restless=True)
    with serial.Serial(far.port, 9600, timeout=2.0) as port:
        port.write(b"S\r\n")
        assert port.read_until(b"\n") == b"S I\r\n"


@pytest.mark.realtime
def test_an_order_that_is_unknown_or_comes_too_late_is_refused():
    far = VirtualSerialBalance.start("sbi")
    with pytest.raises(LaboratoryError, match="unexpected keyword argument 'quiet'"):
        far.faults(quiet=True)
    with pytest.raises(LaboratoryError, match="no virtual balance speaks 'latin'; there are a-and-d, "):
        VirtualSerialBalance.start("latin")
    far.close()
    far.close()
    assert far._process.status == 0, "it ended by itself"
    assert not Path(far.port).parent.exists()
    with pytest.raises(LaboratoryError, match="its process is gone"):
        far.put(0.1)


@pytest.mark.realtime
def test_it_dies_with_a_parent_that_was_killed():
    code = (
        "import time\n"
        "from actors.emulators.serial_balance.balance_process import VirtualSerialBalance\n"
        "print(VirtualSerialBalance.start('kcp').pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=child_environment())
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert alive(child)
    os.kill(parent.pid, 9)
    parent.wait()
    parent.stdout.close()
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and alive(child):
        time.sleep(0.05)
    assert not alive(child)
