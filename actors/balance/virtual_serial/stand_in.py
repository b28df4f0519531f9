"""What stands in for a balance on a serial line on a virtual bench: one at the far end of a pseudo-terminal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from actors.balance.spec import AUTO, BalanceDevice, SerialBalanceSpec
from actors.balance.virtual_serial.handle import VirtualSerialBalance
from actors.balance.virtual_serial.scale import ScaleSettings

USUAL_DIALECT = "kcp"
"""Spoken unless another dialect is named."""


class SerialStandIn:
    """See `actors.balance.spec.BalanceStandIn`.

    Args:
        spec: which dialect at which pace.
        scale: what its data sheet says.

    Raises:
        LaboratoryError: it did not start.
    """

    def __init__(self, spec: SerialBalanceSpec, scale: ScaleSettings) -> None:
        dialect = USUAL_DIALECT if spec.dialect == AUTO else spec.dialect
        # A line that takes no time: in scaled time its characters would be the slowest thing on the bench.
        self._balance = VirtualSerialBalance.start(
            dialect, baud=0, scale=scale, time_scale=spec.time_scale, latency=0.002
        )
        self._spec = replace(spec, port=self._balance.port, dialect=dialect)

    @property
    def device(self) -> BalanceDevice:
        """See `BalanceStandIn.device`."""
        return self._spec

    def prepare(self, seed: tuple[int, ...]) -> None:
        """See `BalanceStandIn.prepare`."""
        self._balance.prepare(seed)

    def put(self, mass: float) -> None:
        """See `BalanceStandIn.put`."""
        self._balance.put(mass)

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """'unplug', 'plug', 'faults' …, see `VirtualSerialBalance`."""
        return self._balance.order(what, **values)

    def close(self) -> None:
        """See `BalanceStandIn.close`."""
        self._balance.close()
