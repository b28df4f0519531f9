"""`robot_api`: a controller with PolyScope X: its Robot API instead of the dashboard, the other interfaces as they
are.
"""

from __future__ import annotations

import socket

import pytest

from actors.arm.arm_interface import ArmRefusedError, ArmStoppedError
from actors.arm.ur.commissioning import UrDiagnostics
from actors.arm.ur.dashboard import DashboardError, stop_program
from tests.actors.arm.ur.conftest import Call, Makers, Rig
from tests.support.ur_pours import HOME, START, pour_path

pytestmark = pytest.mark.realtime


@pytest.fixture
def rig(make_rig: Makers) -> Rig:
    return make_rig(pour_path(hold=8.0), polyscope_x=True)


def test_an_arm_pours_is_stopped_and_recovers_without_a_dashboard(rig: Rig) -> None:
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((rig.controller.address, 29999), timeout=5.0)
    facts = rig.arm.facts()
    assert (facts.model, facts.serial, facts.version) == ("UR10", "20205300456", "10.14.0")
    assert facts.remote
    rig.fault("protective_stop", joint=5, above=START[5] + 0.6)
    pouring = rig.pouring()
    with pytest.raises(ArmStoppedError, match="protective stop during tilt") as caught:
        pouring.result()
    assert caught.value.kind == "protective stop"
    rig.await_rest()
    rig.arm.release()
    begun = rig.now
    rig.fault("protective_stop")
    assert rig.arm.recover() == "protective stop unlocked"
    assert rig.now - begun > 5.0  # the five seconds are kept here, too
    rig.arm.release()
    rig.arm.untilt()
    rig.arm.release()
    rig.arm.retreat(rig.path)
    assert rig.joints == pytest.approx(HOME, abs=1e-3)


def test_the_primary_interface_stops_the_program_where_the_robot_api_is_out_of_reach(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("actors.arm.ur.robot_api.PORTS", (1, 2))
    pouring = rig.pouring()
    rig.await_tilt(0.2)
    stop_program(rig.controller.address)
    with pytest.raises(ArmStoppedError):
        pouring.result()
    rig.await_rest()
    rig.controller.close()
    with pytest.raises(DashboardError, match=r"no Robot API.*:30001"):
        stop_program(rig.controller.address)


@pytest.mark.slow
def test_power_and_brakes_are_switched_over_the_robot_api(rig: Rig) -> None:
    rig.fault("emergency_stop")
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="still pressed"):
        rig.arm.recover()
    rig.fault("release_emergency_stop")
    rig.arm.release()
    assert rig.arm.recover() == "switched on, brakes released"
    rig.arm.hands_in()


@pytest.mark.slow
def test_local_control_is_named(rig: Rig) -> None:
    rig.fault("remote", active=False)
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="local control; switch it to remote control"):
        rig.arm.move_to_start(rig.path)


@pytest.mark.slow
def test_the_check_reads_the_robot_api_and_says_that_it_was_never_tried(rig: Rig) -> None:
    found = UrDiagnostics.at(rig.arm._spec)
    checks = {check.name: check for check in found.checks(None, accept="", virtual=True)}
    (port,) = (check for check in checks.values() if check.found.startswith("Robot API of PolyScope X: open"))
    assert port.state == "ok"
    assert "port 29999" not in checks
    assert (checks["software"].state, checks["software"].found) == ("warn", "PolyScope X 10.14.0")
    assert [
        name for name in ("model", "remote control", "arm", "safety", "program") if checks[name].state != "ok"
    ] == []
    rig.fault("protective_stop")
    again = {check.name: check for check in UrDiagnostics.at(rig.arm._spec).checks(None, accept="", virtual=True)}
    assert again["safety"].state == "fail"
    assert Call(rig.arm.facts).result().problem == "protective stop is in force"
