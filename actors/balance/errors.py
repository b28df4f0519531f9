"""What can go wrong with a balance, for the person who stands beside it."""

from __future__ import annotations

from actors.protocols import LaboratoryError


class BalanceError(LaboratoryError):
    """A balance can't do what was asked."""


class NoConnectionError(BalanceError):
    """The port can't be opened, has vanished, or nobody answers on it."""


class LineSettingsError(NoConnectionError):
    """The port can't be set to this speed or format."""


class UnknownDialectError(NoConnectionError):
    """Something may be there, but it speaks none of the dialects."""


class NotStableError(BalanceError):
    """The weight did not settle in time."""


class OutOfRangeError(BalanceError):
    """More on the balance than it weighs, or less."""


class CommandError(BalanceError):
    """Tare or zero was refused, or did not take effect."""


class UnitError(BalanceError):
    """The balance shows something that is not a mass."""


class ReferenceLostError(BalanceError):
    """The connection was lost since the last tare: the balance may have been off and begun at a new zero."""


class BalanceFaultError(BalanceError):
    """The balance reports a fault of its own."""
