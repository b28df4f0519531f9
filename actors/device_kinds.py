"""Decant's own kinds of arms, balances and grippers, as `pyproject.toml` registers them.

Each joins settings, which are plain values, with driver, planner, diagnostics, figure and emulator. These are imported
within the methods: this module is loaded wherever a laboratory's file is read. No other module imports it.
"""

from __future__ import annotations

import ipaddress
import json
import re
from pathlib import Path
from typing import Any, ClassVar

from actors.arm.arm_settings import ArmDiagnostics, ArmEmulator, ArmKind
from actors.arm.franka.franka_arm import FrankaRobot, FrankaSettings
from actors.arm.joint_arm_kind import JointArmKind
from actors.arm.planned_pour import MotionPath
from actors.arm.simulated_arm import APPROACH_TIME, SimulatedArm, SimulatedArmSettings
from actors.arm.ur.robot_models import MODELS, same_robot
from actors.arm.ur_settings import UrArmSettings
from actors.arm.urdf_chain import ChainArmKind
from actors.arm_geometry import RobotCell
from actors.balance.balance_settings import BalanceEmulator, BalanceKind, SerialBalanceSettings
from actors.balance.serial_port import look_at_port
from actors.balance.simulated_balance import SimulatedBalanceSettings, VirtualBalance
from actors.grippers.franka_hand import HandSettings
from actors.grippers.gripper_interface import GripperEmulator
from actors.grippers.onrobot_gripper import OnRobotSettings
from actors.grippers.robotiq_gripper import RobotiqSettings
from actors.interfaces import DeviceCheck, LaboratoryError
from sim_engine.action import Action
from sim_engine.resources import installed
from sim_engine.scene import Scene
from sim_engine.settings.model import Problems
from sim_engine.settings.plugin_registry import DISTRIBUTION, own_extras


def _emulator(name: str) -> Any:
    """The class of an emulated device.

    Raises:
        LaboratoryError: the emulators are not installed.
    """
    emulators = own_extras("decant.emulators", name)
    if name not in emulators:
        raise LaboratoryError(
            "this installation has no emulated devices (the package actors.emulators is missing); "
            "use a simulated bench, such as configs/laboratories/twin.yaml"
        )
    return emulators[name]


class SimulatedArmKind(ArmKind[SimulatedArmSettings]):
    """A simulated arm without protocol."""

    settings = SimulatedArmSettings

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        if mode == "hardware":
            problems.add("a simulated arm moves nothing; write 'mode: virtual'", "arm")
        if cell is not None:
            problems.add("a simulated arm stands nowhere; remove the section", "cell")

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmKind.driver`."""
        return SimulatedArm, (self.spec,)

    def plan(self, scene: Scene, action: Action) -> MotionPath:
        """See `ArmKind.plan`."""
        from actors.arm.pour_feasibility import plan_pour

        return MotionPath(plan_pour(scene, action), approach_time=APPROACH_TIME)


class UrArmKind(JointArmKind[UrArmSettings]):
    """A UR arm."""

    settings = UrArmSettings
    doses = emulated = True

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        arm, spec = problems.within("arm"), self.spec
        _check_address(arm, spec.address, mode)
        if arm.valid("model", "rate"):
            fastest = MODELS[spec.model].frequency
            if spec.rate > fastest:
                arm.add(f"a {spec.model} answers at most {fastest} times a second; write '{fastest} Hz'", "rate")
        if arm.valid("model", "payload") and spec.payload > (most := MODELS[spec.model].payload):
            arm.add(f"a {spec.model} carries at most {most:g} kg", "payload")
        super().check_laboratory(problems, mode=mode, cell=cell)

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmKind.driver`."""
        from actors.arm.ur.ur_driver import AcceptedArm, UrArm

        return (UrArm, (self.spec,)) if accepted is None else (AcceptedArm, (self.spec, accepted))

    def with_stored(self, folder: Path) -> UrArmSettings:
        """See `ArmKind.with_stored`: the calibration of `calibration_file`."""
        from actors.arm.ur.controller_readout import findings_of

        spec = self.spec
        if spec.calibration_file is None:
            return spec
        path = folder / spec.calibration_file
        try:
            recorded = json.loads(path.read_text(encoding="utf-8"))["readout"]
            findings = findings_of(recorded)
            state, model = findings.state, findings.model
        except OSError as error:
            raise ValueError(f"calibration_file {path}: {error.strerror}") from None
        except (ValueError, KeyError, TypeError):
            text = "is no recording of 'decant robot check --record'"
            raise ValueError(f"calibration_file {path}: {text}") from None
        if state is None or not same_robot(model, spec.model):
            kind = f"a {model}" if model else "no robot"
            raise ValueError(f"calibration_file {path}: records {kind}, and the arm is a {spec.model}")
        return spec.with_values(calibration=state.calibration)

    def start_emulator(self) -> ArmEmulator:
        """See `ArmKind.start_emulator`."""
        emulator: ArmEmulator = _emulator("ur")(self.spec)
        return emulator

    def diagnostics(self) -> ArmDiagnostics:
        """See `ArmKind.diagnostics`."""
        from actors.arm.ur.commissioning import UrDiagnostics

        return UrDiagnostics.at(self.spec)

    def readiness(self) -> DeviceCheck | None:
        """See `ArmKind.readiness`."""
        from actors.arm.ur.commissioning import readiness

        return readiness(self.spec) if self.spec.address else None


class FrankaKind(ChainArmKind[FrankaSettings]):
    """A Franka arm."""

    settings = FrankaSettings
    robot = FrankaRobot
    doses = emulated = True

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        arm = problems.within("arm")
        _check_address(arm, self.spec.address, mode)
        if not arm.valid("model"):
            return
        if mode == "virtual" and self.spec.model != "fr3":
            arm.add("the emulated Franka is an FR3; write 'fr3', or 'mode: hardware'", "model")
        super().check_laboratory(problems, mode=mode, cell=cell)

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmKind.driver`; a Franka reports no checksum of its safety settings."""
        from actors.arm.joint_driver import VelocityArm

        return VelocityArm, (self.spec, self.robot)

    def start_emulator(self) -> ArmEmulator:
        """See `ArmKind.start_emulator`."""
        emulator: ArmEmulator = _emulator("franka")(self.spec)
        return emulator

    def missing(self) -> str | None:
        """See `ArmKind.missing`."""
        modules = ["pinocchio", "franky", *(() if self.spec.address else ("franky_sim",))]
        if all(map(installed, modules)):
            return None
        extra = "franka" if self.spec.address else "franka-sim"
        return f"a Franka arm needs packages that are not installed; run: pip install '{DISTRIBUTION}[{extra}]'"


class SerialBalanceKind(BalanceKind[SerialBalanceSettings]):
    """A balance on a serial line."""

    settings = SerialBalanceSettings

    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """See `BalanceKind.driver`."""
        from actors.balance.serial_balance import SerialBalance

        return SerialBalance, (self.spec, name)

    def start_emulator(self) -> BalanceEmulator | None:
        """See `BalanceKind.start_emulator`."""
        if self.spec.virtual is None:
            return None
        emulator: BalanceEmulator = _emulator("serial")(self.spec, self.spec.virtual)
        return emulator

    def diagnostics(self, *, tare: bool) -> list[DeviceCheck]:
        """See `BalanceKind.diagnostics`; checks the port first."""
        port = look_at_port(self.spec.port)
        return [port] if port.state == "fail" else [port, *super().diagnostics(tare=tare)]


class SimulatedBalanceKind(BalanceKind[SimulatedBalanceSettings]):
    """A simulated balance without protocol."""

    settings = SimulatedBalanceSettings

    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """See `BalanceKind.driver`."""
        return VirtualBalance, (self.spec, name)


class EmulatedRobotiqSettings(RobotiqSettings):
    """A Robotiq gripper with its URCap."""

    emulated: ClassVar[bool] = True

    def start_emulator(self) -> GripperEmulator:
        """See `GripperSettings.start_emulator`."""
        emulator: GripperEmulator = _emulator("robotiq")(self)
        return emulator


class EmulatedOnRobotSettings(OnRobotSettings):
    """An OnRobot gripper with its URCap or a Compute Box."""

    emulated: ClassVar[bool] = True

    def start_emulator(self) -> GripperEmulator:
        """See `GripperSettings.start_emulator`."""
        emulator: GripperEmulator = _emulator("onrobot")(self)
        return emulator


class EmulatedHandSettings(HandSettings):
    """The Hand of a Franka arm."""

    emulated: ClassVar[bool] = True

    def start_emulator(self) -> GripperEmulator:
        """See `GripperSettings.start_emulator`."""
        emulator: GripperEmulator = _emulator("franka-hand")(self)
        return emulator


def _check_address(problems: Problems, address: str, mode: str) -> None:
    if mode != "hardware":
        if address:
            problems.add("a virtual arm has no address: remove it, or write 'mode: hardware'", "address")
    elif not address:
        text = "an arm of hardware needs its controller's 'address', for example 'address: 192.168.0.10'"
        problems.add(text, of="address")
    elif not _is_address(address):
        problems.add(
            f"{address!r} is neither an IPv4 address nor a host name; write for example '192.168.0.10', no port",
            "address",
        )


_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*\.?")


def _is_address(text: str) -> bool:
    if re.fullmatch(r"[\d.]+", text):  # a text of digits and dots can only be meant as an address
        try:
            ipaddress.IPv4Address(text)
        except ValueError:
            return False
        return True
    return _HOST.fullmatch(text) is not None
