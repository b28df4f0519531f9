"""How many examples a property is tried on: a quarter of what is written beside it, and all in `make slow`."""

from __future__ import annotations

import os

THOROUGH = os.environ.get("DECANT_THOROUGH") == "1"


def examples(number: int) -> int:
    """Examples for a property that is thoroughly tried on `number` of them."""
    return number if THOROUGH else max(number // 4, 3)
