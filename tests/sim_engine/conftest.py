"""One simulator for all tests of this floor: Taichi starts once per process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sim_engine.simulator import PourSimulator


@pytest.fixture(scope="session")
def simulator() -> Iterator[PourSimulator]:
    with_engine = PourSimulator()
    yield with_engine
    with_engine.close()
