"""What `decant doctor` finds out about a balance. It asks questions; a tare is tried only if it was asked for."""

from __future__ import annotations

from actors.balance.spec import BalanceSpec
from actors.checks import Check


def look_at_balance(spec: BalanceSpec | None, *, tare: bool) -> list[Check]:
    """Who is there, a stable reading, its step; and whether it obeys a tare.

    Args:
        spec: as in the laboratory's file, its address filled in.
        tare: also tare it.
    """
    if spec is None:
        return [Check("balance", "fail", "the file has none", "add a 'balance' section, or 'placement: manual'")]
    if spec.device is None:
        return [Check("balance", "ok", "all weights are typed by the operator")]
    return spec.device.look(tare=tare)
