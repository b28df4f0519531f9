"""The controller: each control cycle runs the program, moves the arm and monitors both.

`Controller` combines robot, power, safety system, registers and programs. It opens no socket; the servers read and
write it between ticks.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from enum import IntEnum

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.commands import commands_of
from actors.emulators.ur_controller.motion.mover import ViolationError
from actors.emulators.ur_controller.registers import Registers, Signals, Watchdogs
from actors.emulators.ur_controller.robot import HOME, ControlledModel, Power, Robot, RobotMode
from actors.emulators.ur_controller.safety_system import Safety, SafetyConfiguration, SafetyMode
from actors.emulators.ur_controller.servers.primary_messages import ControllerMessage, Listener
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Program, waiting
from actors.emulators.ur_controller.urscript.translator import Translated, translate


class RuntimeState(IntEnum):
    """State of the program, as RTDE reports it."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


_POWERLESS = (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.FAULT)
"""Modes in which the arm has no power."""

MOST_SECONDARY = 10
"""Largest number of secondary programs that run in addition to the main one."""

Watcher = Callable[[], bool]
"""Called each cycle until it returns True."""


# More than 25 methods: one method for each command of the controller's interfaces.
class Controller:
    """One robot with its controller. It uses no sockets; servers read and write it between ticks.

    Args:
        model: robot model.
        frequency: control cycles per second of controller time [Hz].
        time_scale: controller seconds per wall second; only watchdogs use it.
        mode: initial power mode.
        remote: remote control is on.
        joints: initial joint positions [rad].
        configuration: safety limits; the model's own by default.

    Attributes:
        now: controller time [s].
        switches: number of switches between remote and local control.
        freedrive: the freedrive button is pressed.
    """

    def __init__(
        self,
        model: ControlledModel,
        *,
        frequency: float | None = None,
        time_scale: float = 1.0,
        mode: RobotMode = RobotMode.RUNNING,
        remote: bool = True,
        joints: Joints = HOME,
        configuration: SafetyConfiguration | None = None,
    ) -> None:
        self.model = model
        self.frequency = frequency or model.frequency
        self.dt = 1.0 / self.frequency
        self.time_scale = time_scale
        self.remote = remote
        self.switches = 0
        self.freedrive = False
        self.now = 0.0
        self.ticks = 0
        configuration = configuration or SafetyConfiguration.of(model)
        self.safety = Safety(configuration)
        self.power = Power(mode)
        self.robot = Robot(model, joints, configuration)
        self.registers = Registers()
        self.signals = Signals()
        self.runtime = RuntimeState.STOPPED
        self.program: Program | None = None
        self.secondary: list[Program] = []
        self.running: Program | None = None
        self.watchdogs = Watchdogs()
        self.watchers: list[Watcher] = []
        self.listeners: list[Listener] = []
        self.popup: str | None = None
        self.safety_popup = False
        self._resumes = False
        self._commands = commands_of(self)

    # ---- messages

    def tell(self, kind: str, text: str, line: int = 0) -> None:
        """Send a message to all listeners."""
        message = ControllerMessage(kind, text.encode("utf-8", "replace").decode("utf-8"), line, self.now)
        for listener in self.listeners:
            listener(message)

    # ---- programs

    @property
    def playing(self) -> bool:
        """Whether a program runs."""
        return self.runtime is RuntimeState.PLAYING

    def translated(self, text: str) -> Translated | ScriptError:
        """Translate a program for `start`, or return why it cannot be run; may be called in any thread."""
        try:
            return translate(text, waiting(self._commands))
        except ScriptError as error:
            return error
        except Exception as error:  # a defect of the emulator
            traceback.print_exception(error)
            return ScriptError(f"internal error of the controller: {error}")

    def upload(self, text: str) -> None:
        """Translate and start a program."""
        self.start(self.translated(text))

    def start(self, translated: Translated | ScriptError) -> None:
        """Run a program and end the current one. A program that cannot be run is refused with a message."""
        if isinstance(translated, ScriptError):
            self.tell("exception", f"compile error: {translated.text}", translated.line)
            return
        program = Program(translated, self._commands)
        if program.secondary:
            if len(self.secondary) >= MOST_SECONDARY:
                self.tell("key", f"program {program.name} not started: {MOST_SECONDARY} secondary programs run already")
                return
            self.secondary.append(program)
            return
        if not (self.power.running and self.safety.may_move):
            self.tell("key", f"program {program.name} not started: the robot is not ready")
            return
        if self.runtime in (RuntimeState.PAUSED, RuntimeState.PAUSING):
            # Observed with the manufacturer's simulator: the first upload only ends the paused program.
            self.tell("key", f"program {program.name} not started: a paused program was stopped instead")
            self.stop()
            return
        self._drop_program()
        self.robot.mover.thaw()
        self.program = program
        self.runtime = RuntimeState.PLAYING
        self.tell("key", f"program {program.name} started")

    @property
    def local(self) -> bool:
        """Whether commands over the network are refused. CB3 controllers have no local mode."""
        return self.model.remote_control and not self.remote

    def stop(self) -> None:
        """End the program; the arm stops."""
        if self.program is not None:
            self.tell("key", f"program {self.program.name} stopped")
        self._drop_program()

    def pause(self) -> bool:
        """Pause program and arm. Returns whether a program was running."""
        if not self.playing:
            return False
        self.runtime = RuntimeState.PAUSING
        self.robot.mover.freeze()
        return True

    def play(self) -> bool:
        """Resume a paused program. Returns whether that is possible."""
        held = self.program is not None and self.runtime in (RuntimeState.PAUSED, RuntimeState.PAUSING)
        if not held or not self.safety.may_move or not self.power.running:
            return False
        self.robot.mover.thaw()
        self.runtime = RuntimeState.PLAYING
        return True

    def _drop_program(self) -> None:
        self.program = None
        self.watchdogs.clear()
        self._resumes = False
        self.robot.mover.abandon()
        if self.runtime is not RuntimeState.STOPPED:
            self.runtime = RuntimeState.STOPPING

    # ---- safety

    def protective_stop(self, reason: str, code: int = 0) -> None:
        """Stop the arm and pause the program; a person has to unlock the stop.

        Args:
            reason: as a message.
            code: of the error that clients of the primary interface receive, without text, as from many controllers; 0
                for none.
        """
        self.safety.protective_stop(self.now)
        self.safety_popup = True
        self._hold()
        self._resumes = False
        self.tell("safety", f"protective stop: {reason}")
        if code:
            self.tell("error", "", code)

    def emergency_stop(self, *, system: bool = False) -> None:
        """Stop the arm, end the program, and switch the power off."""
        self.safety.emergency_stop(system=system)
        self._drop_program()
        self.robot.mover.freeze()
        self.tell("safety", "emergency stop")

    def release_emergency_stop(self) -> None:
        """Release the emergency stop button; power stays off."""
        self.safety.release_emergency_stop()
        self.tell("safety", "emergency stop released")

    def safety_fault(self) -> None:
        """Fail the safety system: stop and switch off; only a restart helps."""
        self.safety.fault = True
        self._drop_program()
        self.robot.mover.freeze()
        self.tell("safety", "fault")

    def configure_safety(self, configuration: SafetyConfiguration) -> None:
        """Apply other limits, with another checksum."""
        self.safety.configuration = configuration
        self.robot.configure(configuration)
        self.tell("key", f"safety checksum changed to {configuration.checksum}")

    def set_remote(self, active: bool) -> None:
        """Switch between remote and local control; the running program ends."""
        if self.remote != active:
            self.stop()
            self.remote = active
            self.switches += 1

    def reboot(self) -> None:
        """Reset as after a power cut: only the safety configuration and the remote switch are kept."""
        self.power_off()
        self.runtime = RuntimeState.STOPPED
        self.now = 0.0
        self.robot.forget()
        self.secondary.clear()
        self.watchers.clear()
        self.safety.restart()
        self.robot.mover.place(self.robot.mover.q)
        self.robot.mover.slider = 1.0
        for store in (self.registers.input_int, self.registers.output_int):
            store[:] = [0] * len(store)
        for values in (self.registers.input_double, self.registers.output_double):
            values[:] = [0.0] * len(values)
        self.signals.digital_out = 0

    def set_safeguard(self, active: bool) -> None:
        """Apply or release the safeguard stop. There is no reset button here, so the program resumes on release."""
        was = self.safety.safeguard
        self.safety.safeguard = active
        if active and not was:
            self._resumes = self.playing
            self._hold()
            self.tell("safety", "safeguard stop")
        elif was and not active and self._resumes:
            self._resumes = False
            self.play()

    def _hold(self) -> None:
        self.robot.mover.freeze()
        if self.playing:
            self.runtime = RuntimeState.PAUSING

    def unlock_protective_stop(self) -> str | None:
        """Unlock a protective stop. Returns why that is not possible yet, or None."""
        refusal = self.safety.unlock(self.now)
        if refusal is None:
            self.safety_popup = False
            self.tell("safety", "protective stop unlocked")
        return refusal

    def power_on(self) -> str | None:
        """Switch the power on. Returns why not, or None."""
        if self.safety.mode in _POWERLESS:
            return "Failed to execute: power on"
        self.power.on(self.now)
        return None

    def release_brakes(self) -> str | None:
        """Release the brakes. Returns why not, or None."""
        if self.safety.mode in _POWERLESS:
            return "Failed to execute: brake release"
        self.power.release_brakes(self.now)
        return None

    def restart_safety(self) -> None:
        """Restart the safety system after a fault; the power is switched off."""
        self.power_off()
        self.safety.restart()

    def power_off(self) -> None:
        """Close the brakes and end the program."""
        self._drop_program()
        self.power.off()

    # ---- time

    def tick(self) -> None:
        """Run one control cycle."""
        self.ticks += 1
        self.now += self.dt
        self.power.step(self.now)
        for watcher in list(self.watchers):
            if watcher() and watcher in self.watchers:  # its call may have cleared the list
                self.watchers.remove(watcher)
        if self.runtime is RuntimeState.PLAYING:
            due = self.watchdogs.step(self.dt / self.time_scale)
            if due is not None:
                self._trigger_watchdog(*due)
            else:
                self._run()
        self.secondary = [program for program in self.secondary if self._continues(program)]
        try:
            self.robot.step(self.now, self.dt)
        except (ViolationError, ValueError, ArithmeticError) as violation:
            # A state that cannot be computed must not cause motion: the mover keeps its last targets and brakes.
            self.robot.mover.freeze()
            if self.safety.may_move:
                self.protective_stop(str(violation))
        if self.runtime in (RuntimeState.STOPPING, RuntimeState.PAUSING) and not self._in_motion():
            self.runtime = RuntimeState.STOPPED if self.runtime is RuntimeState.STOPPING else RuntimeState.PAUSED
        if self.safety.mode in _POWERLESS and self.power.powered and not self._in_motion():
            self.power.off()

    def _trigger_watchdog(self, action: str, why: str) -> None:
        self.tell("key", why)
        if action == "pause":
            self.pause()
        else:
            self.stop()

    def _in_motion(self) -> bool:
        return any(abs(v) > 1e-6 for v in self.robot.mover.qd)

    def _run(self) -> None:
        program = self.program
        if program is not None and not self._continues(program) and self.program is program:
            self.stop()

    def _continues(self, program: Program) -> bool:
        """Run one cycle of a program; return whether it continues."""
        self.running = program
        try:
            return program.tick()
        except ScriptError as error:
            self.tell("exception", error.text, error.line)
            return False
        finally:
            self.running = None
