"""Names for authors of plug-ins: strategies, objectives, sources of vessels, and all kinds of devices.

How to write one: docs/extend/plug-ins.md.

::

    from decant.plugins import Deployment, DeploymentSettings, Quantity

A plug-in imports nothing else of Decant but `decant` and, in its tests, `decant.plugins.testing`: other modules may
change without notice. Each name is imported on first use, so `import decant.plugins` itself loads no other package.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from actors.arm.arm_geometry import Pose, RobotCell
    from actors.arm.arm_interface import (
        Arm,
        ArmFacts,
        ArmFigure,
        ArmLostError,
        ArmNotReleasedError,
        ArmPose,
        ArmRefusedError,
        ArmState,
        ArmStoppedError,
        Bar,
        PathReport,
        PlannedPour,
    )
    from actors.arm.arm_settings import ArmDiagnostics, ArmEmulator, ArmKind, ArmSettings, History
    from actors.arm.planned_pour import ExecutedMotion, MotionPath
    from actors.balance.balance_interface import BalanceDriver, ReferenceLostError, Weight
    from actors.balance.balance_settings import (
        BalanceEmulator,
        BalanceKind,
        BalanceSettings,
        SerialBalanceSettings,
    )
    from actors.balance.dialects.dialect import Dialect, LineSettings
    from actors.balance.readings import (
        Acknowledgement,
        LineError,
        OtherQuantityError,
        Reading,
        ReadingStatus,
        Reply,
        WeightMark,
    )
    from actors.balance.scale_model import Load
    from actors.balance.serial_balance import SerialBalance
    from actors.bench.pour_feasibility import plan_pour
    from actors.grippers.gripper_interface import (
        Gripper,
        GripperEmulator,
        GripperError,
        GripperSettings,
        GripperState,
    )
    from actors.interfaces import DeviceCheck, InvalidActionError, LaboratoryError
    from actors.liquid_devices import (
        Pump,
        PumpSettings,
        PumpStoppedError,
        SpillEvent,
        SpillSensor,
        SpillSensorSettings,
    )
    from actors.optimizer.questions import (
        CalibrationQuery,
        Data,
        MinimumQuery,
        PourQuery,
        RegressionQuery,
        RiskQuery,
        SimulationQuery,
        SpaceFillingQuery,
        Suggestion,
        SuggestionQuery,
    )
    from orchestrator.learning.calibration.calibration_base import THETA_MAP_RESOLUTION, Calibration, DesignSettings
    from orchestrator.learning.calibration.pointwise_calibration import DiscrepancyOverPours
    from orchestrator.learning.campaign_plan import (
        CalibrationPlan,
        CalibrationSettings,
        DeploymentPlan,
        DeploymentSettings,
        MeasuredPour,
    )
    from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION, Deployment
    from orchestrator.learning.deployment.deployment_ledger import SearchSettings
    from orchestrator.learning.deployment.objectives import Objective, Objectives
    from orchestrator.learning.requests import (
        Answered,
        Ask,
        Decision,
        Failed,
        Outcome,
        Pour,
        Poured,
        Request,
        Simulate,
        Simulated,
        Slots,
        Suggest,
        Suggested,
    )
    from orchestrator.learning.run_errors import LearningError
    from orchestrator.learning.stage_result import ResultPart, StageResult
    from orchestrator.learning.strategy import Progress, Strategy
    from orchestrator.learning.trials import OptimizerQueries, SeedStream, Trial, Trials
    from sim_engine.action import ACTION_DIMENSIONS, Action, Dimension
    from sim_engine.liquids import Liquid, SimulationParameters
    from sim_engine.outcome import Fractions, Loss, PourMeasurement, PourOutcome
    from sim_engine.resources import load_arrays, store_arrays
    from sim_engine.scene import PoseError, Scene
    from sim_engine.search_space import Axis, Space
    from sim_engine.settings.model import (
        NOT_IN_FINGERPRINT,
        SET_BY_PROGRAM,
        Choice,
        Count,
        Example,
        Name,
        Number,
        PositiveCount,
        Problems,
        Settings,
        Switch,
        Text,
    )
    from sim_engine.settings.quantity import Quantity
    from sim_engine.vessel.distance_grid import SignedDistanceGrid
    from sim_engine.vessel.shapes import ProfileShape, Shape, VesselError, VesselSpec, cylinder
    from sim_engine.vessel.vessel import Vessel, build_vessel

__all__ = [
    "ACTION_DIMENSIONS",
    "MAP_RESOLUTION",
    "NOT_IN_FINGERPRINT",
    "SET_BY_PROGRAM",
    "THETA_MAP_RESOLUTION",
    "Acknowledgement",
    "Action",
    "Answered",
    "Arm",
    "ArmDiagnostics",
    "ArmEmulator",
    "ArmFacts",
    "ArmFigure",
    "ArmKind",
    "ArmLostError",
    "ArmNotReleasedError",
    "ArmPose",
    "ArmRefusedError",
    "ArmSettings",
    "ArmState",
    "ArmStoppedError",
    "Ask",
    "Axis",
    "BalanceDriver",
    "BalanceEmulator",
    "BalanceKind",
    "BalanceSettings",
    "Bar",
    "Calibration",
    "CalibrationPlan",
    "CalibrationQuery",
    "CalibrationSettings",
    "Choice",
    "Count",
    "Data",
    "Decision",
    "Deployment",
    "DeploymentPlan",
    "DeploymentSettings",
    "DesignSettings",
    "DeviceCheck",
    "Dialect",
    "Dimension",
    "DiscrepancyOverPours",
    "Example",
    "ExecutedMotion",
    "Failed",
    "Fractions",
    "Gripper",
    "GripperEmulator",
    "GripperError",
    "GripperSettings",
    "GripperState",
    "History",
    "InvalidActionError",
    "LaboratoryError",
    "LearningError",
    "LineError",
    "LineSettings",
    "Liquid",
    "Load",
    "Loss",
    "MeasuredPour",
    "MinimumQuery",
    "MotionPath",
    "Name",
    "Number",
    "Objective",
    "Objectives",
    "OptimizerQueries",
    "OtherQuantityError",
    "Outcome",
    "PathReport",
    "PlannedPour",
    "Pose",
    "PoseError",
    "PositiveCount",
    "Pour",
    "PourMeasurement",
    "PourOutcome",
    "PourQuery",
    "Poured",
    "Problems",
    "ProfileShape",
    "Progress",
    "Pump",
    "PumpSettings",
    "PumpStoppedError",
    "Quantity",
    "Reading",
    "ReadingStatus",
    "ReferenceLostError",
    "RegressionQuery",
    "Reply",
    "Request",
    "ResultPart",
    "RiskQuery",
    "RobotCell",
    "Scene",
    "SearchSettings",
    "SeedStream",
    "SerialBalance",
    "SerialBalanceSettings",
    "Settings",
    "Shape",
    "SignedDistanceGrid",
    "Simulate",
    "Simulated",
    "SimulationParameters",
    "SimulationQuery",
    "Slots",
    "Space",
    "SpaceFillingQuery",
    "SpillEvent",
    "SpillSensor",
    "SpillSensorSettings",
    "StageResult",
    "Strategy",
    "Suggest",
    "Suggested",
    "Suggestion",
    "SuggestionQuery",
    "Switch",
    "Text",
    "Trial",
    "Trials",
    "Vessel",
    "VesselError",
    "VesselSpec",
    "Weight",
    "WeightMark",
    "build_vessel",
    "cylinder",
    "load_arrays",
    "plan_pour",
    "store_arrays",
]

_SOURCES = {
    # Settings
    "sim_engine.settings.model": (
        "NOT_IN_FINGERPRINT",
        "SET_BY_PROGRAM",
        "Choice",
        "Count",
        "Example",
        "Name",
        "Number",
        "PositiveCount",
        "Problems",
        "Settings",
        "Switch",
        "Text",
    ),
    "sim_engine.settings.quantity": ("Quantity",),
    # Pours: values that strategies, objectives and arms have in common
    "actors.interfaces": ("DeviceCheck", "InvalidActionError", "LaboratoryError"),
    "sim_engine.action": ("ACTION_DIMENSIONS", "Action", "Dimension"),
    "sim_engine.liquids": ("Liquid", "SimulationParameters"),
    "sim_engine.outcome": ("Fractions", "Loss", "PourMeasurement", "PourOutcome"),
    "sim_engine.scene": ("PoseError", "Scene"),
    "sim_engine.search_space": ("Axis", "Space"),
    # Strategies
    "actors.optimizer.questions": (
        "CalibrationQuery",
        "Data",
        "MinimumQuery",
        "PourQuery",
        "RegressionQuery",
        "RiskQuery",
        "SimulationQuery",
        "SpaceFillingQuery",
        "Suggestion",
        "SuggestionQuery",
    ),
    "orchestrator.learning.requests": (
        "Answered",
        "Ask",
        "Decision",
        "Failed",
        "Outcome",
        "Pour",
        "Poured",
        "Request",
        "Simulate",
        "Simulated",
        "Slots",
        "Suggest",
        "Suggested",
    ),
    "orchestrator.learning.run_errors": ("LearningError",),
    "orchestrator.learning.calibration.calibration_base": ("THETA_MAP_RESOLUTION", "Calibration", "DesignSettings"),
    "orchestrator.learning.calibration.pointwise_calibration": ("DiscrepancyOverPours",),
    "orchestrator.learning.campaign_plan": (
        "CalibrationPlan",
        "CalibrationSettings",
        "DeploymentPlan",
        "DeploymentSettings",
        "MeasuredPour",
    ),
    "orchestrator.learning.deployment.deployment_base": ("MAP_RESOLUTION", "Deployment"),
    "orchestrator.learning.deployment.deployment_ledger": ("SearchSettings",),
    "orchestrator.learning.stage_result": ("ResultPart", "StageResult"),
    "orchestrator.learning.strategy": ("Progress", "Strategy"),
    "orchestrator.learning.trials": ("OptimizerQueries", "SeedStream", "Trial", "Trials"),
    # Objectives
    "orchestrator.learning.deployment.objectives": ("Objective", "Objectives"),
    # Balances
    "actors.balance.balance_interface": ("BalanceDriver", "ReferenceLostError", "Weight"),
    "actors.balance.balance_settings": ("BalanceSettings", "BalanceEmulator", "BalanceKind", "SerialBalanceSettings"),
    "actors.balance.dialects.dialect": ("Dialect", "LineSettings"),
    "actors.balance.readings": (
        "Acknowledgement",
        "LineError",
        "OtherQuantityError",
        "Reading",
        "ReadingStatus",
        "Reply",
        "WeightMark",
    ),
    "actors.balance.serial_balance": ("SerialBalance",),
    "actors.balance.scale_model": ("Load",),
    # Arms
    "actors.arm.arm_geometry": ("Pose", "RobotCell"),
    "actors.arm.arm_interface": (
        "Arm",
        "ArmFacts",
        "ArmFigure",
        "ArmLostError",
        "ArmNotReleasedError",
        "ArmPose",
        "ArmRefusedError",
        "ArmState",
        "ArmStoppedError",
        "Bar",
        "PathReport",
        "PlannedPour",
    ),
    "actors.arm.arm_settings": ("ArmDiagnostics", "ArmEmulator", "ArmKind", "ArmSettings", "History"),
    "actors.arm.planned_pour": ("ExecutedMotion", "MotionPath"),
    "actors.bench.pour_feasibility": ("plan_pour",),
    # Grippers
    "actors.grippers.gripper_interface": (
        "Gripper",
        "GripperEmulator",
        "GripperError",
        "GripperSettings",
        "GripperState",
    ),
    # Pumps and spill sensors
    "actors.liquid_devices": (
        "Pump",
        "PumpSettings",
        "PumpStoppedError",
        "SpillEvent",
        "SpillSensor",
        "SpillSensorSettings",
    ),
    # Sources of vessels
    "sim_engine.resources": ("load_arrays", "store_arrays"),
    "sim_engine.vessel.distance_grid": ("SignedDistanceGrid",),
    "sim_engine.vessel.shapes": ("ProfileShape", "Shape", "VesselError", "VesselSpec", "cylinder"),
    "sim_engine.vessel.vessel": ("Vessel", "build_vessel"),
}
"""Module → the names that it provides."""

_SOURCE_OF = {name: module for module, names in _SOURCES.items() for name in names}

if not TYPE_CHECKING:  # otherwise a type checker would accept misspelt names as Any

    def __getattr__(name: str) -> Any:
        """Import a name on first use (PEP 562)."""
        if name not in _SOURCE_OF:
            raise AttributeError(f"module 'decant.plugins' has no attribute '{name}'; it has {', '.join(__all__)}")
        return getattr(import_module(_SOURCE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
