"""For the tests of your own plug-ins: contracts of arms and balances, and the harness of strategies::

    from decant.testing import ArmBench, ArmContract            # needs pytest
    from decant.testing import BalanceBench, BalanceContract    # needs pytest
    from decant.testing import StrategyHarness, check_strategy

How to use them: docs/extending.md. Everything here is imported when it is used first.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from actors.contract_tests.arm_contract import ArmBench, ArmContract
    from actors.contract_tests.balance_contract import BalanceBench, BalanceContract
    from orchestrator.strategy_harness import (
        ACTIONS,
        CALIBRATION_ACTIONS,
        PARAMETERS,
        SCENE,
        THETA,
        SpillModel,
        StrategyHarness,
        check_strategy,
        failures,
        outcome_of,
        replay,
    )

__all__ = [
    "ACTIONS",
    "CALIBRATION_ACTIONS",
    "PARAMETERS",
    "SCENE",
    "THETA",
    "ArmBench",
    "ArmContract",
    "BalanceBench",
    "BalanceContract",
    "SpillModel",
    "StrategyHarness",
    "check_strategy",
    "failures",
    "outcome_of",
    "replay",
]

_CONTRACTS = {
    "ArmBench": "actors.contract_tests.arm_contract",
    "ArmContract": "actors.contract_tests.arm_contract",
    "BalanceBench": "actors.contract_tests.balance_contract",
    "BalanceContract": "actors.contract_tests.balance_contract",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is used first (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module 'decant.testing' has no attribute '{name}'; it has {', '.join(__all__)}")
    if name in _CONTRACTS and find_spec("pytest") is None:
        raise ImportError(f"{name} is run by pytest, which is not installed: pip install pytest")
    return getattr(import_module(_CONTRACTS.get(name, "orchestrator.strategy_harness")), name)


def __dir__() -> list[str]:
    return sorted(__all__)
