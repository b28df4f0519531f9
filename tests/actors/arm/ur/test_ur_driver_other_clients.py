"""`ur_driver`: other clients on the same controller: a fieldbus, a gripper, a ROS driver, and another program that
pours.
"""

from __future__ import annotations

import contextlib
import importlib.util
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from actors.arm.arm_interface import ArmRefusedError
from actors.arm.ur import rtde
from actors.emulators.ur_controller.rtde_fields import INPUT_KINDS
from actors.runtime.child_process import child_environment
from tests.actors.arm.ur.conftest import Call, Makers, Rig
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[4]

OUTPUTS = [name for name in INPUT_KINDS if "output" in name or "slider" in name]
RESERVED = [f"input_{kind}_register_{n}" for kind in ("int", "double") for n in range(24)]


@pytest.fixture
def unconnected(make_rig: Makers) -> Rig:
    return make_rig(connect=False)


def claim(address: str, names: list[str]) -> Iterator[None]:
    with socket.create_connection((address, rtde.PORT), timeout=5.0) as connection:
        requests = rtde.Requests(connection)
        assert requests.ask(rtde.REQUEST_PROTOCOL_VERSION, b"\0\2") == b"\1"
        for name in names:
            answer = requests.ask(rtde.SETUP_INPUTS, name.encode())
            assert rtde.names(answer[1:]) == [INPUT_KINDS[name]]
        yield


@pytest.mark.slow
@pytest.mark.realtime
def test_an_arm_pours_while_another_client_holds_the_fieldbus_and_all_outputs(unconnected: Rig) -> None:
    rig = unconnected
    for _ in claim(rig.controller.address, RESERVED + OUTPUTS):
        rig.arm.connect()
        rig.to_start()
        rig.arm.release()
        assert rig.arm.execute(rig.path).completed


@pytest.mark.slow
@pytest.mark.realtime
def test_an_input_that_another_client_writes_is_named(unconnected: Rig) -> None:
    rig = unconnected
    for _ in claim(rig.controller.address, ["input_int_register_44"]):
        with pytest.raises(ArmRefusedError, match=r"another client writes input_int_register_44.*'registers'"):
            rig.arm.connect()
    rig.arm.connect()


@pytest.mark.slow
@pytest.mark.realtime
def test_other_inputs_can_be_chosen(make_rig: Makers) -> None:
    rig = make_rig(connect=False, registers=30)
    for _ in claim(rig.controller.address, [f"input_int_register_{n}" for n in (29, 33, 43, 44, 45)]):
        rig.arm.connect()
        rig.to_start()


@contextlib.contextmanager
def other_client(name: str, address: str) -> Iterator[list[str]]:
    """A client in a process of its own; on leaving, its number of cycles and 'taken' if its values arrived."""
    if name == "makers" and importlib.util.find_spec("urpy") is None:
        pytest.skip("the manufacturer's client, of the package urpy, is not installed")
    program = [sys.executable, "-m", "tests.support.other_clients", name, address]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    found: list[str] = []
    with subprocess.Popen(program, env=child_environment(), cwd=ROOT, **pipes) as child:  # type: ignore[call-overload]
        try:
            assert child.stdout.readline() == "ready\n"
            yield found
            out, _ = child.communicate(timeout=PATIENCE)
            found += out.split()
        finally:
            child.kill()


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", [pytest.param("ur_rtde", marks=pytest.mark.ur_rtde), "makers"])
def test_a_client_of_other_makers_exchanges_values_while_the_arm_pours(unconnected: Rig, name: str) -> None:
    rig = unconnected
    with other_client(name, rig.controller.address) as found:
        rig.arm.connect()
        rig.to_start()
        rig.arm.release()
        executed = rig.arm.execute(rig.path)
    assert executed.completed
    assert executed.tracking["slider"] == 1.0
    cycles, taken = found
    assert int(cycles) > 10
    assert taken == "taken"


@pytest.mark.slow
@pytest.mark.realtime
def test_a_client_that_speaks_no_protocol_does_not_disturb_a_pour(unconnected: Rig) -> None:
    rig = unconnected
    with socket.create_connection((rig.controller.address, rtde.PORT), timeout=5.0) as flood:
        rig.arm.connect()
        rig.to_start()
        rig.arm.release()
        pouring = Call(rig.arm.execute, rig.path)
        rig.await_that(lambda: rig.arm.state().moving, "motion")
        flood.sendall(b"\0\0\0 no package of any protocol" * 50)
    assert pouring.result().completed
