"""The plug-in registry of balances, built-in and installed: dialects of serial lines, and kinds with drivers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.balance.dialects.dialect import Dialect
from actors.balance.dialects.protocol_encoder import ProtocolEncoder
from sim_engine.settings.plugin_registry import PluginRegistry


def _balance(loaded: Any, name: str) -> Dialect | type[Any]:
    balance: Dialect | type[Any]
    if isinstance(loaded, Dialect):
        balance, called = loaded, loaded.name
    elif isinstance(loaded, type) and callable(getattr(loaded, "driver", None)) and hasattr(loaded, "settings"):
        balance, called = loaded, loaded.settings.model_fields["kind"].default
    else:
        raise TypeError("should be an instance of a Dialect, or a class derived from decant.plugins.BalanceKind")
    if called != name:
        raise ValueError(f"it calls itself '{called}', which should be the name that it is registered under")
    return balance


BALANCES: PluginRegistry[Dialect | type[Any]] = PluginRegistry("decant.balances", "balance", _balance)
"""All installed balances: instances of dialects, and subclasses of `BalanceKind`."""


def dialects() -> dict[str, Dialect]:
    """Dialects by the names that files use."""
    return {name: dialect for name, dialect in BALANCES.all.items() if isinstance(dialect, Dialect)}


def drivers() -> dict[str, type[Any]]:
    """Kinds of balances with drivers (`BalanceKind`) by the names that files use."""
    return {name: driver for name, driver in BALANCES.all.items() if isinstance(driver, type)}


def kinds() -> dict[str, type[Any]]:
    """Settings of these kinds by the names that files use."""
    return {name: driver.settings for name, driver in drivers().items()}


def encoders() -> dict[str, Callable[[], ProtocolEncoder]]:
    """Protocol encoders for emulated balances, by name: one per dialect, and one per further mode of such balances."""
    return {name: encoder for dialect in dialects().values() for name, encoder in dialect.encoders().items()}
