"""`dialect_detection`: finding out what is at the other end of the line, and saying what was tried where that fails."""

from __future__ import annotations

import re
import socket
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict

import pytest
import serial

from actors.balance.balance_interface import BalanceError, LineSettingsError, NoConnectionError
from actors.balance.balance_settings import SerialBalanceSettings, SettlingRule, parse_format
from actors.balance.dialect_registry import dialects
from actors.balance.dialects.dialect import LineSettings
from actors.balance.line_recording import LineEvent, LineRecording
from actors.balance.serial_balance import SerialBalance
from actors.balance.serial_port import Wire, port_advice, tcp_address
from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.emulators.serial_balance.emulated_balance import BalanceFaults
from tests.actors.balance.conftest import OF_VOICE, PACE
from tests.support.recorded_balance import RecordedBalance
from tests.support.waiting import PATIENCE


@pytest.fixture
def unknown(virtual: Callable[[str], VirtualSerialBalance]) -> Iterator[Callable[..., tuple]]:
    """A virtual balance and a driver that is told nothing but the port and what is given."""
    opened: list[SerialBalance] = []

    def of(far: VirtualSerialBalance | str, **settings) -> tuple[VirtualSerialBalance, SerialBalance]:
        far = virtual(far) if isinstance(far, str) else far
        spec = SerialBalanceSettings(port=far.port, time_scale=PACE, settling=SettlingRule(deadline=400.0), **settings)
        opened.append(SerialBalance(spec, "kern-1"))
        return far, opened[-1]

    yield of
    for balance in opened:
        balance.close()


@pytest.mark.realtime
@pytest.mark.parametrize(
    "voice",
    [
        pytest.param(voice, marks=[pytest.mark.slow] * (voice not in dialects()))
        for voice in OF_VOICE
        if voice != "sbi-at-stability"
    ],
)
def test_the_dialect_is_found_out_and_then_used(unknown, voice):
    far, balance = unknown(voice)
    said = balance.connect()
    assert said.startswith(dialects()[OF_VOICE.get(voice, voice)].title)
    far.put(0.2)
    assert balance.weigh().mass == pytest.approx(0.2, abs=1e-9)


@pytest.mark.realtime
def test_finding_out_tares_and_zeroes_nothing(unknown, each_dialect):
    far, balance = unknown(each_dialect)
    far.put(0.05)
    far.advance(5.0)
    before = far.state()["shown"]
    balance.connect()
    assert far.state()["shown"] == before == "50.0 g, stable"


@pytest.mark.realtime
@pytest.mark.parametrize(("dialect", "baud"), [("kcp", 19200), ("sbi", 1200)])
def test_the_speed_is_found_out(unknown, dialect, baud):
    far = VirtualSerialBalance.start(dialect, baud=baud, time_scale=PACE)
    try:
        _, balance = unknown(far, dialect=dialect)
        assert f"{baud} baud" in balance.connect()
        assert balance.weigh().mass == 0.0
    finally:
        far.close()


@pytest.mark.realtime
def test_a_balance_that_prints_by_itself_is_recognised_and_the_operator_told(unknown):
    far, balance = unknown("kern-swt")
    far.faults(unasked=0.05)
    assert "it sends without being asked: switch that off in its menu" in balance.connect()


def test_where_nothing_answers_it_is_said_what_was_tried(unknown):
    far, balance = unknown("kcp", baud=9600, format="8N1")
    far.faults(silent=True)
    with pytest.raises(NoConnectionError) as caught:
        balance.connect()
    said = str(caught.value)
    assert said.startswith(
        f"balance kern-1 ({far.port}): no balance recognised (looked for A&D, Kern KCP, Kern continuous"
    )
    assert "Nothing came at all: is the balance switched on" in said
    assert r"9600 baud 8N1: '\x1bP\r\n' → nothing, 'w' → nothing, 'SI\r\n' → nothing, 'W\r\n'" in said


@pytest.mark.realtime
def test_gibberish_is_said_to_be_a_matter_of_speed_and_parity(unknown):
    far = VirtualSerialBalance.start("mt-sics", baud=2400, time_scale=PACE)
    try:
        far.faults(unasked=0.05)
        _, balance = unknown(far, baud=9600, format="8N1")
        with pytest.raises(NoConnectionError, match="What came is not text: speed or parity differ"):
            balance.connect()
    finally:
        far.close()


@pytest.mark.realtime
@pytest.mark.parametrize(
    "voice", ["sbi", *(pytest.param(voice, marks=pytest.mark.slow) for voice in ("kcp", "kern-swt", "mt-sics"))]
)
def test_a_balance_that_takes_its_time_is_recognised_all_the_same(unknown, voice):
    far, balance = unknown(voice)
    far.faults(delay=0.9)  # a default answer_time is 1 s
    assert balance.connect().startswith(dialects()[voice].title)


@pytest.mark.realtime
def test_a_longer_answer_time_counts_where_only_the_dialect_is_named(unknown):
    far, balance = unknown("kcp", dialect="kcp", answer_time=2.5)
    far.faults(delay=2.0)
    assert balance.connect().startswith("Kern KCP")


@pytest.mark.realtime
def test_another_dialect_than_the_one_named_is_shown_as_it_came(unknown):
    _, balance = unknown("mt-sics", dialect="sbi", baud=9600)
    with pytest.raises(
        NoConnectionError, match=re.escape("looked for Sartorius SBI). It answers, but not in this way")
    ) as caught:
        balance.connect()
    assert r"9600 baud 8N1: '\x1bP\r\n' → 'ES\r\n'" in str(caught.value), "byte for byte, as it was sent and as it came"


def test_lines_that_end_with_a_carriage_return_alone_are_named(tmp_path):
    path = tmp_path / "cr.jsonl"
    said = LineEvent(0.01, "in", b"ST,+00123.45  g\r")
    LineRecording("typed", (LineEvent(0.0, "out", b"SI\r\n"), said)).save(path)
    far = RecordedBalance.start(path)
    try:
        settings = SerialBalanceSettings(port=far.port, dialect="a-and-d", baud=2400, answer_time=0.2)
        with pytest.raises(NoConnectionError, match="end with CR alone; choose CR LF") as caught:
            SerialBalance(settings).connect()
        assert r"'SI\r\n' → 'ST,+00123.45  g\r'" in str(caught.value)
    finally:
        far.close()


def test_lines_that_end_with_cr_cr_lf_are_weights():
    with socket.create_server(("127.0.0.1", 0)) as server:
        wire = Wire(f"127.0.0.1:{server.getsockname()[1]}", LineSettings(0))
        with server.accept()[0] as connection:
            connection.sendall(b"ST,+00123.45  g\r\r\nUS,+00124.10  g\r\r\n")
            lines = [wire.line_until(time.monotonic() + PATIENCE) for _ in range(2)]
        wire.close()
    assert lines == [b"ST,+00123.45  g", b"US,+00124.10  g"]


@pytest.mark.realtime
def test_a_weigh_module_that_claims_a_level_without_its_commands_is_recognised_by_its_list(unknown):
    _, balance = unknown("mt-sics-weigh-module")
    assert balance.connect().startswith("Mettler-Toledo MT-SICS (VIRTUAL")
    found = balance._conversation.found
    assert found is not None
    assert {"SI", "T", "Z", "@"} <= found.commands
    assert not {"C", "D", "DW", "SC", "TC", "ZC"} & found.commands
    balance.tare()


@pytest.mark.realtime
@pytest.mark.parametrize("voice", ["kern-continuous", "kern-continuous-indicator", "a-and-d"])
def test_a_balance_that_only_streams_is_recognised_and_weighed(unknown, voice):
    """At the ten lines a second of the manuals; it hears no command."""
    far, balance = unknown(voice)
    far.faults(unasked=0.1, stranger=True)
    assert balance.connect().startswith(dialects()[OF_VOICE[voice]].title)
    far.put(0.2)
    assert balance.weigh().mass == pytest.approx(0.2, abs=1e-9)


@pytest.mark.realtime
def test_over_tcp_only_the_dialect_is_searched_for(unknown, virtual, each_dialect):
    far, balance = unknown(virtual(each_dialect, tcp=True))
    assert balance.connect().endswith(f"on {far.port}, TCP")
    far.put(0.2)
    assert balance.weigh().mass == pytest.approx(0.2, abs=1e-9)


@pytest.mark.parametrize(
    ("port", "said"),
    [
        (
            "127.0.0.1:1",
            "the host is there, but nothing listens on port 1. Check the port's number",
        ),
        ("no-such-host.invalid:4001", "no host has this name; check it, or give its IP address"),
    ],
)
def test_an_address_without_a_balance_says_what_to_check(port, said):
    with pytest.raises(NoConnectionError, match=re.escape(f"balance kern-1 ({port}): {said}")):
        SerialBalance(SerialBalanceSettings(port=port), "kern-1").connect()


@pytest.mark.parametrize(
    ("port", "address"),
    [
        ("192.168.1.20:4001", ("192.168.1.20", 4001)),
        ("balance-3.lab:8001", ("balance-3.lab", 8001)),
        ("[fe80::1]:23", ("fe80::1", 23)),
        ("/dev/serial/by-id/usb-a:b:23", None),
        ("COM3", None),
    ],
)
def test_an_address_is_told_from_a_port_of_this_machine(port, address):
    assert tcp_address(port) == address


def test_dtr_and_rts_are_on_unless_switched_off_before_the_port_opens(monkeypatch):
    opened = []

    class Wires:
        dtr = rts = None

        def __init__(self, port, baud, **others):
            assert port is None

        def open(self):
            opened.append((self.port, self.dtr, self.rts))
            raise OSError(2, "gone")

    monkeypatch.setattr(serial, "Serial", Wires)
    for changes in ({}, {"dtr": False}, {"rts": False}, {"handshake": "hardware"}):
        spec = SerialBalanceSettings(port="/dev/x", dialect="kcp", baud=9600, format="8N1", **changes)
        with pytest.raises(NoConnectionError):
            SerialBalance(spec).connect()
    assert [wires for _, *wires in opened] == [[True, True], [False, True], [True, False], [True, None]]


def test_a_search_can_be_interrupted(unknown):
    far, balance = unknown("kcp")
    far.faults(silent=True)
    before = far.state()["questions"]
    balance.interrupt()
    with pytest.raises(BalanceError, match="interrupted"):
        balance.connect()
    assert far.state()["questions"] - before <= 1, "it did not go on to other settings of the line"


@pytest.mark.realtime
def test_a_setting_that_the_port_refuses_is_left_out_and_named(unknown, monkeypatch):
    real = serial.Serial

    def picky(port, baud, **others):
        if baud == 9600:
            raise termios.error(22, "Invalid argument")
        return real(port, baud, **others)

    monkeypatch.setattr(serial, "Serial", picky)
    _, balance = unknown("kern-swt", dialect="kern-swt", format="8N1")
    assert "4800 baud" in balance.connect()
    _, balance = unknown("kern-swt", dialect="kern-swt", baud=9600)
    with pytest.raises(LineSettingsError, match="can't be set to 9600 baud 8N1"):
        balance.connect()
    _, balance = unknown("kern-swt", baud=9600, format="8N1")
    with pytest.raises(NoConnectionError, match="9600 baud 8N1: the port can't be set so"):
        balance.connect()


def test_settings_narrow_the_search():
    every = SerialBalanceSettings(port="p").candidates()
    assert every[0] == LineSettings(9600)
    assert LineSettings(1200, 7, "O") in every
    assert SerialBalanceSettings(port="p", dialect="kcp", baud=4800, format="8N1").candidates() == (LineSettings(4800),)
    assert {c.baud for c in SerialBalanceSettings(port="p", baud=2400).candidates()} == {2400}
    assert {c.format for c in SerialBalanceSettings(port="p", format="7E1").candidates()} == {"7E1"}


@pytest.mark.parametrize("text", ["9N1", "8X1", "8N", "8N3", ""])
def test_a_format_that_is_none_is_refused_with_one_that_is(text):
    with pytest.raises(ValueError, match="as '8N1' or '7O1'"):
        parse_format(text)


def test_names_that_change_with_the_next_plugging_are_advised_against():
    assert "use its name under /dev/serial/by-id/" in (port_advice("/dev/ttyUSB0") or "")
    assert port_advice("/dev/serial/by-id/usb-FTDI_FT232R-if00-port0") is None
    assert port_advice("/dev/ttyS0") is None


def test_faults_are_off_unless_asked_for():
    assert not any(asdict(BalanceFaults()).values())
