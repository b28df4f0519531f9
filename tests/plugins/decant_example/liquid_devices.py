"""A tap with a valve, and a strip that conducts when it is wet: the devices of a bench that pours without an arm.

`Valve` and `Strip` are the devices; in this example they are objects, and real ones are at the end of a cable. A tap may
pour wanted amounts (`pump: {kind: tap}`), or fill the source vessel again (`source: {refill: {kind: tap}}`). The balance
under a source vessel is a balance as any other, see `balance.py`.
"""

from __future__ import annotations

import threading
import time
from typing import Annotated, Any, ClassVar, Literal

from decant.plugins import (
    LaboratoryError,
    PumpSettings,
    PumpStoppedError,
    Quantity,
    SpillEvent,
    SpillSensorSettings,
)


class TapSettings(PumpSettings):
    """A tap with a valve."""

    kind: Literal["tap"] = "tap"
    """A tap with a valve, which is opened for a time."""

    metering: ClassVar[str] = "time"  # type: ignore[assignment, misc]

    closing_time: Annotated[float, Quantity("s", "20 ms", 0.0, 1.0)] = 0.02
    """Time that the valve needs to close."""

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `PumpSettings.driver`."""
        return Tap, (self,)
