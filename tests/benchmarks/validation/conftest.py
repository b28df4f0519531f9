"""The simulator of the solver's own tests."""

from tests.sim_engine.conftest import simulator

__all__ = ["simulator"]
