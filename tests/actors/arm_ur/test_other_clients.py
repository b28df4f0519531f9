"""Other clients on the same controller: a fieldbus, a gripper, a ROS driver, and another program that pours."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from actors.arm.arm_interface import ArmRefusedError
from actors.arm.ur import rtde
from actors.emulators.ur_controller.rtde_fields import INPUT_KINDS

from .conftest import Makers, Rig

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


@pytest.mark.realtime
def test_an_arm_pours_while_another_client_holds_the_fieldbus_and_all_outputs(unconnected: Rig) -> None:
    rig = unconnected
    for _ in claim(rig.controller.address, RESERVED + OUTPUTS):
        rig.arm.connect()
        rig.to_start()
        rig.arm.release()
        assert rig.arm.execute(rig.path).completed


@pytest.mark.realtime
def test_an_input_that_another_client_writes_is_named(unconnected: Rig) -> None:
    rig = unconnected
    for _ in claim(rig.controller.address, ["input_int_register_44"]):
        with pytest.raises(ArmRefusedError, match=r"another client writes input_int_register_44.*'registers'"):
            rig.arm.connect()
    rig.arm.connect()


@pytest.mark.realtime
def test_other_inputs_can_be_chosen(make_rig: Makers) -> None:
    rig = make_rig(connect=False, registers=30)
    for _ in claim(rig.controller.address, [f"input_int_register_{n}" for n in (29, 33, 43, 44, 45)]):
        rig.arm.connect()
        rig.to_start()
