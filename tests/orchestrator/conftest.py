"""What several tests of this floor need."""

from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture(scope="session")
def results() -> dict[str, dict[str, Any]]:
    """Results of the real strategies, in a world whose spillage is a formula."""
    from tests.orchestrator.reported import played_results

    return played_results()
