"""Primary (30001, 30011) and secondary (30002, 30012) interface: sends the robot's state at 10 Hz, accepts programs.

Ports 30011 and 30012 are read-only. On the others, a connection that was opened in local control stays read-only.
"""

from __future__ import annotations

from actors.arm.ur.robot_models import TWISTS
from actors.emulators.ur_controller.controller import Controller, RuntimeState
from actors.emulators.ur_controller.safety_system import SafetyMode
from actors.emulators.ur_controller.servers import primary_messages as primary
from actors.emulators.ur_controller.servers.connections import Connections, ScriptConnection
from actors.emulators.ur_controller.servers.primary_messages import ControllerMessage

PORTS = {30001: (True, True), 30002: (False, True), 30011: (True, False), 30012: (False, False)}
"""For each port whether messages are sent, and whether programs are accepted."""

INTERVAL = 0.1
"""Time between two states [s]."""

_READ_ONLY = 210


class PrimaryServer:
    """All clients of these ports.

    Args:
        controller: source of the state.
        connections: all connections, including the clients of these ports.
    """

    def __init__(self, controller: Controller, connections: Connections) -> None:
        self.controller = controller
        self.connections = connections
        self._due = 0.0
        controller.listeners.append(self._on_message)

    def publish(self, clock: float) -> None:
        """Send a state if it is due; see `RtdeServer.publish`."""
        if self._due - INTERVAL <= clock < self._due - 1e-9:  # also due after the clock was set back
            return
        self._due = clock + INTERVAL
        clients = [c for c in self.connections.open if isinstance(c, PrimaryConnection)]
        if clients:
            state = self.state()
            for client in clients:
                client.send(state)

    def state(self, *packages: bytes) -> bytes:
        """Return the robot's current state."""
        c, robot = self.controller, self.controller.robot
        power, mode = c.power, c.safety.mode
        return primary.robot_state(
            primary.PrimaryState(
                time=c.now,
                powered=power.powered,
                emergency=mode in (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP),
                protective=mode is SafetyMode.PROTECTIVE_STOP,
                running=c.playing,
                paused=c.runtime in (RuntimeState.PAUSED, RuntimeState.PAUSING),
                robot_mode=power.mode,
                safety_mode=mode,
                joint_mode=253 if power.running else 255 if power.powered else 239,
                slider=robot.mover.slider,
                scaling=robot.mover.scaling,
                q=robot.q,
                target_q=robot.mover.q,
                qd=robot.qd,
                currents=(0.0,) * 6,
                pose=robot.pose,
                tcp=robot.tcp,
                digital_in=c.signals.digital_in,
                digital_out=c.signals.digital_out,
                analog_in=c.signals.analog_in,
                analog_out=[c.signals.analog_reading(i) for i in range(2)],
                analog_voltage=c.signals.analog_voltage,
                checksum=int(c.safety.checksum, 16),
            ),
            *packages,
        )

    def first(self) -> bytes:
        """Return the first bytes for a new client: version, and a state with the data that rarely changes."""
        c, m = self.controller, self.controller.model
        limits = c.safety.configuration
        configuration = primary.configuration_data(
            limits.joint_ranges, limits.joint_speeds, m.a, m.d, TWISTS, m.primary_type
        )
        return primary.version_message(c.now, m.version) + self.state(
            primary.kinematics_info(m.parameters), configuration
        )

    def _on_message(self, message: ControllerMessage) -> None:
        clients = [c for c in self.connections.open if isinstance(c, PrimaryConnection) and c.messages]
        if not clients:
            return
        now, text = message.time, message.text
        match message.kind:
            case "text":
                data = primary.text_message(now, text)
            case "exception":
                data = primary.exception_message(now, message.line, text)
            case "safety":
                data = primary.safety_message(now, self.controller.safety.mode)
                data += primary.key_message(now, "safety", text)
            case "error":
                data = primary.error_message(now, message.line, text)
            case "popup":
                data = primary.popup_message(now, text)
            case _:
                data = primary.key_message(now, message.kind, text)
        for client in clients:
            client.send(data)


class PrimaryConnection(ScriptConnection):
    """One client.

    Args:
        server: its server.
        messages: whether it receives messages in addition to states.
        writable: whether programs are accepted.
    """

    def __init__(self, server: PrimaryServer, *, messages: bool, writable: bool) -> None:
        super().__init__(server.connections)
        self._server = server
        self.messages = messages
        self._writable = writable

    @property
    def privileged(self) -> bool:
        """See `Connection.privileged`."""
        return self._writable and super().privileged

    def greet(self) -> None:
        """See `Connection.greet`."""
        self.send(self._server.first())

    def refuse(self) -> None:
        """See `ScriptConnection.refuse`."""
        super().refuse()
        self.send(primary.error_message(self.controller.now, _READ_ONLY, "socket is read-only"))
