"""For the tests of your own plug-ins: contracts of devices, and the harness of strategies::

    from decant.plugins.testing import ArmBench, ArmContract            # needs pytest
    from decant.plugins.testing import BalanceBench, BalanceContract    # needs pytest
    from decant.plugins.testing import GripperContract, GripperRig    # needs pytest
    from decant.plugins.testing import PumpContract, PumpRig, SpillRig, SpillSensorContract    # needs pytest
    from decant.plugins.testing import StrategyHarness, check_strategy

How to use them: docs/extend/plug-ins.md. Each name is imported on first use.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from decant.lazy_names import import_name, names_for_type_checkers

if TYPE_CHECKING:
    from actors.contract_tests.arm_contract import ArmBench as ArmBench
    from actors.contract_tests.arm_contract import ArmContract as ArmContract
    from actors.contract_tests.balance_contract import BalanceBench as BalanceBench
    from actors.contract_tests.balance_contract import BalanceContract as BalanceContract
    from actors.contract_tests.gripper_contract import GripperContract as GripperContract
    from actors.contract_tests.gripper_contract import GripperRig as GripperRig
    from actors.contract_tests.liquid_device_contracts import PumpContract as PumpContract
    from actors.contract_tests.liquid_device_contracts import PumpRig as PumpRig
    from actors.contract_tests.liquid_device_contracts import SpillRig as SpillRig
    from actors.contract_tests.liquid_device_contracts import SpillSensorContract as SpillSensorContract
    from actors.emulators.serial_balance.balance_process import VirtualSerialBalance as VirtualSerialBalance
    from orchestrator.runs.strategy_harness import ACTIONS as ACTIONS
    from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS as CALIBRATION_ACTIONS
    from orchestrator.runs.strategy_harness import PARAMETERS as PARAMETERS
    from orchestrator.runs.strategy_harness import SCENE as SCENE
    from orchestrator.runs.strategy_harness import THETA as THETA
    from orchestrator.runs.strategy_harness import SpillModel as SpillModel
    from orchestrator.runs.strategy_harness import StrategyHarness as StrategyHarness
    from orchestrator.runs.strategy_harness import check_strategy as check_strategy
    from orchestrator.runs.strategy_harness import failures as failures
    from orchestrator.runs.strategy_harness import outcome_of as outcome_of
    from orchestrator.runs.strategy_harness import replay as replay

_HOMES = names_for_type_checkers(__file__)

if not TYPE_CHECKING:  # else a type checker would take a misspelt name for Any
    __all__ = list(_HOMES)

    def __getattr__(name: str) -> Any:
        if _HOMES.get(name, "").startswith("actors.contract_tests.") and find_spec("pytest") is None:
            raise ImportError(f"{name} is run by pytest, which is not installed: pip install pytest")
        return import_name(__name__, name, _HOMES)


def __dir__() -> list[str]:
    return list(_HOMES)
