"""Names for authors of plug-ins: strategies, objectives, sources of vessels, and all kinds of devices.

How to write one: docs/extend/plug-ins.md.

::

    from decant.plugins import Deployment, DeploymentSettings, Quantity

A plug-in imports nothing else of Decant but `decant` and, in its tests, `decant.plugins.testing`: other modules may
change without notice. Each name is imported on first use, so `import decant.plugins` itself loads no other package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from decant.lazy_names import import_name, names_for_type_checkers

if TYPE_CHECKING:
    from actors.arm.arm_interface import Arm as Arm
    from actors.arm.arm_interface import ArmFacts as ArmFacts
    from actors.arm.arm_interface import ArmFigure as ArmFigure
    from actors.arm.arm_interface import ArmLostError as ArmLostError
    from actors.arm.arm_interface import ArmNotReleasedError as ArmNotReleasedError
    from actors.arm.arm_interface import ArmPose as ArmPose
    from actors.arm.arm_interface import ArmRefusedError as ArmRefusedError
    from actors.arm.arm_interface import ArmState as ArmState
    from actors.arm.arm_interface import ArmStoppedError as ArmStoppedError
    from actors.arm.arm_interface import Bar as Bar
    from actors.arm.arm_interface import PathReport as PathReport
    from actors.arm.arm_interface import PlannedPour as PlannedPour
    from actors.arm.arm_settings import ArmDiagnostics as ArmDiagnostics
    from actors.arm.arm_settings import ArmEmulator as ArmEmulator
    from actors.arm.arm_settings import ArmKind as ArmKind
    from actors.arm.arm_settings import ArmSettings as ArmSettings
    from actors.arm.arm_settings import History as History
    from actors.arm.joint_driver import JointArm as JointArm
    from actors.arm.joint_driver import JointReading as JointReading
    from actors.arm.joint_driver import JointRobot as JointRobot
    from actors.arm.joint_driver import VelocityArm as VelocityArm
    from actors.arm.joint_driver import VelocityRobot as VelocityRobot
    from actors.arm.planned_pour import ExecutedMotion as ExecutedMotion
    from actors.arm.planned_pour import JointPath as JointPath
    from actors.arm.planned_pour import MotionPath as MotionPath
    from actors.arm.pour_feasibility import plan_pour as plan_pour
    from actors.arm.urdf_chain import ChainArmKind as ChainArmKind
    from actors.arm.urdf_chain import ChainArmSettings as ChainArmSettings
    from actors.arm_geometry import Pose as Pose
    from actors.arm_geometry import RobotCell as RobotCell
    from actors.balance.balance_interface import BalanceDriver as BalanceDriver
    from actors.balance.balance_interface import ReferenceLostError as ReferenceLostError
    from actors.balance.balance_interface import Weight as Weight
    from actors.balance.balance_settings import BalanceEmulator as BalanceEmulator
    from actors.balance.balance_settings import BalanceKind as BalanceKind
    from actors.balance.balance_settings import BalanceSettings as BalanceSettings
    from actors.balance.balance_settings import SerialBalanceSettings as SerialBalanceSettings
    from actors.balance.dialects.dialect import Dialect as Dialect
    from actors.balance.dialects.dialect import LineSettings as LineSettings
    from actors.balance.readings import Acknowledgement as Acknowledgement
    from actors.balance.readings import LineError as LineError
    from actors.balance.readings import OtherQuantityError as OtherQuantityError
    from actors.balance.readings import Reading as Reading
    from actors.balance.readings import ReadingStatus as ReadingStatus
    from actors.balance.readings import Reply as Reply
    from actors.balance.readings import WeightMark as WeightMark
    from actors.balance.scale_model import Load as Load
    from actors.balance.serial_balance import SerialBalance as SerialBalance
    from actors.grippers.gripper_interface import Gripper as Gripper
    from actors.grippers.gripper_interface import GripperEmulator as GripperEmulator
    from actors.grippers.gripper_interface import GripperError as GripperError
    from actors.grippers.gripper_interface import GripperSettings as GripperSettings
    from actors.grippers.gripper_interface import GripperState as GripperState
    from actors.interfaces import DeviceCheck as DeviceCheck
    from actors.interfaces import InvalidActionError as InvalidActionError
    from actors.interfaces import LaboratoryError as LaboratoryError
    from actors.liquid_devices import Pump as Pump
    from actors.liquid_devices import PumpSettings as PumpSettings
    from actors.liquid_devices import PumpStoppedError as PumpStoppedError
    from actors.liquid_devices import SpillEvent as SpillEvent
    from actors.liquid_devices import SpillSensor as SpillSensor
    from actors.liquid_devices import SpillSensorSettings as SpillSensorSettings
    from actors.optimizer.questions import CalibrationQuery as CalibrationQuery
    from actors.optimizer.questions import Data as Data
    from actors.optimizer.questions import MinimumQuery as MinimumQuery
    from actors.optimizer.questions import PourQuery as PourQuery
    from actors.optimizer.questions import RegressionQuery as RegressionQuery
    from actors.optimizer.questions import SpaceFillingQuery as SpaceFillingQuery
    from actors.optimizer.questions import Suggestion as Suggestion
    from actors.optimizer.questions import SuggestionQuery as SuggestionQuery
    from orchestrator.learning.calibration.calibration_base import THETA_MAP_RESOLUTION as THETA_MAP_RESOLUTION
    from orchestrator.learning.calibration.calibration_base import Calibration as Calibration
    from orchestrator.learning.calibration.calibration_base import DesignSettings as DesignSettings
    from orchestrator.learning.calibration.pointwise_calibration import DiscrepancyOverPours as DiscrepancyOverPours
    from orchestrator.learning.campaign_plan import CalibrationPlan as CalibrationPlan
    from orchestrator.learning.campaign_plan import CalibrationSettings as CalibrationSettings
    from orchestrator.learning.campaign_plan import DeploymentPlan as DeploymentPlan
    from orchestrator.learning.campaign_plan import DeploymentSettings as DeploymentSettings
    from orchestrator.learning.campaign_plan import MeasuredPour as MeasuredPour
    from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION as MAP_RESOLUTION
    from orchestrator.learning.deployment.deployment_base import Deployment as Deployment
    from orchestrator.learning.deployment.deployment_ledger import SearchSettings as SearchSettings
    from orchestrator.learning.deployment.objectives import Objective as Objective
    from orchestrator.learning.requests import Decision as Decision
    from orchestrator.learning.requests import Failed as Failed
    from orchestrator.learning.requests import Outcome as Outcome
    from orchestrator.learning.requests import Pour as Pour
    from orchestrator.learning.requests import Poured as Poured
    from orchestrator.learning.requests import Request as Request
    from orchestrator.learning.requests import Simulate as Simulate
    from orchestrator.learning.requests import Simulated as Simulated
    from orchestrator.learning.requests import Slots as Slots
    from orchestrator.learning.requests import Suggest as Suggest
    from orchestrator.learning.requests import Suggested as Suggested
    from orchestrator.learning.run_errors import LearningError as LearningError
    from orchestrator.learning.stage_result import ResultPart as ResultPart
    from orchestrator.learning.stage_result import StageResult as StageResult
    from orchestrator.learning.strategy import Progress as Progress
    from orchestrator.learning.strategy import Strategy as Strategy
    from orchestrator.learning.trials import OptimizerQueries as OptimizerQueries
    from orchestrator.learning.trials import SeedStream as SeedStream
    from orchestrator.learning.trials import Trial as Trial
    from orchestrator.learning.trials import Trials as Trials
    from sim_engine.action import ACTION_DIMENSIONS as ACTION_DIMENSIONS
    from sim_engine.action import Action as Action
    from sim_engine.action import Dimension as Dimension
    from sim_engine.liquids import Liquid as Liquid
    from sim_engine.liquids import SimulationParameters as SimulationParameters
    from sim_engine.outcome import Fractions as Fractions
    from sim_engine.outcome import Loss as Loss
    from sim_engine.outcome import PourMeasurement as PourMeasurement
    from sim_engine.outcome import PourOutcome as PourOutcome
    from sim_engine.resources import load_arrays as load_arrays
    from sim_engine.resources import store_arrays as store_arrays
    from sim_engine.scene import PoseError as PoseError
    from sim_engine.scene import Scene as Scene
    from sim_engine.search_space import Axis as Axis
    from sim_engine.search_space import Space as Space
    from sim_engine.settings.model import NOT_IN_FINGERPRINT as NOT_IN_FINGERPRINT
    from sim_engine.settings.model import SET_BY_PROGRAM as SET_BY_PROGRAM
    from sim_engine.settings.model import Choice as Choice
    from sim_engine.settings.model import Count as Count
    from sim_engine.settings.model import Example as Example
    from sim_engine.settings.model import Name as Name
    from sim_engine.settings.model import Number as Number
    from sim_engine.settings.model import PositiveCount as PositiveCount
    from sim_engine.settings.model import Problems as Problems
    from sim_engine.settings.model import Settings as Settings
    from sim_engine.settings.model import Switch as Switch
    from sim_engine.settings.model import Text as Text
    from sim_engine.settings.quantity import Quantity as Quantity
    from sim_engine.vessel.distance_grid import SignedDistanceGrid as SignedDistanceGrid
    from sim_engine.vessel.shapes import ProfileShape as ProfileShape
    from sim_engine.vessel.shapes import Shape as Shape
    from sim_engine.vessel.shapes import VesselError as VesselError
    from sim_engine.vessel.shapes import VesselSpec as VesselSpec
    from sim_engine.vessel.shapes import cylinder as cylinder
    from sim_engine.vessel.vessel import Vessel as Vessel
    from sim_engine.vessel.vessel import build_vessel as build_vessel

_HOMES = names_for_type_checkers(__file__)

if not TYPE_CHECKING:  # else a type checker would take a misspelt name for Any
    __all__ = list(_HOMES)

    def __getattr__(name: str) -> Any:
        return import_name(__name__, name, _HOMES)


def __dir__() -> list[str]:
    return list(_HOMES)
