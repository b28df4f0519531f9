"""Bytes to readings. The samples were typed from manuals and drivers' notes; none was recorded on a real balance."""

from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from actors.balance.dialect_registry import dialects
from actors.balance.dialects.dialect import Dialect
from actors.balance.dialects.kcp import KCP
from actors.balance.dialects.kern_swt import KERN_SWT, KernSwt
from actors.balance.dialects.mt_sics import MT_SICS
from actors.balance.dialects.sbi import SBI, Sbi
from actors.balance.readings import Acknowledgement, LineError, Reading, ReadingReply, ReadingStatus
from tests.support.hypothesis_examples import examples

SPEAKERS: tuple[Dialect, ...] = (*dialects().values(), KernSwt(short=True), Sbi(identified=True))

TYPED = [
    (MT_SICS, b"S S       0.00 g", ReadingStatus.STABLE, "0.00", "g"),
    (MT_SICS, b"S D      -0.01 g", ReadingStatus.UNSTABLE, "-0.01", "g"),
    (KCP, b"S S 100.00 g", ReadingStatus.STABLE, "100.00", "g"),
    (KCP, b"S I", ReadingStatus.BUSY, None, ""),
    (KCP, b"S +", ReadingStatus.OVER, None, ""),
    (KCP, b"S -", ReadingStatus.UNDER, None, ""),
    (KERN_SWT, b"M-     12.34 g  ", ReadingStatus.STABLE, "-12.34", "g"),
    (KERN_SWT, b"          0.0 g  ", ReadingStatus.STABLE, "0.0", "g"),  # PCB-BA-e-0712, read as 19 bytes
    (KERN_SWT, b"       1234.5    ", ReadingStatus.UNSTABLE, "1234.5", ""),
    (KERN_SWT, b"          0.0 ", ReadingStatus.UNSTABLE, "0.0", ""),
    (KERN_SWT, b"           Error", ReadingStatus.ERROR, None, ""),
    (KERN_SWT, b"       Error", ReadingStatus.ERROR, None, ""),
    (KERN_SWT, b"=Overload=", ReadingStatus.OVER, None, ""),
    (SBI, b"   111.255 g  ", ReadingStatus.STABLE, "111.255", "g"),  # Quintix manual, p. 87
    (SBI, b"+  123.5[6]g  ", ReadingStatus.STABLE, "123.56", "g"),
    (SBI, b"N     +   123.56 g  ", ReadingStatus.STABLE, "123.56", "g"),  # Entris II, p. 3
    (SBI, b"-     0.02    ", ReadingStatus.UNSTABLE, "-0.02", ""),
    (SBI, b"      High    ", ReadingStatus.OVER, None, ""),
    (SBI, b"      Low     ", ReadingStatus.UNDER, None, ""),
    (SBI, b"      --      ", ReadingStatus.BUSY, None, ""),
    (SBI, b"Stat     ERR 054    ", ReadingStatus.ERROR, None, ""),
]


@pytest.mark.parametrize(("dialect", "line", "status", "value", "unit"), TYPED, ids=lambda x: getattr(x, "name", None))
def test_lines_from_manuals_are_understood(dialect, line, status, value, unit):
    reading = dialect.decode(line)
    assert isinstance(reading, Reading)
    assert (reading.status, reading.unit) == (status, unit)
    assert reading.value == (None if value is None else Decimal(value))


@pytest.mark.parametrize(
    ("line", "command", "answer"),
    [
        (b"T S     100.00 g", "T", ReadingReply.DONE),
        (b"T A", "T", ReadingReply.DONE),
        (b"T I", "T", ReadingReply.BUSY),
        (b"T +", "T", ReadingReply.OVER),
        (b"Z A", "Z", ReadingReply.DONE),
        (b"Z -", "Z", ReadingReply.UNDER),
        (b"ZI S", "ZI", ReadingReply.DONE),
        (b'I4 A "0123456789"', "I4", ReadingReply.DONE),
        (b"ES", "", ReadingReply.REFUSED),
        (b"EL", "", ReadingReply.REFUSED),
    ],
)
def test_answers_to_commands_are_told_from_weights(line, command, answer):
    for dialect in (KCP, MT_SICS):
        reply = dialect.decode(line)
        assert isinstance(reply, Acknowledgement)
        assert (reply.command, reply.answer) == (command, answer)


@pytest.mark.parametrize("dialect", SPEAKERS, ids=lambda d: d.name)
@settings(max_examples=examples(300), deadline=None)
@given(line=st.binary(max_size=40) | st.text('SDITAZ+-. 0123456789gkErohLwM[]"', max_size=22).map(str.encode))
@example(line=b"")
@example(line=b"S S 1e5 g")
@example(line=b"S S nan g")
@example(line="S S ١٢ g".encode())
def test_any_bytes_are_understood_or_refused_in_the_stated_way(dialect, line):
    try:
        reply = dialect.decode(line)
    except LineError:
        return
    if isinstance(reply, Reading) and reply.value is not None:
        assert reply.value.is_finite()


WEIGHTS = st.decimals(min_value=-99999, max_value=99999, places=2)


@pytest.mark.parametrize("dialect", SPEAKERS, ids=lambda d: d.name)
@given(value=WEIGHTS, unit=st.sampled_from(["g", "kg", "mg", "ct", "oz", "lb"]), stable=st.booleans())
def test_what_a_balance_sends_is_what_is_read(dialect, value, unit, stable):
    sent = Reading(
        ReadingStatus.STABLE if stable else ReadingStatus.UNSTABLE, abs(value) if value == 0 else value, unit
    )
    line = dialect.encode(sent)
    assert line.endswith(b"\r\n")
    read = dialect.decode(line[:-2])
    assert isinstance(read, Reading)
    assert (read.status, read.value) == (sent.status, sent.value)
    leaves_it_out = not stable and dialect.name in ("kern-swt", "sbi")
    assert read.unit == ("" if leaves_it_out else unit)


@pytest.mark.parametrize("status", [ReadingStatus.OVER, ReadingStatus.UNDER, ReadingStatus.BUSY, ReadingStatus.ERROR])
@pytest.mark.parametrize("dialect", SPEAKERS, ids=lambda d: d.name)
def test_states_without_a_weight_are_read_as_sent_or_can_not_be_said(dialect, status):
    if dialect.name == "kern-swt" and status in (ReadingStatus.UNDER, ReadingStatus.BUSY):
        with pytest.raises(ValueError, match=str(status)):
            dialect.encode(Reading(status))
        return
    assert dialect.decode(dialect.encode(Reading(status, detail="error 5"))[:-2]).status is status


@pytest.mark.parametrize("dialect", SPEAKERS, ids=lambda d: d.name)
@given(value=WEIGHTS.filter(lambda v: abs(v) >= 100), cut=st.integers(1, 17))
def test_a_line_that_lost_its_beginning_is_never_a_smaller_weight(dialect, value, cut):
    line = dialect.encode(Reading(ReadingStatus.STABLE, value, "g"))[:-2]
    try:
        reply = dialect.decode(line[cut:])
    except LineError:
        return
    assert reply == dialect.decode(line)  # only what carries nothing may be lost: the identification before a weight


@pytest.mark.parametrize("dialect", [KERN_SWT, SBI], ids=lambda d: d.name)
@given(value=WEIGHTS.filter(lambda v: abs(v) >= 100), lost=st.integers(0, 13))
def test_a_line_of_fixed_width_that_lost_a_digit_is_no_stable_weight(dialect, value, lost):
    line = dialect.encode(Reading(ReadingStatus.STABLE, value, "g"))[:-2]
    try:
        reply = dialect.decode(line[:lost] + line[lost + 1 :])
    except LineError:
        return
    assert reply.status is not ReadingStatus.STABLE
