"""Lines that have lost a byte: no dialect takes them for another weight after a line in which a number had its field.

Kulitorum/Decenza#1892 and eamars/OpenTrickler-RP2040-Controller#49 report weights that are wrong by a factor of ten, or
0, after a damaged message: worse than a missing one.
"""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal

import pytest

from actors.balance.balance_settings import SerialBalanceSettings
from actors.balance.dialects.dialect import CHANGED, Dialect, LineForm
from actors.balance.dialects.header_lines import A_AND_D, KERN_CONTINUOUS
from actors.balance.dialects.kcp import KCP
from actors.balance.dialects.kern_swt import KERN_SWT, KernSwt
from actors.balance.dialects.mt_sics import MT_SICS
from actors.balance.dialects.ohaus import OHAUS
from actors.balance.dialects.radwag import RADWAG
from actors.balance.dialects.sbi import SBI, Sbi
from actors.balance.line_explanation import best_fits
from actors.balance.readings import LineError, Reading, ReadingStatus

LAYOUTS: tuple[Dialect, ...] = (
    KCP,
    MT_SICS,
    KERN_SWT,
    KernSwt(short=True),
    OHAUS,
    RADWAG,
    SBI,
    Sbi(identified=True),
    A_AND_D,
    KERN_CONTINUOUS,
    replace(KERN_CONTINUOUS, layout="gab"),
    replace(KERN_CONTINUOUS, layout="indicator"),
)
WEIGHTS = ("0.00", "0.05", "-12.30", "99.99", "123.45", "1234.56")


def line_of(dialect: Dialect, weight: str) -> bytes:
    return dialect.encode(Reading(ReadingStatus.STABLE, Decimal(weight), "g")).rstrip(b"\r\n")


def weight_in(dialect: Dialect, form: LineForm, line: bytes) -> Decimal | None:
    try:
        reply = dialect.decode(line)
    except LineError:
        return None
    return reply.value if isinstance(reply, Reading) and reply.value is not None and form.keeps(line) else None


@pytest.mark.parametrize("dialect", LAYOUTS, ids=lambda dialect: f"{dialect.name}-{line_of(dialect, '1.25')!r}")
def test_no_line_without_one_of_its_bytes_is_another_weight(dialect: Dialect) -> None:
    for weight in WEIGHTS:
        line = line_of(dialect, weight)
        for i in range(len(line)):
            form = LineForm()
            assert weight_in(dialect, form, line_of(dialect, "1.25")) == Decimal("1.25")
            assert weight_in(dialect, form, line[:i] + line[i + 1 :]) in (None, Decimal(weight))
            assert weight_in(dialect, form, line) == Decimal(weight), "the next whole line counts again"


def test_a_balance_that_changes_its_range_is_believed_again() -> None:
    form = LineForm()
    assert form.keeps(b"S S      12.34 g")
    assert [form.keeps(b"S S      123.4 g") for _ in range(CHANGED)] == [False] * (CHANGED - 1) + [True]
    assert form.keeps(b"S S      124.4 g")


def test_numbers_without_a_field_have_no_form() -> None:
    form = LineForm()
    assert all(form.keeps(line) for line in (b"S S 9.99 g", b"S S 10.00 g", b"S S 100.00 g", b"ST,+00100.00  g"))


def test_the_driver_refuses_a_line_of_another_form() -> None:
    import threading

    from actors.balance.dialect_detection import Detected
    from actors.balance.dialects.dialect import LineSettings
    from actors.balance.serial_balance import Conversation

    conversation = Conversation(SerialBalanceSettings(port="/dev/null"), threading.Event())
    conversation.found = Detected(KCP, LineSettings(9600))
    assert conversation._decoded(b"S S     123.45 g") is not None
    assert conversation._decoded(b"S S     12345 g") is None
    assert conversation.counters.damaged == 1


def test_a_fault_of_sartorius_may_have_one_letter() -> None:
    assert SBI.decode(b"   E 054      ") == Reading(ReadingStatus.ERROR, detail="error 054")


@pytest.mark.parametrize("dialect", [KCP, KERN_SWT, SBI, A_AND_D, KERN_CONTINUOUS], ids=lambda dialect: dialect.name)
def test_a_capture_with_damaged_lines_lists_the_dialect_of_its_whole_lines(dialect: Dialect) -> None:
    weights = [f"{10.37 + 12.5 * i:.2f}" for i in range(20)]
    lines = [line_of(dialect, weight) for weight in weights]
    cut = lines[3].index(b"7")  # the last digit
    fits = best_fits([*lines[:5], lines[3][:cut] + lines[3][cut + 1 :], *lines[5:], lines[3][:-1]])
    assert fits[0].dialect is dialect
    assert set(fits[0].reads) == {f"{weight} g" for weight in weights}
