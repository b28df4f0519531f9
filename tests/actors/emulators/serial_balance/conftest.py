"""Emulated balances, started as for the tests of the driver."""

from tests.actors.balance.conftest import virtual, voices

__all__ = ["virtual", "voices"]
