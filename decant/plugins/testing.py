"""For the tests of your own plug-ins: contracts of devices, and the harness of strategies::

    from decant.plugins.testing import ArmBench, ArmContract            # needs pytest
    from decant.plugins.testing import BalanceBench, BalanceContract    # needs pytest
    from decant.plugins.testing import GripperContract, GripperRig    # needs pytest
    from decant.plugins.testing import PumpContract, PumpRig, SpillRig, SpillSensorContract    # needs pytest
    from decant.plugins.testing import StrategyHarness, check_strategy

How to use them: docs/extend/plug-ins.md. Each name is imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from actors.contract_tests.arm_contract import ArmBench, ArmContract
    from actors.contract_tests.balance_contract import BalanceBench, BalanceContract
    from actors.contract_tests.gripper_contract import GripperContract, GripperRig
    from actors.contract_tests.liquid_device_contracts import PumpContract, PumpRig, SpillRig, SpillSensorContract
    from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
    from orchestrator.runs.strategy_harness import (
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
    "GripperContract",
    "GripperRig",
    "PumpContract",
    "PumpRig",
    "SpillModel",
    "SpillRig",
    "SpillSensorContract",
    "StrategyHarness",
    "VirtualSerialBalance",
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
    "GripperContract": "actors.contract_tests.gripper_contract",
    "GripperRig": "actors.contract_tests.gripper_contract",
    "PumpContract": "actors.contract_tests.liquid_device_contracts",
    "PumpRig": "actors.contract_tests.liquid_device_contracts",
    "SpillRig": "actors.contract_tests.liquid_device_contracts",
    "SpillSensorContract": "actors.contract_tests.liquid_device_contracts",
}

_SOURCE_OF = dict.fromkeys(__all__, "orchestrator.runs.strategy_harness") | {
    **_CONTRACTS,
    "VirtualSerialBalance": "actors.emulators.serial_balance.balance_process",
}
"""Name → the module that provides it."""

if not TYPE_CHECKING:  # otherwise a type checker would accept misspelt names as Any

    def __getattr__(name: str) -> Any:
        """Import a name on first use (PEP 562)."""
        if name not in _SOURCE_OF:
            raise AttributeError(
                f"module 'decant.plugins.testing' has no attribute '{name}'; it has {', '.join(__all__)}"
            )
        if name in _CONTRACTS and find_spec("pytest") is None:
            raise ImportError(f"{name} is run by pytest, which is not installed: pip install pytest")
        return getattr(import_module(_SOURCE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
