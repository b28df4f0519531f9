"""`serial_balance`: the driver where more comes than weights: tares, net and gross, other protocols, numbers that
are no mass.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest

from actors.balance.balance_interface import CommandError, NoConnectionError, NotStableError, UnitError
from actors.balance.balance_settings import SerialBalanceSettings, SettlingRule
from actors.balance.dialect_detection import Attempt, _failure
from actors.balance.dialect_registry import dialects
from actors.balance.dialects.dialect import LineSettings
from actors.balance.serial_balance import SerialBalance
from actors.runtime.bench_clock import DeviceClock
from tests.support.waiting import wait_for


class CountedClock(DeviceClock):
    """A clock that every look takes a millisecond further: on a busy computer no time passes between two looks."""

    def __init__(self) -> None:
        self._looks = itertools.count()

    @property
    def now(self) -> float:
        return 1e-3 * next(self._looks)


class TypedWire:
    """A wire that answers each query with the lines that a balance would send; commands have no reply.

    Args:
        answers: commands so far → the lines of an answer.
        query: the query of the dialect.
    """

    def __init__(self, answers: Callable[[list[bytes]], list[bytes]], query: bytes) -> None:
        self._answers, self._query = answers, query
        self._lines: list[bytes] = []
        self.commands: list[bytes] = []

    def send(self, data: bytes) -> None:
        if data == self._query:
            self._lines = list(self._answers(self.commands))
        else:
            self.commands.append(data)

    def flush(self) -> None:
        self._lines = []

    def line_until(self, moment: float) -> bytes | None:
        return self._lines.pop(0) if self._lines else None

    def close(self) -> None:
        pass


@pytest.fixture
def balance(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[SerialBalance, TypedWire]]:
    """A driver whose balance always sends the same lines, or those of a function of the commands so far."""

    def of(dialect: str, answers: list[bytes] | Callable[[list[bytes]], list[bytes]], **changes):
        spec = SerialBalanceSettings(
            port="/dev/typed",
            dialect=dialect,
            baud=9600,
            format="8N1",
            settling=SettlingRule(readings=2, span=0.0, deadline=8.0),
            answer_time=0.05,
            interval=0.02,
            time_scale=20.0,
        ).with_values(**changes)
        wire = TypedWire(answers if callable(answers) else lambda _: list(answers), spec.allowed[0].query)
        monkeypatch.setattr("actors.balance.serial_balance.Wire", lambda *_, **__: wire)
        monkeypatch.setattr("actors.balance.serial_balance.device_clock", lambda _: CountedClock())
        return SerialBalance(spec, "kern-1"), wire

    return of


def test_a_tray_that_drifts_below_zero_is_weighed_and_keeps_its_tare(balance):
    driver, _ = balance("kern-swt", lambda commands: [b"       -0.01 g  " if commands else b"      350.00 g  "])
    driver.tare()
    assert driver.weigh().mass == pytest.approx(-1e-5)


@pytest.mark.parametrize(
    ("dialect", "line", "said"),
    [
        (
            "sbi",
            b"T     +    90.00 g  ",
            r"'T     \+    90.00 g  ': the application tare memory 1 \('T'\), not a weight",
        ),
        ("ohaus", b"   0.360 kg    PT", r"'   0.360 kg    PT': the preset tare \('PT'\), not a weight"),
        ("kern-continuous", b"ST,TR,+  1.250kg", r"the tare \('TR'\), not a weight"),
        ("sbi", b"ST,+00123.45  g", r"It resembles A&D.*: set 'dialect: a-and-d' or 'dialect: auto'"),
        ("kern-swt", b"S S     100.00 g", r"It resembles .*MT-SICS"),
        (
            "mt-sics",
            b"S D 12:07.50 lb:oz",
            r"'S D 12:07.50 lb:oz': pounds and ounces .* Set its display to weighing in g",
        ),
        ("kcp", b"12 pcs", "Set its display to weighing in g"),
        ("kcp", b"\x00\xf8\x80\xfe", r"'\\x00\\xf8\\x80\\xfe': .*It is not text: speed or parity differ"),
        ("a-and-d", b"\x02ST,+00123.45  g\x03", "Its lines stand between STX and ETX"),
        ("kcp", b"S S  100.0", "'S S  100.0': not a weight"),
    ],
)
def test_a_balance_that_answers_without_a_weight_is_reported_with_its_line(balance, dialect, line, said):
    driver, _ = balance(dialect, [line])
    with pytest.raises(
        NoConnectionError, match=rf"it answers, but no weight came within 8 s\. Its last line was .*{said}"
    ):
        driver.weigh()
    assert driver.read().status == "not understood"
    assert not driver.read().stable


def test_lines_without_a_weight_are_not_a_lost_connection(balance):
    driver, _ = balance(
        "kern-swt", lambda commands: [b"       0.0 oddly" if len(commands) > 1 else b"        0.00 g  "]
    )
    driver.tare()
    driver._conversation.command(b"t", 0.0)  # from here on the lines are odd
    with pytest.raises(NoConnectionError, match="it answers, but no weight came"):
        driver.weigh()


def test_gross_net_and_tare_in_turn_are_not_taken_for_a_draught(balance):
    lines = itertools.cycle([b"ST,+00123.45  g", b"ST,+00100.00  g", b"ST,+00023.45  g"])
    driver, _ = balance("a-and-d", lambda _: [next(lines)])
    said = (
        "no stable weight within 8 s: it sends gross, net and tare in turn: set its print-out to the net weight alone"
    )
    with pytest.raises(NotStableError, match=said):
        driver.weigh()


def test_a_display_that_flickers_is_not_taken_for_gross_net_and_tare(balance):
    lines = itertools.cycle([b"ST,+00100.00  g", b"ST,+00100.10  g", b"ST,+00100.20  g"])
    driver, _ = balance("a-and-d", lambda _: [next(lines)])
    with pytest.raises(NotStableError, match="is there a draught"):
        driver.weigh()


BURST = [b"G#    +   213.56 g  ", b"T     +    90.00 g  ", b"N     +   123.56 g  "]
"""The print-out of gross, tare and net of a Combics."""


def test_of_gross_tare_and_net_the_net_weight_is_read(balance):
    driver, _ = balance("sbi", BURST)
    assert driver.weigh().mass == pytest.approx(0.12356)
    assert driver.statistics()["other"] > 0


def test_with_weight_gross_the_driver_keeps_the_tare_and_sends_none(balance):
    shown = [b"G#    +   213.56 g  "]
    driver, wire = balance("sbi", lambda _: [*shown, *BURST[1:]], weight="gross")
    assert driver.weigh().mass == pytest.approx(0.21356)
    driver.tare()
    assert wire.commands == []
    shown[0] = b"G#    +   218.56 g  "
    assert driver.weigh().mass == pytest.approx(5e-3)
    assert driver.read().mass == pytest.approx(5e-3)


def test_net_lines_are_not_gross_weights(balance):
    driver, _ = balance("sbi", [b"N     +   123.56 g  "], weight="gross")
    with pytest.raises(NoConnectionError, match="the net weight, and 'weight: gross' is set"):
        driver.weigh()


def test_a_balance_that_prints_gross_alone_is_told_how_to_be_tared(balance):
    driver, _ = balance("sbi", [b"G#    +   213.56 g  "])
    assert driver.weigh().mass == pytest.approx(0.21356), "without a tare, gross is net"
    with pytest.raises(
        CommandError, match=r"without effect.*the gross weight, which a tare does not change.*'weight: gross'"
    ):
        driver.tare()


def test_a_tare_that_was_cleared_at_the_balance_is_noticed(balance):
    """Otherwise the gross weight would be read as 350 g of spill."""
    sent = [b"ST,GS   0.350KG"]

    def answers(commands: list[bytes]) -> list[bytes]:
        return [b"ST,NT   0.000KG"] if len(commands) == 1 else sent

    driver, wire = balance("kern-continuous", answers)
    driver.tare()
    assert driver.weigh().mass == 0.0
    wire.commands.append(b"the operator presses TARE")
    with pytest.raises(
        CommandError, match=r"it shows the gross weight, 0\.350 KG, but showed the net weight .*Tare it again"
    ):
        driver.weigh()


def test_a_count_while_moving_is_not_read_in_the_unit_of_the_last_weight(balance):
    sent = [b"       12.30 g  "]
    driver, _ = balance("kern-swt", lambda _: list(sent))
    driver.weigh()
    sent[0] = b"          12 Pcs"
    with pytest.raises(UnitError, match=r"it shows 12 Pcs, and that is pieces; switch it to g"):
        driver.weigh()
    sent[0] = b"          13    "  # unstable: its unit is left out
    seen = wait_for(lambda: now if (now := driver.read()).status == "unstable" else None, "unstable line")
    assert math.isnan(seen.mass)


def test_over_tcp_no_speed_is_advised_that_is_refused_there():
    attempt = Attempt(LineSettings(0), heard=b"\x00\xf8\x80\xfe")
    said = _failure("192.168.1.20:4001", [attempt], list(dialects().values()))
    assert "speed or parity differ; read them in the balance's menu, and set them in the serial server" in said
    assert "'baud'" not in said
    assert "'baud' and 'format'" in _failure("/dev/ttyS0", [attempt], list(dialects().values()))


def test_a_wrong_dialect_is_named_when_nothing_is_recognised():
    """The search shows which dialect the lines resemble."""
    attempt = Attempt(LineSettings(9600), answers={b"SI\r\n": b"ST,+00123.45  g\r\n"})
    said = _failure("/dev/x", [attempt], [dialects()["sbi"]])
    assert "It resembles A&D" in said
