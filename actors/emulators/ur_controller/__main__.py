"""`python -m actors.emulators.ur_controller`: one virtual controller, until it is interrupted or its parent ends."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from dataclasses import replace
from math import radians
from pathlib import Path

from actors.emulators.ur_controller.control_clock import Host, until_orphaned
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.fault_injection import FaultServer
from actors.emulators.ur_controller.robot import HOME, MODELS, X_SOFTWARE, RobotMode, calibrated
from actors.emulators.ur_controller.safety_system import SafetyConfiguration
from actors.runtime.bench_clock import SharedClock

_STATES = {"running": RobotMode.RUNNING, "idle": RobotMode.IDLE, "off": RobotMode.POWER_OFF}


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="python -m actors.emulators.ur_controller", description=__doc__)
    parser.add_argument("--address", default="127.0.0.2", help="loopback address of all ports (default %(default)s)")
    parser.add_argument("--model", choices=sorted(MODELS), default="ur10e")
    parser.add_argument("--polyscope-x", action="store_true", help="software 10.14, with a Robot API, no dashboard")
    parser.add_argument("--calibrated", action="store_true", help="a robot that differs from nominal by millimetres")
    parser.add_argument("--time-scale", type=float, default=1.0, help="controller seconds per wall second")
    parser.add_argument("--frequency", type=float, help="control cycles per controller second; the model's by default")
    parser.add_argument("--state", choices=sorted(_STATES), default="running", help="power, to begin with")
    parser.add_argument("--joints", help="six joint positions to begin with [deg], separated by commas")
    parser.add_argument("--local", action="store_true", help="begin in local control: programs are ignored")
    parser.add_argument("--fault-port", type=int, default=0, help="port for faults; any free one by default")
    parser.add_argument("--clock", type=Path, help="file of the clock that the devices of a bench share")
    parser.add_argument("--parent", type=int, help="end when this process does, or when standard input ends")
    chosen = parser.parse_args(given)
    given_joints: str | None = chosen.joints
    if not chosen.address.startswith("127."):
        parser.error(
            f"--address {chosen.address}: only loopback addresses (127.x.y.z); nobody outside is to reach this"
        )
    if chosen.polyscope_x and not MODELS[chosen.model].e_series:
        parser.error(f"--polyscope-x: a {chosen.model} has a CB3 controller, which does not run it")
    if not 0.0 < chosen.time_scale <= 1000.0:
        parser.error(f"--time-scale {chosen.time_scale:g}: 0 < scale ≤ 1000")
    if chosen.frequency is not None and not 10.0 <= chosen.frequency <= 1000.0:
        parser.error(f"--frequency {chosen.frequency:g}: 10 … 1000 Hz")
    chosen.joints = HOME
    if given_joints is not None:
        try:
            a, b, c, d, e, f = (radians(float(degrees_text)) for degrees_text in given_joints.split(","))
            chosen.joints = (a, b, c, d, e, f)
        except ValueError:
            parser.error(f"--joints {given_joints}: six numbers [deg], separated by commas")
        beyond = SafetyConfiguration.of(MODELS[chosen.model]).joints_violation(chosen.joints)
        if beyond is not None:
            parser.error(f"--joints {given_joints}: {beyond}")
    return chosen


async def serve(chosen: argparse.Namespace) -> None:
    """Open all ports, print one line of JSON when ready, and run until the end."""
    model = MODELS[chosen.model]
    if chosen.polyscope_x:
        model = replace(model, version=X_SOFTWARE)
    controller = Controller(
        calibrated(model) if chosen.calibrated else model,
        frequency=chosen.frequency,
        time_scale=chosen.time_scale,
        mode=_STATES[chosen.state],
        remote=not chosen.local,
        joints=chosen.joints,
    )
    clock = None if chosen.clock is None else SharedClock(chosen.clock)
    host = Host(controller, chosen.address, clock)
    await host.open()
    faults = FaultServer(host)
    fault_port = await faults.open(chosen.fault_port)
    host.start()
    ready = {"ready": True, "address": chosen.address, "model": chosen.model, "fault_port": fault_port}
    print(json.dumps(ready), flush=True)
    if chosen.parent is not None:
        await until_orphaned(chosen.parent)
        if chosen.clock is not None:
            SharedClock.remove(chosen.clock)
    else:
        await asyncio.Event().wait()


def main() -> int:
    """Run until the end. Returns the exit status."""
    chosen = arguments()
    try:
        asyncio.run(serve(chosen))
    except KeyboardInterrupt:
        pass
    except OSError as error:
        print(f"virtual controller at {chosen.address}: {error}; is another one running there?", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
