"""`pour_procedure`: a program that was stopped for longer than its virtual controller remembers: what was poured
then is not known.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

from actors.emulators.ur_controller.robot import HISTORY_TIME
from actors.runtime.child_process import child_environment

PACE = 15.0

PROGRAM = f"""
import asyncio
from actors.laboratory import InProcessLaboratory
from actors.interfaces import LaboratoryError
from tests.support.wired_bench import ACTION, SCENE, Trickle, wired_spec

def look(progress):
    if progress.checkpoint == "tilt" and (progress.tilt or 0.0) > 0.1:
        print("tilts", flush=True)

async def play():
    spec = wired_spec(pace={PACE}, hurried=True)
    async with InProcessLaboratory(spec, Trickle, pours=True) as laboratory:
        slowly = ACTION.with_values(angular_velocity=0.4, return_velocity=0.4)
        for seed in (5, 6):
            action = slowly if seed == 5 else ACTION
            try:
                watch = look if seed == 5 else None
                measured = await laboratory.bench.pour(SCENE, action, seed=seed, progress=watch)
                print("outcome", measured, flush=True)
            except LaboratoryError as error:
                print("outcome", type(error).__name__, error, flush=True)

asyncio.run(play())
"""


@pytest.mark.slow
@pytest.mark.realtime
def test_a_pour_whose_motion_was_forgotten_is_unknown_and_the_next_one_is_poured():
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, env=child_environment()
    )
    assert program.stdout is not None
    try:
        for line in program.stdout:
            if line.startswith("tilts"):
                break
        program.send_signal(signal.SIGSTOP)  # the arm's own process goes on, and completes the pour
        time.sleep((HISTORY_TIME + 15.0) / PACE)  # the pour and its settling, of which the stopped program sees nothing
        program.send_signal(signal.SIGCONT)
        outcomes = [line for line in program.stdout if line.startswith("outcome")]
    finally:
        program.kill()
        program.wait()
    assert outcomes[0].startswith("outcome UnknownPourError the virtual bench can't tell"), outcomes[0]
    assert "are forgotten by the controller" in outcomes[0]
    assert "PourMeasurement" in outcomes[1]
