"""Clients of a controller's RTDE that are not Decant's, each in a process of its own: `python -m ... NAME ADDRESS`.

They write and read until their standard input is closed. Then they print the number of their cycles, and whether the
controller sent back what they had written.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

Cycle = Callable[[int], bool]
"""One exchange with its number; whether the controller has taken the previous values."""


def ur_rtde(address: str) -> Cycle:
    """The interfaces of ur_rtde for inputs, outputs and states.

    It claims registers 18 to 23, all outputs and the slider.
    """
    from rtde_io import RTDEIOInterface  # type: ignore[import-not-found]
    from rtde_receive import RTDEReceiveInterface  # type: ignore[import-not-found]

    inputs, state = RTDEIOInterface(address), RTDEReceiveInterface(address, 125.0)

    def cycle(number: int) -> bool:
        inputs.setStandardDigitalOut(1, number % 20 < 10)
        inputs.setInputIntRegister(19, number)
        inputs.setInputDoubleRegister(20, 0.5 * number)
        time.sleep(0.008)  # the client's cycle, 125 Hz
        return bool(state.isConnected()) and len(state.getActualQ()) == 6

    return cycle


def makers(address: str) -> Cycle:
    """The manufacturer's Python client, as the package urpy contains it, in the loop of its control example."""
    from urpy.rtde import rtde  # type: ignore[import-not-found]

    client = rtde.RTDE(address)
    client.connect()
    client.get_controller_version()
    assert client.send_output_setup(["timestamp", "actual_q", "input_int_register_0"], frequency=125)
    setpoint = client.send_input_setup([f"input_double_register_{k}" for k in range(6)], ["DOUBLE"] * 6)
    watchdog = client.send_input_setup(["input_int_register_0"], ["INT32"])
    assert client.send_start()
    for k in range(6):
        setattr(setpoint, f"input_double_register_{k}", 0.0)

    def cycle(number: int) -> bool:
        state = client.receive()
        setpoint.input_double_register_0 = float(number)
        watchdog.input_int_register_0 = number
        client.send(setpoint)
        client.send(watchdog)
        return number < 50 or state.input_int_register_0 > number - 50

    return cycle


def main() -> None:
    """Exchange values until standard input is closed."""
    cycle = {"ur_rtde": ur_rtde, "makers": makers}[sys.argv[1]](sys.argv[2])
    closed = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), closed.set()), daemon=True).start()
    number, taken = 0, True
    print("ready", flush=True)
    while not closed.is_set():
        number += 1
        taken = cycle(number) and taken
    print(number, "taken" if taken else "lost", flush=True)


if __name__ == "__main__":
    main()
