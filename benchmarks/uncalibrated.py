"""Measure how far pours of real-looking benches lie from an uncalibrated simulator, as a shift of their stream.

    python benchmarks/uncalibrated.py [--actions 2] [--seeds 2] [--json]

The benches are the ten worlds of configs/studies/benches.yaml, drawn before any of them was run. In each of the study's
scenes, actions all over its space are poured once in every world, and simulated with the campaign's own θ. The shift is
Φ⁻¹(r) of the pour less that of its simulations (`sim_engine.prediction_band`). `UNCALIBRATED` there is the root mean
square.
"""

from __future__ import annotations

import argparse
import math
import statistics
from contextlib import closing
from typing import Any

import numpy as np
from machine import ROOT, describe, say, show

from orchestrator.study.study_file import load_study
from sim_engine.prediction_band import shift_of
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator


def main() -> None:
    """Pour, simulate, and print the shifts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--actions", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    study = load_study(ROOT / "configs" / "studies" / "benches.yaml")
    calibration, deployment = study.base.calibration, study.deployments[0].plan
    assert calibration is not None
    spaces = [(scene, calibration.actions) for scene in calibration.poured]
    spaces += [(scene, deployment.actions) for scene in deployment.scenes]
    shifts: list[float] = []
    differences: list[float] = []
    theta, places = study.base.parameters, np.random.default_rng(15)

    with closing(PourSimulator()) as simulator:

        def spillage(task: PourTask) -> float | None:
            outcome = simulator.simulate(task).outcome
            return None if outcome.invalid is not None else outcome.fractions.spillage

        for scene, actions in spaces:
            for _ in range(options.actions):
                values = {axis.name: axis.decode(float(places.random())) for axis in actions.axes}
                action = scene.action(values)
                simulated = [
                    r for s in range(options.seeds) if (r := spillage(PourTask(scene, action, theta, s))) is not None
                ]
                for number, level in enumerate(study.levels):
                    error = level.bench.pose_error.error
                    poured = spillage(PourTask(scene, action, level.bench.theta, 100 + number, pose_error=error))
                    if poured is None or not simulated:
                        continue
                    expected = statistics.fmean(shift_of(r, theta.particles) for r in simulated)
                    shifts.append(shift_of(poured, theta.particles) - expected)
                    differences.append(poured - statistics.fmean(simulated))
                rms = math.sqrt(statistics.fmean(z * z for z in shifts))
                say(f"{scene.name} {action.display(*actions.names)}: {len(shifts)} pours, shift {rms:.2f}")
    results: dict[str, Any] = {
        "pours": len(shifts),
        "shift": math.sqrt(statistics.fmean(z * z for z in shifts)),
        "shifts": [round(z, 3) for z in sorted(shifts)],
        "mean_difference": statistics.fmean(map(abs, differences)),
    }
    show(results | {"machine": describe()}, as_json=options.json)


if __name__ == "__main__":
    main()
