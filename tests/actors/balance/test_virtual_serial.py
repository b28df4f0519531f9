"""Virtual balances on serial lines: physics, pace, gibberish, and that none outlives its test."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import serial

from actors.balance.reading import Status
from actors.balance.serial_balance import SerialBalance
from actors.balance.virtual_balance import Load
from actors.balance.virtual_serial.handle import VirtualSerialBalance
from actors.balance.virtual_serial.scale import Scale, ScaleSettings
from actors.child_process import child_environment
from actors.protocols import LaboratoryError
from tests.patience import PATIENCE

from .conftest import spec_for


def test_a_display_comes_within_a_hundredth_in_the_settling_time_and_then_to_rest():
    scale = Scale(ScaleSettings(resolution=1e-5, settling_time=1.5))
    scale.put(Load((0.0,), (1.0,)))
    scale.advance(1.5)
    assert float(scale.reading().value) == pytest.approx(990.0, abs=0.5)
    assert scale.reading().status is Status.UNSTABLE
    scale.advance(5.0)
    assert (str(scale.reading().value), scale.stable) == ("1000.00", True)


def test_a_pour_is_followed_with_the_same_result_in_one_stride_or_many():
    shown = []
    for strides in (1, 7, 1000):
        scale = Scale(ScaleSettings())
        scale.put(Load((0.0, 2.0, 4.0), (0.0, 0.05, 0.2)))
        for _ in range(strides):
            scale.advance(20.0 / strides)
        shown.append(scale.reading())
    assert shown[0] == shown[1] == shown[2]
    assert str(shown[0].value) == "200.0"


def test_weighing_the_same_thing_again_scatters_by_the_noise_and_looking_again_does_not():
    scale = Scale(ScaleSettings(resolution=1e-5, noise=1e-3, settling_time=0.1))
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
    scale = Scale(ScaleSettings(resolution=5e-4, drift=1e-6))
    scale.advance(2000.0)
    assert str(scale.reading().value) == "2.0"
    scale.put(Load((0.0,), (0.1004,)))
    scale.advance(5.0)
    assert str(scale.reading().value) == "102.5"


def test_over_and_under_range_have_no_weight():
    scale = Scale(ScaleSettings(capacity=6.2))
    for mass, status in ((6.3, Status.OVER), (-2.0, Status.UNDER)):
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
                time.sleep(pause)
                driver.read()
            masses.append(driver.weigh().mass)
            driver.close()
    finally:
        far.close()
    assert masses[0] == masses[1]
    assert masses[0] == pytest.approx(5.7e-3, abs=5e-4)


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
    with pytest.raises(LaboratoryError, match="no virtual balance speaks 'latin'; there are kcp"):
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
        "from actors.balance.virtual_serial.handle import VirtualSerialBalance\n"
        "print(VirtualSerialBalance.start('kcp').pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=child_environment())
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert psutil.pid_exists(child)
    os.kill(parent.pid, 9)
    parent.wait()
    parent.stdout.close()
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and psutil.pid_exists(child) and psutil.Process(child).status() != "zombie":
        time.sleep(0.05)
    assert not psutil.pid_exists(child) or psutil.Process(child).status() == "zombie"
