"""Measure how well the arm follows a pour and how soon it stops: driver, client library and virtual controller.

    python benchmarks/arm.py [--speeds 10 20 40 80 120] [--stop-speeds 20 60 120] [--stops 5] [--json]

The benchmark runs in real time, each model at its own control rate. A pour tilts about its lip for up to six seconds,
holds and returns. Planned joint positions are compared with the recorded ones after removing the best constant lag. A
stop is requested in mid-tilt; both the driver's clock and the controller's history record when the arm stood still.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import threading
import time
from typing import Any

import numpy as np
from machine import describe, say, show

from actors.arm.arm_geometry import ArmLimits, Box, Centre, JointAngles, Point, Pose, RobotCell
from actors.arm.arm_interface import ArmStoppedError
from actors.arm.planned_pour import PourPath
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur.ur_driver import UrArm
from actors.arm.ur.urscript_writer import STOP_DECELERATION
from actors.arm.ur_settings import UrArmSettings
from actors.emulators.ur_controller import VirtualController
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.motion import plan_motion
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel

ADDRESS = "127.9.8.7"
CYCLES = {"ur10e": 500.0, "ur10": 125.0}
"""Control cycles of each model [Hz]."""

POURER = build_vessel(cylinder("cup", inner_radius=0.040, inner_height=0.100))
RECEIVER = build_vessel(cylinder("receiver", inner_radius=0.045, inner_height=0.090))

SPEC = UrArmSettings(
    model="ur10e",
    limits=ArmLimits(
        box=Box(low=Point.of(0.2, -0.7, 0.0), high=Point.of(1.1, 0.5, 1.0)),
        joint_speed=170 * DEG,
        tilt_speed=155 * DEG,
        clearance=3e-3,
    ),
    cell=RobotCell(receiver=Point.of(0.75, 0.0, 0.06), direction=90 * DEG),
    home=JointAngles.of(-14 * DEG, -91 * DEG, -115 * DEG, -154 * DEG, -104 * DEG, 0.0),
    tool=Pose(z=0.17),
    grip=Pose(y=-0.06, rx=-90 * DEG),
    payload=0.9,
    payload_centre=Centre.of(0.0, 0.0, 0.08),
    upright_speed=60 * DEG,
    warning_time=0.0,
)
"""The gripper holds the cup from its side, so that the last joint tilts it. `upright_speed` is high because no operator
is near."""

HIGHEST_TILT = 110.0
"""Largest tilt of a pour [deg]."""


def pour(spec: UrArmSettings, speed: float) -> PourPath:
    """Return a pour at a tilting speed [deg/s] that tilts for up to six seconds."""
    angle = min(HIGHEST_TILT, 6.0 * speed)
    action = Action(
        angular_velocity=speed * DEG,
        x_offset=0.098,
        height=0.1,
        max_angle=angle * DEG,
        angular_acceleration=600 * DEG,
        hold_time=0.3,
        return_velocity=speed * DEG,
    )
    scene = Scene("bench", POURER.spec, RECEIVER.spec, Liquid(mass=0.2))
    return plan_path(plan_motion(scene, action, POURER, RECEIVER), spec, POURER, RECEIVER)


def follow(arm: UrArm, spec: UrArmSettings, speed: float) -> dict[str, Any]:
    """Run one pour and return its tracking errors."""
    path = pour(spec, speed)
    arm.release()
    arm.move_to_start(path)
    executed = arm.execute(path)
    arm.retreat(path)
    t = executed.tracking
    return {
        "speed_deg_s": speed,
        "rms_deg": round(t["rms_angle"] / DEG, 4),
        "max_deg": round(t["max_angle"] / DEG, 4),
        "rms_tool_mm": round(1e3 * t["rms_tool"], 3),
        "max_tool_mm": round(1e3 * t["max_tool"], 3),
        "lag_ms": round(1e3 * t["lag"], 1),
        "rate_hz": round(len(executed.times) / float(executed.times[-1]), 1),
        "longest_gap_ms": round(1e3 * t["longest_gap"], 1),
    }


def stop(arm: UrArm, controller: VirtualController, path: PourPath, share: float) -> dict[str, float]:
    """Stop once in mid-tilt, after a share of the tilt; return the delays on both clocks [s]."""
    arm.release()
    arm.move_to_start(path)
    pouring = threading.Thread(target=_stopped, args=(arm, path))
    pouring.start()
    when = share * path.phases[0][2]
    while arm.state().time < when:
        time.sleep(0.002)
    asked = controller.fault("state")["time"]
    took = arm.stop()
    pouring.join()
    kept = controller.fault("history", since=asked)
    times, joints = np.array(kept["times"]), np.array(kept["joints"])
    moving = times[np.abs(joints - joints[-1]).max(axis=1) > 1e-4]
    speeds = np.abs(np.diff(joints, axis=0)).max(axis=1) / np.diff(times)
    answered = arm.last_stop.answered if arm.last_stop is not None else None
    arm.release()
    arm.untilt()
    arm.release()
    arm.retreat(path)
    return {
        "driver": took,
        "controller": float(moving[-1]) - asked if len(moving) else 0.0,
        "answered": took if answered is None else answered,
        "braking": float(speeds[0]) / STOP_DECELERATION,
    }


def _stopped(arm: UrArm, path: PourPath) -> None:
    with contextlib.suppress(ArmStoppedError):
        arm.execute(path)


def stops(arm: UrArm, controller: VirtualController, spec: UrArmSettings, speed: float, count: int) -> dict[str, Any]:
    """Stop several times at a tilting speed [deg/s]."""
    path = pour(spec, speed)
    seen = [stop(arm, controller, path, 0.35 + 0.4 * k / count) for k in range(count)]
    row: dict[str, Any] = {"speed_deg_s": speed, "stops": count}
    for name in ("driver", "controller", "answered", "braking"):
        values = [1e3 * one[name] for one in seen]
        row[f"{name}_median_ms"], row[f"{name}_max_ms"] = round(statistics.median(values)), round(max(values))
    return row


def measure(model: str, speeds: list[float], stop_speeds: list[float], count: int) -> dict[str, Any]:
    """Measure one model."""
    with VirtualController.start(ADDRESS, model, 1.0, CYCLES[model], joints=SPEC.home.angles) as controller:
        spec = SPEC.with_values(model=model, address=ADDRESS)
        arm = UrArm(spec)
        try:
            arm.connect()
            pours = []
            for speed in speeds:
                pours.append(follow(arm, spec, speed))
                say(f"{model}, {speed:g} deg/s: {pours[-1]}")
            stopped = []
            for speed in stop_speeds:
                stopped.append(stops(arm, controller, spec, speed, count))
                say(f"{model}, stops at {speed:g} deg/s: {stopped[-1]}")
            timing = controller.fault("state")["timing"]
        finally:
            arm.close()
    return {
        "model": model,
        "cycles_hz": CYCLES[model],
        "pours": pours,
        "stops": stopped,
        "controller": {k: round(timing[k], 3) for k in ("cpu", "late", "worst", "dropped")},
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speeds", type=float, nargs="*", default=[10.0, 20.0, 40.0, 80.0, 120.0], help="[deg/s]")
    parser.add_argument("--stop-speeds", type=float, nargs="*", default=[20.0, 60.0, 120.0], help="[deg/s]")
    parser.add_argument("--stops", type=int, default=5, help="stops at each of these speeds")
    parser.add_argument("--models", nargs="+", choices=sorted(CYCLES), default=["ur10e", "ur10"])
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    if any(not 1.0 <= speed <= 150.0 for speed in (*options.speeds, *options.stop_speeds)):
        raise SystemExit("--speeds, --stop-speeds: 1 … 150 deg/s")
    if options.stops < 1:
        raise SystemExit("--stops: one or more")
    arms = [measure(model, options.speeds, options.stop_speeds, options.stops) for model in options.models]
    machine = describe()
    if options.json:
        show({"arms": arms, "machine": machine}, True)
        return
    for arm in arms:
        print(f"\n{arm['model']}, {arm['cycles_hz']:g} Hz; controller process {arm['controller']}")
        for rows in (arm["pours"], arm["stops"]):
            if rows:
                print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
            for row in rows:
                print("| " + " | ".join(map(str, row.values())) + " |")
    print()
    show(machine, False)


if __name__ == "__main__":
    main()
