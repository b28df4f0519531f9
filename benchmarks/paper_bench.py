"""What each difference of the bench 'moderate' of the paper's study contributes to the uncalibrated error.

    python benchmarks/paper_bench.py

Thirteen of the calibration's actions are simulated with two seeds: with all of the bench's values, with the defaults,
and with one group of the bench's values at a time. Prints the mean |difference| from the bench in points. It takes
two minutes.

Limitation: errors that scatter from pour to pour are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from orchestrator.study.study_campaigns import calibration_actions
from orchestrator.study.study_file import load_study
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator

STUDY = Path(__file__).parents[1] / "configs" / "studies" / "paper.yaml"
LEVEL, EVERY, SEEDS = "moderate", 3, (1, 2)


def main() -> None:
    """Simulate and print."""
    study = load_study(STUDY)
    calibration, bench = study.base.calibration, study.level(LEVEL).bench
    assert calibration is not None
    assert bench is not None
    points = calibration_actions(study)[::EVERY][:13]
    actions = [calibration.scene.action(calibration.actions.decode(point)) for point in points]
    liquid, error = bench.theta, bench.pose_error
    place = {"receiver_x": error.x, "receiver_y": error.y}
    arm = {"tilt_zero": error.tilt, "speed_factor": error.speed_factor}
    attraction = {"cohesion": liquid.cohesion, "xsph_rate": liquid.xsph_rate}
    friction = {"friction": liquid.friction}
    groups = {
        "bench": {**place, **arm, **attraction, **friction},
        "defaults": {},
        "friction": friction,
        "receiver": place,
        "tilt and speed": arm,
        "cohesion and xsph rate": attraction,
    }
    simulator, spilled = PourSimulator(), {}
    for name, values in groups.items():
        theta = study.base.parameters.model_copy(update=values)
        tasks = [[PourTask(calibration.scene, action, theta, seed) for seed in SEEDS] for action in actions]
        spilled[name] = np.array(
            [np.mean([simulator.simulate(task).outcome.spilled for task in each]) for each in tasks]
        )
        print(f"{name}: {100.0 * np.abs(spilled[name] - spilled['bench']).mean():.2f} points", flush=True)


if __name__ == "__main__":
    main()
