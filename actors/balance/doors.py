"""The door for balances: dialects of balances on serial lines, ours as everybody's."""

from __future__ import annotations

from collections.abc import Callable

from actors.balance.dialects.dialect import Dialect
from actors.balance.virtual_serial.voice import Voice
from sim_engine.doors import Door


def _balance(loaded: object, name: str) -> Dialect:
    if not isinstance(loaded, Dialect):
        raise TypeError("should be an instance of a class derived from Dialect")
    if loaded.name != name:
        raise ValueError(f"it calls itself '{loaded.name}', which should be the name that it is registered under")
    return loaded


BALANCES: Door[Dialect] = Door("decant.balances", "balance", _balance)
"""All balances that are installed."""


def dialects() -> dict[str, Dialect]:
    """Dialects by the names that files use."""
    return BALANCES.all


def voices() -> dict[str, Callable[[], Voice]]:
    """What a virtual balance may be started as: the dialects, and what else balances of these families are set to."""
    return {name: voice for dialect in dialects().values() for name, voice in dialect.voices().items()}
