"""Fixtures of the bench's tests."""

from __future__ import annotations

import pytest

from tests.support.wired_bench import OpenStage, opened_stage


@pytest.fixture
def open_stage() -> OpenStage:
    """Opens a wired bench; see `opened_stage`."""
    return opened_stage
