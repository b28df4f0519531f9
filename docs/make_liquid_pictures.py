"""Draw water, oil and glycerol that leave the same cup, and where their streams may cling.

python docs/make_liquid_pictures.py
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from orchestrator.config.file_loading import load_vessel
from sim_engine.action import DEG, Action
from sim_engine.lip_flow import flow_course, weber
from sim_engine.liquids import Liquid, SimulationParameters, look_up
from sim_engine.model_validity import DRIBBLING_WEBER
from sim_engine.motion import plan_motion
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel

IMAGES = Path(__file__).resolve().parent / "images"
TIMES = (1.5, 2.0, 3.0)
VOLUME = 200e-6
PARTICLES = 1_000


VESSELS = IMAGES.parents[1] / "configs" / "vessels"
VELOCITIES = np.geomspace(2.0, 120.0, 40)
LOADS = np.linspace(50.0, 450.0, 21)


def liquids() -> dict[str, Liquid]:
    """What is poured, by what stands beside it."""
    found = {"water, 1 mPa s": Liquid(mass=998.0 * VOLUME)}
    for name, title in (("rapeseed oil", "rapeseed oil"), ("glycerol 100 %", "glycerol")):
        known = look_up(name)
        assert known is not None
        found[f"{title}, {1e3 * known.dynamic_viscosity:,.0f} mPa s"] = Liquid(
            name=name,
            mass=known.density * VOLUME,
            density=known.density,
            surface_tension=known.surface_tension,
            dynamic_viscosity=known.dynamic_viscosity,
        )
    return found


def clinging(liquid: Liquid) -> np.ndarray:
    """Shares of what the shipped beaker pours that leave below the critical Weber number, by load and velocity."""
    pourer, receiver = (load_vessel(VESSELS / f"{name}.yaml") for name in ("beaker", "tumbler"))
    built = build_vessel(pourer), build_vessel(receiver)
    shares = np.empty((len(LOADS), len(VELOCITIES)))
    for i, load in enumerate(1e-6 * LOADS):
        loaded = liquid.model_copy(update={"mass": load * liquid.density})
        scene = Scene("cups", pourer, receiver, loaded)
        for k, velocity in enumerate(VELOCITIES):
            action = Action(velocity * DEG, x_offset=0.085, height=0.115, max_angle=110 * DEG, hold_time=2.0)
            course = flow_course(plan_motion(scene, action, *built), loaded, *built)
            assert course is not None
            shares[i, k] = course.share(weber(liquid, course.velocity, course.film) < DRIBBLING_WEBER)
    return shares


def draw_clinging() -> None:
    """A map for each liquid: criterion, not simulation."""
    import matplotlib.pyplot as plt

    rows = liquids()
    figure, axes = plt.subplots(1, len(rows), figsize=(10.0, 3.9), sharex=True, sharey=True, layout="constrained")
    for panel, (title, liquid) in zip(axes, rows.items(), strict=True):
        share = clinging(liquid)
        levels = np.linspace(0.0, 100.0, 11)
        filled = panel.contourf(VELOCITIES, LOADS, 100.0 * share, levels=levels, cmap="YlOrBr")
        panel.contour(VELOCITIES, LOADS, 100.0 * share, levels=[5.0], colors="black", linewidths=1.4)
        panel.set_xscale("log")
        panel.set_xticks([2, 5, 10, 20, 50, 100], labels=["2", "5", "10", "20", "50", "100"])
        panel.minorticks_off()
        panel.set_title(title, fontsize=10)
        panel.set_xlabel("angular velocity [deg/s]")
    axes[0].set_ylabel("load [mL]")
    figure.colorbar(filled, ax=axes, label="may cling to the wall [% of what is poured]")
    figure.suptitle(
        f"A criterion, not a simulation: what leaves the beaker's lip at a Weber number below {DRIBBLING_WEBER:g}",
        fontsize=11,
    )
    figure.savefig(IMAGES / "liquids-clinging.png", dpi=110)
    print(IMAGES / "liquids-clinging.png")


def main() -> None:
    """Simulate and draw."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    draw_clinging()
    scene = Scene(
        "cups",
        cylinder("pourer", inner_radius=0.04, inner_height=0.1),
        cylinder("receiver", inner_radius=0.045, inner_height=0.09),
        Liquid(mass=0.2),
    )
    action = Action(angular_velocity=60 * DEG, x_offset=0.085, height=0.115, max_angle=110 * DEG, hold_time=2.0)
    simulator = PourSimulator()
    rows = liquids()
    figure, axes = plt.subplots(len(rows), len(TIMES), figsize=(9.0, 8.4), sharex=True, sharey=True)
    for row, (title, liquid) in zip(axes, rows.items(), strict=True):
        task = PourTask(
            replace(scene, liquid=liquid), action, SimulationParameters(particles=PARTICLES), 1, frame_rate=20.0
        )
        run = simulator.simulate(task)
        assert run.frames is not None
        for panel, time in zip(row, TIMES, strict=True):
            k = int(np.argmin(np.abs(run.frames.times - time)))
            x = 1e3 * run.frames.positions[k]
            order = np.argsort(-x[:, 1])
            panel.scatter(x[order, 0], x[order, 2], s=7, c=x[order, 1], cmap="Blues_r", vmin=-60, vmax=60, lw=0)
            _walls(panel, run.frames.pourer_poses[k], 40.0, 100.0)
            _walls(panel, np.array([0.0, 0, 0, 1, 0, 0, 0]), 45.0, 90.0)
            panel.set_aspect("equal")
            panel.set_title(f"{run.frames.times[k]:.1f} s", fontsize=9)
        left = 100.0 * run.outcome.retained
        row[0].set_ylabel(f"{title}\n(kept at the end: {left:.0f} %)\nheight [mm]", fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel("[mm]")
    figure.tight_layout()
    figure.savefig(IMAGES / "liquids-cup.png", dpi=110)
    print(IMAGES / "liquids-cup.png")


def _walls(panel, pose, radius: float, height: float) -> None:  # type: ignore[no-untyped-def]
    """The section of a straight cup of 4 mm walls in the plane y = 0, in millimetres."""
    from sim_engine.collision import rotations

    r, h = radius, height + 4.0
    outline = np.array([[-r, h], [-r, 4], [r, 4], [r, h], [r + 4, h], [r + 4, 0], [-r - 4, 0], [-r - 4, h], [-r, h]])
    points = np.column_stack([outline[:, 0], np.zeros(len(outline)), outline[:, 1]])
    (turn,) = rotations(np.asarray(pose, dtype=float)[None])
    world = points @ turn.T + 1e3 * np.asarray(pose[:3], dtype=float)
    panel.fill(world[:, 0], world[:, 2], color="0.75", lw=0)


if __name__ == "__main__":
    main()
