"""SPlisHSPlasH 2.19 on the standard pour: DFSPH with volume maps, the fastest CPU solver we know of.

    python benchmarks/peer_splishsplash.py JOB.json RESULT.npz

Runs in the peer's own environment (`peer.py` creates it and writes the job), so it imports only numpy and the peer.
Settings: support 2d, CFL factor 1 (0.4 d per step), steps up to 4 ms, density error 0.1 %, viscosity 1e-6 m²/s, no
surface tension. Spilled particles are frozen, because their speed would otherwise determine the time step.

Source: Bender & Koschier 2015 (DFSPH); Bender et al. 2019 (volume maps).
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pysplishsplash as sph

DFSPH, VOLUME_MAPS = 4, 2
FIRST_STEP, LONGEST_STEP = 5e-4, 4e-3
MAP_RESOLUTION = [40, 40, 40]
FIXED = sph.ParticleState(2)
"""State of a particle that stays in place; the binding names only two of the states."""


def scene(job: dict[str, Any]) -> dict[str, Any]:
    """Return the scene file's content. The liquid is a block of 2 × 2 × N/4, then moved to the job's positions."""
    d = 2.0 * job["radius"]

    def body(mesh: str, at: list[float], moves: bool) -> dict[str, Any]:
        return {
            "geometryFile": mesh,
            "translation": at,
            "rotationAxis": [0, 1, 0],
            "rotationAngle": 0,
            "scale": [1, 1, 1],
            "isDynamic": False,
            "isAnimated": moves,
            "isWall": False,
            "mapInvert": False,
            "mapResolution": MAP_RESOLUTION,
            "samplingMode": 0,
        }

    return {
        "Configuration": {
            "particleRadius": job["radius"],
            "simulationMethod": DFSPH,
            "boundaryHandlingMethod": VOLUME_MAPS,
            "gravitation": [0, 0, -9.81],
            "timeStepSize": FIRST_STEP,
            "cflMethod": 1,
            "cflFactor": 1.0,
            "cflMinTimeStepSize": 1e-5,
            "cflMaxTimeStepSize": LONGEST_STEP,
            "enableZSort": True,
            "stopAt": -1.0,
            "DFSPH": {
                "maxError": 0.1,
                "maxErrorV": 0.1,
                "minIterations": 2,
                "maxIterations": 100,
                "enableDivergenceSolver": True,
            },
        },
        "Materials": [
            {
                "id": "Fluid",
                "density0": 1000,
                "viscosityMethod": 1,
                "surfaceTensionMethod": 0,
                "Standard viscosity": {"viscosity": 1e-6, "viscosityBoundary": 0.0},
            }
        ],
        "FluidBlocks": [
            {"denseMode": 0, "start": [0, 0, 0], "end": [(job["particles"] // 4 + 1) * d, 3 * d, 3 * d], "id": "Fluid"}
        ],
        "RigidBodies": [
            body(job["pourer_mesh"], job["pivot"], True),
            body(job["receiver_mesh"], job["receiver_at"], False),
        ],
    }


class Run:
    """The peer's simulation with observations between its steps; their time is not counted."""

    def __init__(self, job: dict[str, Any], folder: Path) -> None:
        self.job = job
        path = folder / "scene.json"
        path.write_text(json.dumps(scene(job)), encoding="utf-8")
        self.base = sph.Exec.SimulatorBase()
        self.base.init(useGui=False, sceneFile=str(path), useCache=False, outputDir=str(folder), initialPause=False)
        self.base.initSimulation()
        self.simulation, self.clock = sph.Simulation.getCurrent(), sph.TimeManager.getCurrent()
        self.liquid = self.simulation.getFluidModel(0)
        if self.liquid.numActiveParticles() != job["particles"]:
            raise SystemExit(f"{self.liquid.numActiveParticles()} particles instead of {job['particles']}")
        for i, x in enumerate(np.load(job["positions"]).astype(float).tolist()):
            self.liquid.setPosition(i, x)
            self.liquid.setPosition0(i, x)
        self.pourer: Any = None
        self.begun = self.looked = 0.0
        self.steps = self.iterations = 0
        self.next_frame = 0.0
        self.times: list[float] = []
        self.frames: list[Any] = []

    def positions(self) -> Any:
        """Return the positions (N, 3) in the solver's current order [m]."""
        count = self.liquid.numActiveParticles()
        return np.array(self.liquid.getFieldBuffer("position"), copy=False)[:count, :3]

    def look(self) -> None:
        """Turn the pourer, freeze spilled particles and store frames, after every step."""
        entered = time.process_time()
        now = self.clock.getTime()
        if self.pourer is None:  # the first step is set-up: volume maps and first neighbour lists
            self.begun = entered
            bodies = (
                self.simulation.getBoundaryModel(i).getRigidBodyObject()
                for i in range(self.simulation.numberOfBoundaryModels())
            )
            (self.pourer,) = (body for body in bodies if body.isAnimated())
        else:
            self.steps += 1
            self.iterations += self.simulation.getTimeStep().getNumIterations()
        rate = sum(rate for begin, end, rate in self.job["turns"] if begin <= now < end)
        self.pourer.setAngularVelocity([0.0, rate, 0.0])
        self.pourer.animate()
        if now >= self.next_frame:
            self.next_frame += self.job["frame_every"]
            self.times.append(now)
            self.frames.append(self.positions().copy())
            for i in np.flatnonzero(self.frames[-1][:, 2] < self.job["freeze_below"]).tolist():
                self.liquid.setParticleState(i, FIXED)
                self.liquid.setVelocity(i, [0, 0, 0])
                self.liquid.setAcceleration(i, [0, 0, 0])
        self.looked += time.process_time() - entered

    def to_the_end(self) -> float:
        """Run to the end; return the CPU seconds of all steps except the first."""
        self.base.setTimeStepCB(self.look)
        self.base.setValueFloat(self.base.STOP_AT, self.job["end_time"])
        self.base.runSimulation()
        cpu_s = time.process_time() - self.begun - self.looked
        self.times.append(self.clock.getTime())
        self.frames.append(self.positions().copy())
        return cpu_s


def main(job_file: str, result_file: str) -> None:
    """Run the job, write the result."""
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        run = Run(job, Path(folder))
        cpu_s = run.to_the_end()
    np.savez(
        result_file,
        cpu_s=cpu_s,
        steps=run.steps,
        iterations=run.iterations,
        times=np.array(run.times),
        frames=np.array(run.frames, dtype=np.float32),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
