"""`simulated_arm`: the arm of numbers: scaled time, what it reads back, and a stop that does not queue behind the
motion.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace

import numpy as np
import pytest

from actors.arm.arm_device import DeviceArm
from actors.arm.arm_interface import ArmLostError, ArmNotReleasedError, ArmStoppedError
from actors.arm.arm_settings import ArmDiagnostics, SafetyRecord
from actors.arm.planned_pour import MotionPath
from actors.arm.pour_feasibility import plan_pour
from actors.arm.simulated_arm import POSITION_NOISE, Grip, SimulatedArm, SimulatedArmSettings
from actors.contract_tests.arm_contract import ArmBench, ArmContract
from actors.device_kinds import SimulatedArmKind
from actors.runtime.remote_object import LocalDevice, RayDevice
from tests.support.waiting import PATIENCE


@pytest.fixture
def path(scene, action):
    return MotionPath(plan_pour(scene, action))


@pytest.fixture
def motion(path):
    return path.motion


def released(scale=0.0):
    arm = SimulatedArm(SimulatedArmSettings(time_scale=scale))
    arm.release()
    return arm


@pytest.mark.realtime
def test_arm_reads_back_the_motion_it_was_given_up_to_its_repeatability(path, motion):
    executed = released().execute(path)
    assert executed.completed
    assert executed.times[-1] == pytest.approx(motion.duration)
    difference = executed.poses - motion.sample(executed.times)
    assert np.abs(difference[:, :3]).max() < 6 * POSITION_NOISE
    assert np.abs(difference[:, :3]).max() > 0.0
    assert np.abs(difference[:, 3:]).max() < 1e-12


@pytest.mark.realtime
def test_a_slow_arm_takes_longer_over_the_tilt_and_reaches_the_same_angle(path, motion):
    arm = released()
    arm.grip(Grip(speed_factor=0.8))
    executed = arm.execute(path)
    tilted = motion.phases[0].end
    assert executed.times[-1] == pytest.approx(motion.duration + tilted / 0.8 - tilted)
    tilts = executed.motion.tilt(executed.times)
    assert tilts.max() == pytest.approx(np.deg2rad(100.0), abs=1e-6)
    assert np.interp(tilted, executed.times, tilts) < np.deg2rad(90.0)


@pytest.mark.realtime
def test_same_grip_reads_back_the_same_bits_at_any_pace_and_after_other_pours(path):
    fresh, used = released(), released(40.0)
    used.execute(path)
    for arm in (fresh, used):
        arm.grip(Grip(1.03, (5, 3)))
    a, b = fresh.execute(path), used.execute(path)
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.times, b.times)


@pytest.mark.realtime
@pytest.mark.parametrize("scale", [10.0, 40.0])
def test_motion_takes_its_duration_over_the_time_scale(path, motion, scale):
    arm = released(scale)
    started = time.monotonic()
    arm.execute(path)
    assert motion.duration / scale <= time.monotonic() - started + 1e-3


@pytest.fixture(params=["thread", pytest.param("process", marks=pytest.mark.ray)])
def make_arm(request):
    if request.param == "process":
        request.getfixturevalue("ray_running")
        return lambda spec: DeviceArm(RayDevice("arm", SimulatedArm, spec), spec)
    return lambda spec: DeviceArm(LocalDevice("arm", lambda: SimulatedArm(spec)), spec)


@pytest.mark.realtime
async def test_stop_ends_a_motion_under_way_and_holds_until_released(make_arm, path, motion):
    arm = make_arm(SimulatedArmSettings(time_scale=0.2))
    await arm.release()
    pouring = asyncio.create_task(arm.execute(path, lambda state: None))
    async with asyncio.timeout(PATIENCE):
        while not (await arm.state()).moving or (await arm.state()).time < 0.1:
            await asyncio.sleep(0.02)
    await arm.stop()
    with pytest.raises(ArmStoppedError) as stopped:
        await pouring
    with pytest.raises(ArmNotReleasedError, match="release"):
        await arm.execute(path, lambda state: None)
    await arm.release()
    going = asyncio.create_task(arm.move_to_start(path))
    while not (moving := await arm.state()).moving:
        await asyncio.sleep(0.02)
    await arm.stop()
    with pytest.raises(ArmStoppedError, match="during approach"):
        await going
    await arm.device.close()
    executed = stopped.value.executed
    assert not executed.completed
    assert 0.05 < executed.times[-1] < 1.5 < motion.duration
    assert moving.moving
    assert moving.phase == "approach"


@pytest.mark.realtime
async def test_progress_follows_the_tilt_through_the_phases(make_arm, path, motion):
    seen = []
    arm = make_arm(SimulatedArmSettings(time_scale=2.0))
    await arm.release()
    await arm.execute(path, seen.append)
    await arm.device.close()
    moving = [state for state in seen if state.moving]
    assert len(moving) >= 5
    assert [s.fraction for s in moving] == sorted(s.fraction for s in moving)
    assert list(dict.fromkeys(s.phase for s in moving)) == ["tilt", "hold", "return"]
    for state in moving:
        assert state.tilt == pytest.approx(float(motion.tilt(np.array([state.time]))[0]), abs=1e-6)


class Unreachable(SimulatedArm):
    def connect(self):
        raise ArmLostError("nobody answers at 192.168.0.10")


class UnreachableKind(SimulatedArmKind):
    def driver(self, accepted):
        return Unreachable, (self.spec,)


@pytest.mark.realtime
def test_any_arm_can_be_looked_at_and_one_that_does_not_answer_says_so():
    (there,) = SimulatedArmKind(SimulatedArmSettings()).diagnostics().checks(None, accept="", virtual=True)
    assert (there.state, there.found) == ("ok", "simulated")
    (lost,) = UnreachableKind(SimulatedArmSettings()).diagnostics().checks(None, accept="", virtual=True)
    assert (lost.state, lost.found) == ("fail", "nobody answers at 192.168.0.10")


@pytest.mark.realtime
def test_safety_settings_that_nobody_has_accepted_fail_on_hardware():
    look = ArmDiagnostics(checksum="AB", serial="7", model="arm")
    record = SafetyRecord("AB", "7", "arm", "1", "2026-01-01", "Ada")
    states = [look.checks(r, accept="accept it", virtual=False)[-1].state for r in (None, record)]
    assert states == ["fail", "ok"]
    other = look.checks(replace(record, serial="8"), accept="accept it", virtual=False)[-1]
    assert other.state == "fail"
    assert "accept it" in other.advice


class TestArmOfNumbers(ArmContract):
    @pytest.fixture
    def bench(self, path):
        arm = SimulatedArm(SimulatedArmSettings(time_scale=2.0))
        yield ArmBench(arm, path, 2.0, jog=("z", 0.005, 0.02), disturb=lambda: arm.grip(Grip(speed_factor=0.7)))
        arm.close()
