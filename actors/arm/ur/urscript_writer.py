"""Converts joints over time to a program for the controller, which interpolates in its own cycle.

These functions are pure.

Targets streamed from this machine would jitter with its load; a program on the controller does not. The program:

- sets tool and payload and reports the controller's values;
- waits for its start, monitors a heartbeat and checks for a stop order in every cycle;
- reports its progress.
"""

from __future__ import annotations

import numpy as np

from actors.arm.arm_interface import ArmRefusedError
from actors.arm.planned_pour import FloatArray, JointPath
from actors.arm.ur.worker_messages import (
    CLOCK,
    DONE,
    GO,
    HEARTBEAT,
    NUMBER,
    READY,
    RUNNING,
    SLOWEST_HEARTBEAT,
    STATUS,
    STOP_ORDER,
    STOPPED,
    TOOL,
    MotionSettings,
)

LOOKAHEAD, GAIN = 0.03, 300.0
"""Settings of servoj: the shortest lookahead that the manual allows [s]; the usual stiffness."""

STOP_DECELERATION = 6.0
"""Deceleration of a stop by order [rad/s²]."""

SETTLING = 0.3
"""Time for which the last target is held: ten times the lookahead [s]."""

THINNING = 1e-5
"""Points within this distance of the line between others are left out [rad]: a hundredth of a millimetre at 1 m."""

MOST_POINTS = 1_800

_ALIGNING_SPEED, _ALIGNING_ACCELERATION = 0.05, 0.3


def thinned(path: JointPath, tolerance: float = THINNING) -> JointPath:
    """The path without points that lie on the line between their neighbours.

    Args:
        path: with any number of points.
        tolerance: largest change of any joint at any time [rad].
    """
    times, joints = path.times, path.joints
    kept, anchor = [0], 0
    low, high = np.full(6, -np.inf), np.full(6, np.inf)
    for i in range(1, len(times)):
        step = times[i] - times[anchor]
        slope = (joints[i] - joints[anchor]) / step
        if i > anchor + 1 and bool(np.any((slope < low) | (slope > high))):
            anchor = i - 1
            kept.append(anchor)
            step = times[i] - times[anchor]
            slope = (joints[i] - joints[anchor]) / step
            low, high = np.full(6, -np.inf), np.full(6, np.inf)
        low, high = np.maximum(low, slope - tolerance / step), np.minimum(high, slope + tolerance / step)
    kept.append(len(times) - 1)
    return JointPath(times[kept], joints[kept])


def checked(path: JointPath) -> JointPath:
    """Check that a program can be made from a path. Returns the path.

    Raises:
        ArmRefusedError: its shape, its times or its numbers are invalid.
    """
    times, joints = np.asarray(path.times, dtype=float), np.asarray(path.joints, dtype=float)
    if times.ndim != 1 or len(times) < 2 or joints.shape != (len(times), 6):
        raise ArmRefusedError(
            f"a path has two or more times and six joints for each, not {times.shape} and {joints.shape}"
        )
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(joints))):
        raise ArmRefusedError("a path must be made of finite numbers")
    if times[0] != 0.0 or np.any(np.diff(times) <= 0.0):
        raise ArmRefusedError("a path's times must begin at 0 and increase")
    return JointPath(times, joints)


def path_program(path: JointPath, settings: MotionSettings, number: int, *, cb3: bool) -> str:
    """A program that moves the arm along a path.

    Args:
        path: complete; the arm stands at its first point.
        settings: tool and payload, which the program sets first.
        number: of the motion, which the program reports and reads from its orders.
        cb3: the controller is of the older generation, which does not report its cycle time.

    Raises:
        ArmRefusedError: there are too many points, or the path is invalid.
    """
    points = thinned(checked(path))
    if len(points.times) > MOST_POINTS:
        raise ArmRefusedError(f"the path has {len(points.times)} points; a program takes {MOST_POINTS}")
    legs = [f"  d_leg({t:.6f}, {_list(q)})" for t, q in zip(points.times[1:], points.joints[1:], strict=True)]
    return "\n".join(
        [
            "def decant():",
            f"  global d_step = {'0.008' if cb3 else 'get_steptime()'}",
            "  global d_now = 0.0",
            "  global d_t = 0.0",
            f"  global d_q = {_list(points.joints[0])}",
            *_stop_function(number, settings.registers),
            "  def d_servo(q):",
            "    d_stop()",
            f"    write_output_float_register({CLOCK}, d_now)",
            f"    servoj(q, 0, 0, d_step, {LOOKAHEAD}, {GAIN:g})",
            "  end",
            "  def d_leg(t, q):",
            "    while d_now + d_step <= t + 0.000001:",
            "      d_now = d_now + d_step",
            "      local f = (d_now - d_t) / (t - d_t)",
            "      local g = 1.0 - f",
            f"      d_servo([{', '.join(f'g * d_q[{k}] + f * q[{k}]' for k in range(6))}])",
            "    end",
            "    d_t = t",
            "    d_q = q",
            "  end",
            *_preparation(settings, number),
            f"  movej({_list(points.joints[0])}, a={_ALIGNING_ACCELERATION}, v={_ALIGNING_SPEED})",
            *legs,
            "  local d_held = 0.0",
            f"  while d_held < {SETTLING}:",
            "    d_held = d_held + d_step",
            "    d_servo(d_q)",
            "  end",
            f"  stopj({STOP_DECELERATION:g})",
            f"  write_output_integer_register({STATUS}, {DONE})",
            "end",
            "",
        ]
    )


def _stop_function(number: int, registers: int) -> list[str]:
    return [
        "  def d_stop():",
        f"    if read_input_integer_register({registers + STOP_ORDER}) == {number}:",
        f"      write_output_integer_register({STATUS}, {STOPPED})",
        f"      stopj({STOP_DECELERATION:g})",
        "      halt",
        "    end",
        "  end",
    ]


def _preparation(settings: MotionSettings, number: int) -> list[str]:
    """Lines that set tool and payload and report them.

    The number is written last, so that a reader of it sees the rest.
    """
    return [
        f'  rtde_set_watchdog("input_int_register_{settings.registers + HEARTBEAT}", {SLOWEST_HEARTBEAT:.1f}, "stop")',
        f"  set_tcp(p{_list(settings.tool)})",
        f"  set_payload({settings.payload:.4f}, {_list(settings.centre)})",
        "  sync()",
        "  local d_tool = get_tcp_offset()",
        *(f"  write_output_float_register({TOOL + k}, d_tool[{k}])" for k in range(6)),
        f"  write_output_float_register({CLOCK}, 0.0)",
        f"  write_output_integer_register({STATUS}, {READY})",
        f"  write_output_integer_register({NUMBER}, {number})",
        f"  while read_input_integer_register({settings.registers + GO}) != {number}:",
        "    d_stop()",
        "    sync()",
        "  end",
        f"  write_output_integer_register({STATUS}, {RUNNING})",
    ]


def _list(values: tuple[float, ...] | FloatArray) -> str:
    return "[" + ", ".join(f"{float(v):.7f}" for v in values) + "]"
