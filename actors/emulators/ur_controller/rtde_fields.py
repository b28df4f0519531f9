"""The values that clients may read and write over RTDE, and the recipes that they set up.

`output_fields` lists the readable values, `INPUT_KINDS` the writable ones. `OutputRecipe` and `InputRecipe` encode and
decode the data packages of one client.

Source of names, types and versions: the manufacturer's RTDE guide; the messages of real clients were measured. Fields
newer than the modelled software (3.15, 5.12) are not found: `collision_detection_ratio`, `time_scale_source`,
`actual_current_as_torque`, energies, accelerations of the tool and others. For `tcp_offset`, encoders and configurable
inputs and outputs the guide gives no version; they are assumed to exist since the e-Series.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from actors.arm.ur.rtde import DATA_PACKAGE, FORMATS, TEXT_MESSAGE, package
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.registers import REGISTERS
from actors.emulators.ur_controller.robot import Robot


def text_message(protocol: int, message: str, source: str, level: int) -> bytes:
    """Return a text message.

    Args:
        protocol: 1 or 2.
        message, source: text.
        level: 0 exception, 1 error, 2 warning, 3 info.
    """
    body, origin = message.encode()[:255], source.encode()[:255]
    if protocol < 2:
        return package(TEXT_MESSAGE, bytes([level]) + body)
    return package(TEXT_MESSAGE, bytes([len(body)]) + body + bytes([len(origin)]) + origin + bytes([level]))


@dataclass(frozen=True)
class Field:
    """A value that can be read.

    Attributes:
        kind: RTDE type.
        read: returns the value, a number or a sequence of the type's length.
    """

    kind: str
    read: Callable[[], Any]


class OutputRecipe:
    """The values that one client receives.

    Args:
        number: of the recipe; 0 leaves it out, as protocol 1 does.
        fields: in order.
    """

    def __init__(self, number: int, fields: Sequence[Field]) -> None:
        formats = "".join(FORMATS[field.kind][0] for field in fields)
        self._struct = struct.Struct(">HB" + ("B" if number else "") + formats)
        self._head = (self._struct.size, DATA_PACKAGE, *((number,) if number else ()))
        self._single = [FORMATS[field.kind][1] == 1 for field in fields]
        self._read = [field.read for field in fields]

    def package(self) -> bytes:
        """Return the current values as a package."""
        values = list(self._head)
        for read, single in zip(self._read, self._single, strict=True):
            if single:
                values.append(read())
            else:
                values.extend(read())
        return self._struct.pack(*values)


class InputRecipe:
    """The values that one client sends.

    Args:
        fields: names in order.
        kinds: their RTDE types.
    """

    def __init__(self, fields: Sequence[str], kinds: Sequence[str]) -> None:
        self.fields = tuple(fields)
        self._counts = [FORMATS[kind][1] for kind in kinds]
        self._struct = struct.Struct(">" + "".join(FORMATS[kind][0] for kind in kinds))

    def read(self, payload: bytes) -> dict[str, Any] | None:
        """Return the values by name; None if the number of bytes is wrong."""
        if len(payload) != self._struct.size:
            return None
        values = self._struct.unpack(payload)
        fields: dict[str, Any] = {}
        place = 0
        for name, count in zip(self.fields, self._counts, strict=True):
            fields[name] = values[place] if count == 1 else values[place : place + count]
            place += count
        return fields


_ZERO6 = (0.0,) * 6
_RUNNING, _POWER_OFF, _IDLE = 253, 239, 255
_TEMPERATURES = (31.0, 32.0, 32.0, 34.0, 35.0, 36.0)
_DEVIATION_LIMIT = 0.2
"""Deviation of a joint from its target at which a real controller stops [rad]. Plausible, not measured."""


def output_fields(controller: Controller) -> dict[str, Field]:
    """Return the readable values, by name."""
    robot, mover, power = controller.robot, controller.robot.mover, controller.power
    safety, signals, registers = controller.safety, controller.signals, controller.registers

    def joint_modes() -> tuple[int, ...]:
        return (_RUNNING if power.running else _IDLE if power.powered else _POWER_OFF,) * 6

    def status_bits() -> int:
        return int(power.powered) | (int(controller.playing) << 1) | (int(controller.freedrive) << 2)

    readers: dict[str, tuple[str, Callable[[], Any]]] = {
        "timestamp": ("DOUBLE", lambda: controller.now),
        "target_q": ("VECTOR6D", lambda: mover.q),
        "target_qd": ("VECTOR6D", lambda: mover.qd),
        "target_qdd": ("VECTOR6D", lambda: mover.qdd),
        "target_current": ("VECTOR6D", lambda: _ZERO6),
        "target_moment": ("VECTOR6D", lambda: _ZERO6),
        "actual_q": ("VECTOR6D", lambda: robot.q),
        "actual_qd": ("VECTOR6D", lambda: robot.qd),
        "actual_current": ("VECTOR6D", lambda: _ZERO6),
        "actual_moment": ("VECTOR6D", lambda: _ZERO6),
        "joint_control_output": ("VECTOR6D", lambda: _ZERO6),
        "actual_TCP_pose": ("VECTOR6D", lambda: robot.pose),
        "actual_TCP_speed": ("VECTOR6D", lambda: robot.tool_speed),
        "actual_TCP_force": ("VECTOR6D", lambda: robot.external_force),
        "target_TCP_pose": ("VECTOR6D", lambda: robot.target_pose),
        "target_TCP_speed": ("VECTOR6D", lambda: robot.target_tool_speed),
        "actual_digital_input_bits": ("UINT64", lambda: signals.digital_in),
        "joint_temperatures": ("VECTOR6D", lambda: _TEMPERATURES),
        "actual_execution_time": ("DOUBLE", lambda: 0.0),
        "robot_mode": ("INT32", lambda: power.mode),
        "joint_mode": ("VECTOR6INT32", joint_modes),
        "safety_mode": ("INT32", lambda: safety.mode),
        "actual_tool_accelerometer": ("VECTOR3D", lambda: _accelerometer(robot)),
        "speed_scaling": ("DOUBLE", lambda: mover.scaling),
        "target_speed_fraction": ("DOUBLE", lambda: mover.slider),
        "actual_momentum": ("DOUBLE", lambda: 0.0),
        "actual_main_voltage": ("DOUBLE", lambda: 48.0),
        "actual_robot_voltage": ("DOUBLE", lambda: 48.0 if power.powered else 0.0),
        "actual_robot_current": ("DOUBLE", lambda: 0.6 if power.powered else 0.0),
        "actual_joint_voltage": ("VECTOR6D", lambda: (48.0 if power.powered else 0.0,) * 6),
        "actual_digital_output_bits": ("UINT64", lambda: signals.digital_out),
        "runtime_state": ("UINT32", lambda: controller.runtime),
        "elbow_position": ("VECTOR3D", lambda: robot.kinematics.axes(robot.q)[1][2]),
        "elbow_velocity": ("VECTOR3D", lambda: robot.elbow_velocity),
        "robot_status_bits": ("UINT32", status_bits),
        "safety_status_bits": ("UINT32", lambda: safety.status_bits),
        "standard_analog_input0": ("DOUBLE", lambda: signals.analog_in[0]),
        "standard_analog_input1": ("DOUBLE", lambda: signals.analog_in[1]),
        "standard_analog_output0": ("DOUBLE", lambda: signals.analog_reading(0)),
        "standard_analog_output1": ("DOUBLE", lambda: signals.analog_reading(1)),
        "output_bit_registers0_to_31": ("UINT32", lambda: registers.output_bits & 0xFFFFFFFF),
        "output_bit_registers32_to_63": ("UINT32", lambda: registers.output_bits >> 32 & 0xFFFFFFFF),
        "payload": ("DOUBLE", lambda: robot.payload),
        "payload_cog": ("VECTOR3D", lambda: robot.cog),
        "payload_inertia": ("VECTOR6D", lambda: robot.inertia),
        "joint_position_deviation_ratio": ("DOUBLE", lambda: robot.deviation / _DEVIATION_LIMIT),
    }
    if controller.model.e_series:
        readers["ft_raw_wrench"] = ("VECTOR6D", lambda: _wrench(robot))
        readers["tcp_offset"] = ("VECTOR6D", lambda: robot.tcp)
    for i in range(REGISTERS):
        readers[f"output_int_register_{i}"] = ("INT32", _entry(registers.output_int, i))
        readers[f"output_double_register_{i}"] = ("DOUBLE", _entry(registers.output_double, i))
        readers[f"input_int_register_{i}"] = ("INT32", _entry(registers.input_int, i))
        readers[f"input_double_register_{i}"] = ("DOUBLE", _entry(registers.input_double, i))
    for i in range(64, 128):
        readers[f"output_bit_register_{i}"] = ("BOOL", _bit(lambda: registers.output_bits, i))
        readers[f"input_bit_register_{i}"] = ("BOOL", _bit(lambda: registers.input_bits, i))
    return {name: Field(kind, read) for name, (kind, read) in readers.items()}


def _entry(store: list[Any], at: int) -> Callable[[], Any]:
    return lambda: store[at]


def _bit(bits: Callable[[], int], at: int) -> Callable[[], bool]:
    return lambda: bool(bits() >> at & 1)


def _wrench(robot: Robot) -> tuple[float, ...]:
    """The external force and the payload's weight. The base's frame is an assumption: no document names one."""
    x, y, z, *torque = robot.external_force
    gx, gy, gz = (-robot.payload * g for g in robot.gravity)
    return (x + gx, y + gy, z + gz, *torque)


def _accelerometer(robot: Robot) -> tuple[float, float, float]:
    m = robot.frame[0]
    x, y, z = robot.gravity
    return (m[0] * x + m[3] * y + m[6] * z, m[1] * x + m[4] * y + m[7] * z, m[2] * x + m[5] * y + m[8] * z)


INPUT_KINDS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
    "external_force_torque": "VECTOR6D",
    **{f"input_bit_register_{i}": "BOOL" for i in range(64, 128)},
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}
"""Writable values, with their types."""

_DIGITAL = {"standard": 0, "configurable": 8, "tool": 16}


def write(controller: Controller, values: dict[str, Any]) -> None:
    """Apply the values that a client sent. Invalid values, such as NaN, are ignored."""
    registers, signals = controller.registers, controller.signals
    for name, value in values.items():
        controller.watchdogs.written(name)
        if name.startswith("input_int_register_"):
            registers.input_int[int(name[19:])] = value
        elif name.startswith("input_double_register_"):
            registers.input_double[int(name[22:])] = value
        elif name.startswith("input_bit_registers"):
            shift = 0 if name.endswith("31") else 32
            registers.input_bits = registers.input_bits & ~(0xFFFFFFFF << shift) | value << shift
        elif name.startswith("input_bit_register_"):
            bit = 1 << int(name[19:])
            registers.input_bits = registers.input_bits | bit if value else registers.input_bits & ~bit
    for group, offset in _DIGITAL.items():
        mask = values.get(f"{group}_digital_output_mask", 0)
        if mask:
            signals.set_outputs(mask, values.get(f"{group}_digital_output", 0), offset)
    fraction = values.get("speed_slider_fraction", 0.0)
    if values.get("speed_slider_mask", 0) & 1 and 0.0 <= fraction <= 1.0:
        controller.robot.mover.slider = fraction
    mask = values.get("standard_analog_output_mask", 0)
    for i in range(2):
        level = values.get(f"standard_analog_output_{i}", 0.0)
        if mask >> i & 1 and 0.0 <= level <= 1.0:
            signals.analog_out[i] = level
            signals.analog_voltage[i] = bool(values.get("standard_analog_output_type", 0) >> i & 1)
