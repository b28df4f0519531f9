"""`decant simulate`, `decant schema`: verbs that need no laboratory."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.commands.common import check_output, read_campaign
from orchestrator.commands.speaking import (
    BAD_INPUT,
    FAILED,
    RefusalError,
    Refused,
    mention,
    print_json,
    stdout_for_results,
)
from orchestrator.commands.waiting import waiting_for

if TYPE_CHECKING:
    from orchestrator.commands.foretelling import SimulateOptions
    from orchestrator.plan import CampaignPlan
    from sim_engine.outcome import PourOutcome
    from sim_engine.pour import PourSimulator
    from sim_engine.regimes import Regimes
    from sim_engine.simulated import SimulatedPour
    from sim_engine.space import Space
    from sim_engine.spread import Spread
    from sim_engine.task import PourTask, Scene


def simulate(path: Path, options: SimulateOptions) -> None:
    """One pour in the simulator of this process, with several seeds: their mean and spread are the prediction."""
    from orchestrator.commands.foretelling import foretelling
    from orchestrator.config.campaign.assignments import assigned_action
    from orchestrator.config.campaign.check import check_vessels
    from orchestrator.config.load import load_vessel
    from orchestrator.config.yaml.errors import ConfigError
    from sim_engine.backend import BackendError, require_backend
    from sim_engine.bands import band_of
    from sim_engine.pour import InvalidSceneError, PourSimulator
    from sim_engine.spread import spreads

    plan = read_campaign(path)
    known = foretelling(plan, options.parameters, options.thetas, options.seeds)
    with Refused(ConfigError):
        vessel = None if options.receiver is None else load_vessel(options.receiver)
    scene, space = scene_to_simulate(plan, options.scene)
    if vessel is not None:
        scene = dataclasses.replace(scene, name=f"{scene.pourer.name} into {vessel.name}", receiver=vessel)
    with Refused(ValueError, at="--set: "):
        action = assigned_action(options.assignments or [], fixed=scene.fixed, space=space)
    check_output(options.rrd, "--rrd", ".rrd")
    check_output(options.png, "--png", ".png")
    problems = check_vessels(scene, plan.source, wanted_in(plan, scene, options.scene))
    if problems:
        raise RefusalError("\n".join(map(str, problems)), BAD_INPUT)
    record_rate = 20.0 if options.rrd or options.png else 0.0
    tasks = known.tasks(scene, action, options.seed, options.seeds, record_rate)
    with Refused(BackendError, at="--backend: "):
        require_backend(options.backend)
    simulator = PourSimulator(options.backend)
    with Refused(InvalidSceneError, at="with shapes that the vessels may have, " if scene.uncertain else ""):
        for task in tasks if scene.uncertain else tasks[:1]:  # refused before Taichi starts
            simulator.prepare(task)
    regime = _regimes(tasks[0])
    runs = _simulated(simulator, tasks)
    outcomes = [run.outcome for run in runs]
    _show(tasks[0], runs[0], options)
    over_seeds, where = spreads(outcomes), band_of(outcomes, known.discrepancy)
    received = over_seeds.get("received")
    delivered = None if received is None else received.mean * scene.liquid.mass
    if options.as_json:
        prediction = {name: spread.as_json() for name, spread in over_seeds.items()}
        print_json(
            {
                **outcomes[0].as_json(),
                "action": action.values(),
                "theta": known.theta.model_dump(),
                "thetas": len(known.drawn),
                "scene": scene.name,
                "delivered_g": None if delivered is None else 1e3 * delivered,
                "delivered_ml": None if delivered is None else scene.liquid.millilitres(delivered),
                "prediction": {
                    **prediction,
                    "band": None if where is None else where.as_json(),
                    "seeds": [task.seed for task in tasks],
                },
                "regimes": None if regime is None else regime.as_json(),
                "not_covered": [] if regime is None else [one.as_json() for one in regime.not_covered],
            }
        )
    else:
        mention(f"{scene.name}: {action.display()}")
        amount = "" if delivered is None else f"{1e3 * delivered:.1f} g, {scene.liquid.millilitres(delivered):.1f} mL"
        print(told(outcomes, over_seeds, amount))
        if where is not None:
            spilled = over_seeds["spillage"].percent()
            print(f"spilled / poured {spilled}, a pour: {where.percent()}   ({known.said(scene)})")
    bad = [f"seed {o.seed}: this outcome must not be used: {o.invalid}" for o in outcomes if o.invalid is not None]
    if bad:
        raise RefusalError("\n".join(bad), FAILED)


def wanted_in(plan: CampaignPlan, scene: Scene, name: str | None) -> float | None:
    """Volume that a scene's receiver has to hold where less than the load is asked for [m³]; None for all of it.

    Args:
        plan: the campaign.
        scene: one that `scene_to_simulate` gave, perhaps with another receiver.
        name: as given to that.
    """
    if plan.deployment is None or name in ("calibration", "transfer"):
        return None
    return plan.deployment.wanted(scene)


def _simulated(simulator: PourSimulator, tasks: list[PourTask]) -> list[SimulatedPour]:
    """One after the other; Taichi ends with them."""
    begin = time.monotonic()
    runs: list[SimulatedPour] = []

    def doing() -> str:
        note = "" if runs else "; the first pour ever also compiles kernels, about 8 s"
        return f"simulating seed {len(runs) + 1} of {len(tasks)}, {time.monotonic() - begin:.0f} s so far{note}"

    with stdout_for_results(), waiting_for(doing):
        try:
            for task in tasks:
                runs.append(simulator.simulate(task))
        finally:
            simulator.close()
    return runs


def told(outcomes: list[PourOutcome], over_seeds: Mapping[str, Spread], delivered: str = "") -> str:
    """The outcomes in one line: mean ± standard deviation of the seeds.

    Args:
        outcomes: one for each seed.
        over_seeds: their means and deviations.
        delivered: how much is in the receiver, in the mean; '' if nobody knows.
    """
    from sim_engine.spread import FRACTIONS

    first = outcomes[0]
    shown = {name: over_seeds[name].percent(2 if name == "escaped" else 1) for name in FRACTIONS if name in over_seeds}
    fractions = "  ".join(f"{name.replace('_', ' ')} {text}" for name, text in shown.items())
    fractions += f"  delivered {delivered}" if delivered else ""
    valid = sum(outcome.invalid is None for outcome in outcomes)
    seeds = (
        "1 seed, so no spread; --seeds 5 would tell it" if valid == 1 else f"mean ± standard deviation, {valid} seeds"
    )
    cpu_s = sum(outcome.cpu_s for outcome in outcomes)
    particles = f"{first.particles} particles, {1e3 * first.spacing:.2f} mm apart, {cpu_s:.1f} CPU s"
    return f"{fractions or 'no outcome that could be used'}   ({seeds}; {particles})"


def _regimes(task: PourTask) -> Regimes | None:
    """What the planned pour is like; what the simulator lacks for it is printed on stderr."""
    from orchestrator.report.regimes import numbers_line, regimes_of

    try:
        found = regimes_of(task.scene, task.action, task.parameters.particles)
    except (ValueError, OSError) as error:
        mention(f"note: whether something is not simulated could not be worked out: {error}")
        return None
    mention(f"{numbers_line(found)} (Reynolds, Weber and Bond numbers)")
    for one in found.not_covered:
        mention(f"not simulated, {one.kind}: {one.text}")
    return found


def scene_to_simulate(plan: CampaignPlan, name: str | None = None) -> tuple[Scene, Space]:
    """A scene of the campaign with its searched actions: the one named, else deployment's first, else calibration's.

    Args:
        name: 'calibration', 'transfer', or a receiver's name.

    Raises:
        RefusalError: the campaign has no such scene.
    """
    scenes: dict[str, tuple[Scene, Space]] = {}
    if plan.deployment is not None:
        scenes |= {scene.receiver.name: (scene, plan.deployment.actions) for scene in plan.deployment.scenes}
    if plan.calibration is not None:
        scenes |= {scene.name: (scene, plan.calibration.actions) for scene in plan.calibration.poured}
        if plan.calibration.transfer is not None:
            scenes["transfer"] = plan.calibration.transfer.scene, plan.calibration.actions
    if name is None:
        return next(iter(scenes.values()))
    if name not in scenes:
        raise RefusalError(f"--scene {name}: the campaign has no such scene; there are {', '.join(scenes)}", BAD_INPUT)
    return scenes[name]


def _show(task: PourTask, pour: SimulatedPour, options: SimulateOptions) -> None:
    if options.rrd is not None:
        from orchestrator.monitor.simulation import simulation_rrd

        mention(f"recording: {simulation_rrd(options.rrd, task, pour)} (open it with: rerun {options.rrd})")
    if options.png is not None:
        from orchestrator.report.scene import simulation_png

        mention(f"picture: {simulation_png(options.png, task, pour)}")


def schema(which: str) -> None:
    """The JSON schema of the files that people write, or of what a run writes."""
    from orchestrator.config.schema import SCHEMAS, schema_text

    if which not in SCHEMAS:
        raise RefusalError(f"no schema '{which}'; there are {', '.join(SCHEMAS)}", BAD_INPUT)
    sys.stdout.write(schema_text(SCHEMAS[which]()))
