"""One simulated pour as a recording, for `decant simulate --rrd`."""

from __future__ import annotations

import time
from pathlib import Path

from orchestrator.monitor.blueprint import simulation_blueprint
from orchestrator.monitor.films import Films
from orchestrator.monitor.outlet import Outlet
from orchestrator.monitor.simulated import SimulatedStage
from orchestrator.report import style
from sim_engine.simulated import SimulatedPour
from sim_engine.task import PourTask


def simulation_rrd(path: Path, task: PourTask, result: SimulatedPour, title: str = "") -> Path:
    """Write a recording of one simulated pour.

    Args:
        path: `.rrd` to write; replaced if it exists.
        task: what was simulated, with `record_rate` > 0.
        result: what came of it.
        title: of the recording; what is poured into what if not given.

    Returns:
        `path`.

    Raises:
        ValueError: the result has no frames.
        OSError: the file can't be written.
    """
    import rerun as rr

    if result.frames is None:
        raise ValueError("this simulation kept no frames to record; simulate it with a record rate above 0")
    scene, outcome = task.scene, result.outcome
    title = title or f"{scene.pourer.name} into {scene.receiver.name}, seed {task.seed}"
    outlet = Outlet(path, application="decant simulation", name=title)
    outlet.keep(simulation_blueprint())
    outlet.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    films = Films(outlet)
    now = time.time()
    outlet.times(wall=now, step=0, sim_time=0.0)
    SimulatedStage(outlet, films).film(result.frames, scene, title, now=now, step=0)
    films.play(float("inf"))
    for source, text in (
        ("action", style.display_values(task.action.values())),
        ("parameters", style.display_values(task.parameters.model_dump())),
        (
            "outcome",
            f"received {100 * outcome.received:.2f} %, spilled {100 * outcome.spilled:.2f} %, "
            f"retained {100 * outcome.retained:.2f} %, in flight {100 * outcome.in_flight:.2f} %",
        ),
    ):
        level = rr.TextLogLevel.WARN if source == "outcome" and outcome.invalid is not None else rr.TextLogLevel.INFO
        outlet.log(f"/log/{source}", rr.TextLog(text, level=level))
    outlet.close()
    return path
