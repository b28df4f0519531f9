"""How thoroughly properties are tested: a quarter of the written examples by default, and all of them in `make slow`.

The default suite derives its examples from the test itself, so that every run tests the same ones and two runs of the
same code have the same result. `make slow` draws new examples in every run. An example that fails there is kept in the
test with `@example`.
"""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

THOROUGH = os.environ.get("DECANT_THOROUGH") == "1"


def examples(number: int) -> int:
    """Examples for a property that is thoroughly tried on `number` of them."""
    return number if THOROUGH else max(number // 4, 3)


def load_profile() -> None:
    """Set the defaults of all properties. Call it before test modules are imported."""
    # Deadlines and the check for slow examples measure time, which depends on the load of the machine.
    quiet = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow], "print_blob": True}
    settings.register_profile("default suite", derandomize=True, **quiet)
    settings.register_profile("thorough", **quiet)
    settings.load_profile("thorough" if THOROUGH else "default suite")
