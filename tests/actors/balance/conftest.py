"""Virtual balances at the far end of pseudo-terminals, and drivers that open these with the real pyserial."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

import pytest

from actors.balance.balance_settings import SerialBalanceSettings, SettlingRule
from actors.balance.dialect_registry import dialects
from actors.balance.scale_model import ScaleSettings
from actors.balance.serial_balance import SerialBalance
from actors.balance.serial_port import tcp_address
from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.emulators.serial_balance.emulated_balance import BalanceFaults
from actors.interfaces import LaboratoryError

PACE = 20.0
"""Bench seconds per second in these tests."""

OF_VOICE = {voice: name for name, dialect in dialects().items() for voice in dialect.encoders()}
"""The dialect of each voice."""

SOON = {"settling": SettlingRule(deadline=4.0)}
"""Gives up early, where giving up is what is tested."""


def spec_for(virtual: Any, dialect: str, **changes: Any) -> SerialBalanceSettings:
    """Settings that leave nothing to be found out."""
    line = {} if tcp_address(virtual.port) else {"baud": 9600, "format": "8N1"}
    spec = SerialBalanceSettings(
        port=virtual.port,
        dialect=dialect,
        **line,
        settling=SettlingRule(deadline=400.0),
        answer_time=0.3,
        reconnect_time=2.0,
        time_scale=PACE,
    )
    return spec.with_values(**changes)


@pytest.fixture(scope="session")
def voices() -> Iterator[Callable[..., VirtualSerialBalance]]:
    """One virtual balance of each voice, started when first asked for."""
    started: dict[tuple[str, bool], VirtualSerialBalance] = {}

    def of(voice: str, tcp: bool = False) -> VirtualSerialBalance:
        if (voice, tcp) not in started:
            started[voice, tcp] = VirtualSerialBalance.start(
                voice, baud=0, scale=ScaleSettings(settling_time=0.4), time_scale=PACE, latency=0.001, tcp=tcp
            )
        return started[voice, tcp]

    yield of
    for virtual in started.values():
        virtual.close()


@pytest.fixture
def virtual(
    voices: Callable[..., VirtualSerialBalance],
) -> Iterator[Callable[..., VirtualSerialBalance]]:
    """An empty, healthy virtual balance of a voice, on a serial line or over TCP."""
    used: list[VirtualSerialBalance] = []

    def of(voice: str, tcp: bool = False) -> VirtualSerialBalance:
        balance = voices(voice, tcp)
        used.append(balance)
        balance.plug()
        balance.faults(**asdict(BalanceFaults()))
        balance.prepare((1,))
        return balance

    yield of
    for balance in used:  # none goes on sending weights to nobody
        with contextlib.suppress(LaboratoryError):
            balance.faults(**asdict(BalanceFaults()))
            balance.prepare((1,))


@pytest.fixture
def driver(virtual: Any) -> Iterator[Callable[..., tuple[VirtualSerialBalance, SerialBalance]]]:
    """A virtual balance of a voice, and the driver at its other end."""
    opened: list[SerialBalance] = []

    def of(voice: str, **changes: Any) -> tuple[VirtualSerialBalance, SerialBalance]:
        far = virtual(voice)
        opened.append(SerialBalance(spec_for(far, OF_VOICE.get(voice, voice), **changes), "kern-1"))
        return far, opened[-1]

    yield of
    for balance in opened:
        balance.close()


VARIANTS = ("kcp", "kern-continuous", "ohaus")
"""Dialects whose lines are much like those of another one: the long tests run them."""


@pytest.fixture(params=[pytest.param(name, marks=[pytest.mark.slow] * (name in VARIANTS)) for name in dialects()])
def each_dialect(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name
