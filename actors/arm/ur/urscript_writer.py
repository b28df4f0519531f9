"""Converts joints over time to a program for the controller, which interpolates in its own cycle.

These functions are pure.

Targets streamed from this machine would jitter with its load; a program on the controller does not. The program:

- sets tool and payload and reports the controller's values;
- waits for its start, monitors a heartbeat and checks for a stop order in every cycle;
- reports its progress.

`path_program` runs a path on its own schedule. `tilt_program` runs along a path at the speed that this machine writes
10 to 20 times a second, up to the tilt that it writes; without news it turns the cup back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from actors.arm.arm_interface import NEWS_TIMEOUT, ArmRefusedError
from actors.arm.planned_pour import FloatArray, JointPath, checked
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
    TILT_COUNTER,
    TILT_HIGHEST,
    TILT_PATIENCE,
    TILT_SPEED,
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

FIRST_NEWS_TIMEOUT = 2.0
"""Time without a command after which a dose's program turns the cup back before the first one [s]."""

END_TIMEOUT = 1.5
"""Time without a command after which the program of a dose ends, if the cup is upright [s of controller time]."""

_ALIGNING_SPEED, _ALIGNING_ACCELERATION = 0.05, 0.3


def thinned(path: JointPath, tolerance: float = THINNING) -> JointPath:
    """The path without points that lie on the line between their neighbours.

    Args:
        path: with any number of points.
        tolerance: largest change of any joint at any time [rad].
    """
    times, joints = path.times, path.joints
    indices, anchor = [0], 0
    low, high = np.full(6, -np.inf), np.full(6, np.inf)
    for i in range(1, len(times)):
        step = times[i] - times[anchor]
        slope = (joints[i] - joints[anchor]) / step
        if i > anchor + 1 and bool(np.any((slope < low) | (slope > high))):
            anchor = i - 1
            indices.append(anchor)
            step = times[i] - times[anchor]
            slope = (joints[i] - joints[anchor]) / step
            low, high = np.full(6, -np.inf), np.full(6, np.inf)
        low, high = np.maximum(low, slope - tolerance / step), np.minimum(high, slope + tolerance / step)
    indices.append(len(times) - 1)
    return JointPath(times[indices], joints[indices])


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
    points = thinned(checked(path, 6))
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


@dataclass(frozen=True)
class TiltLimits:
    """Limits of a dose's program, which it enforces whatever is written to its registers.

    Attributes:
        speed: largest speed of the tilt in both directions, and the speed of its own return [rad/s].
        acceleration: [rad/s²].
    """

    speed: float
    acceleration: float


def tilt_program(
    tilts: FloatArray, joints: FloatArray, limits: TiltLimits, settings: MotionSettings, number: int, *, cb3: bool
) -> str:
    """A program that tilts the pourer at the speed in a register, within a checked range of tilts.

    A client writes a `TiltOrder` to its inputs and changes `TILT_COUNTER`. The program stops at the order's largest
    tilt by itself. If the counter does not change for the order's patience, `NEWS_TIMEOUT` at most, the program
    turns the cup back: a tilted cup that stands still pours on. An upright cup waits for
    `END_TIMEOUT`, so that a computer that paused can pour on; then the program ends. A dose ends in the same way, by
    silence. The heartbeat's watchdog of `path_program` would stop the arm where it is, so this program
    has none. An order to stop still stops the arm at once.

    Args:
        tilts: of the checked path, increasing from upright, shape (T,) [rad].
        joints: at these tilts, linear in between, shape (T, 6) [rad]; the arm stands at the first.
        limits: of the motion.
        settings, number, cb3: see `path_program`.

    Raises:
        ArmRefusedError: there are too many points, or the path is invalid.
    """
    points = thinned(checked(JointPath(np.asarray(tilts, dtype=float) - tilts[0], joints), 6))
    if len(points.times) > MOST_POINTS:
        raise ArmRefusedError(f"the path has {len(points.times)} points; a program takes {MOST_POINTS}")
    end = float(points.times[-1])
    return "\n".join(
        [
            "def decant():",
            f"  global d_step = {'0.008' if cb3 else 'get_steptime()'}",
            "  global d_tilt = 0.0",
            "  global d_speed = 0.0",
            f"  global d_silence = {NEWS_TIMEOUT - FIRST_NEWS_TIMEOUT}",
            *_stop_function(number, settings.registers),
            "  def d_clip(x, low, high):",
            "    if x < low:",
            "      return low",
            "    elif x > high:",
            "      return high",
            "    end",
            "    return x",
            "  end",
            "  def d_joints(s):",
            *_search(points, 0, len(points.times) - 1, "    "),
            "  end",
            *_preparation(settings, number, heartbeat=False),
            f"  movej({_list(points.joints[0])}, a={_ALIGNING_ACCELERATION}, v={_ALIGNING_SPEED})",
            f"  local d_counter = read_input_float_register({settings.registers + TILT_COUNTER})",
            f"  while d_tilt > 0.0 or d_silence < {END_TIMEOUT}:",
            f"    local d_news = read_input_float_register({settings.registers + TILT_COUNTER})",
            "    if d_news != d_counter:",
            "      d_counter = d_news",
            "      d_silence = 0.0",
            "    else:",
            "      d_silence = d_silence + d_step",
            "    end",
            f"    local d_wanted = read_input_float_register({settings.registers + TILT_SPEED})",
            f"    local d_patience = read_input_float_register({settings.registers + TILT_PATIENCE})",
            f"    if d_silence >= d_clip(d_patience, 0.0, {NEWS_TIMEOUT}):",
            f"      d_wanted = -{limits.speed:.6f}",
            "    elif d_silence < 0.0:",
            "      d_wanted = 0.0",
            "    end",
            # the speed from which the arm can still stop at the order's largest tilt, within the range
            f"    local d_highest = read_input_float_register({settings.registers + TILT_HIGHEST})",
            f"    local d_left = d_clip(d_clip(d_highest, 0.0, {end:.6f}) - d_tilt, 0.0, {end:.6f})",
            f"    local d_up = sqrt({2.0 * limits.acceleration:.6f} * d_left)",
            f"    local d_down = sqrt({2.0 * limits.acceleration:.6f} * d_tilt)",
            f"    d_wanted = d_clip(d_wanted, -d_clip(d_down, 0.0, {limits.speed:.6f}), "
            f"d_clip(d_up, 0.0, {limits.speed:.6f}))",
            f"    local d_change = {limits.acceleration:.6f} * d_step",
            "    d_speed = d_clip(d_wanted, d_speed - d_change, d_speed + d_change)",
            f"    d_tilt = d_clip(d_tilt + d_speed * d_step, 0.0, {end:.6f})",
            "    if d_tilt < 0.0002 and d_wanted <= 0.0:",
            "      d_tilt = 0.0",
            "      d_speed = 0.0",
            "    end",
            "    d_stop()",
            f"    write_output_float_register({CLOCK}, d_tilt)",
            f"    servoj(d_joints(d_tilt), 0, 0, d_step, {LOOKAHEAD}, {GAIN:g})",
            "  end",
            "  local d_held = 0.0",
            f"  while d_held < {SETTLING}:",
            "    d_held = d_held + d_step",
            "    d_stop()",
            f"    servoj(d_joints(0.0), 0, 0, d_step, {LOOKAHEAD}, {GAIN:g})",
            "  end",
            f"  stopj({STOP_DECELERATION:g})",
            f"  write_output_integer_register({STATUS}, {DONE})",
            "end",
            "",
        ]
    )


def _search(points: JointPath, first: int, last: int, indent: str) -> list[str]:
    """Lines that return the joints at the parameter s, by bisection over the points."""
    if last - first == 1:
        start, width = points.times[first], points.times[last] - points.times[first]
        a, b = points.joints[first], points.joints[last]
        terms = ", ".join(f"{u:.7f} + f * {v - u:.7f}" for u, v in zip(a, b, strict=True))
        return [f"{indent}local f = (s - {start:.7f}) / {width:.7f}", f"{indent}return [{terms}]"]
    middle = (first + last) // 2
    return [
        f"{indent}if s < {points.times[middle]:.7f}:",
        *_search(points, first, middle, indent + "  "),
        f"{indent}else:",
        *_search(points, middle, last, indent + "  "),
        f"{indent}end",
    ]


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


def _preparation(settings: MotionSettings, number: int, *, heartbeat: bool = True) -> list[str]:
    """Lines that set tool and payload and report them, and that end the program without a heartbeat.

    The number is written last, so that a reader of it sees the rest.
    """
    watched = f"input_int_register_{settings.registers + HEARTBEAT}"
    return [
        *([f'  rtde_set_watchdog("{watched}", {SLOWEST_HEARTBEAT:.1f}, "stop")'] if heartbeat else []),
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
