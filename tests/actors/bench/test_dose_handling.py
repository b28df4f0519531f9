"""`dose_handling`: an arm carries cups and sources, doses, and accounts for what is in every cup. Over real wires, at
thirty times the clock but for the doses themselves.
"""

from __future__ import annotations

import asyncio
import math
import pickle
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.arm_geometry import Pose
from actors.bench.dose_handling import check_vessels, plan_waste, shapes_of, vessels_of
from actors.grippers.gripper_interface import GRIPPERS
from actors.interfaces import (
    DoseSource,
    DoseTarget,
    InvalidActionError,
    LinkLostError,
    NotPouredError,
    UnknownPourError,
)
from actors.laboratory_settings import LaboratorySettings
from actors.places import CellVessel, ContainerSettings, PlaceSettings, RackSettings, UnattendedSettings, all_places
from orchestrator.campaigns.file_loading import load_laboratory
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from tests.reliability.night import Watched, carried
from tests.support.wired_bench import LABORATORIES, OpenStage, Stage

PACE = 30.0
"""Bench seconds per second."""

TURN = 2.0 * math.pi / (3.0 * math.sqrt(3.0))

BEAKER = carried(cylinder("beaker", inner_radius=0.04, inner_height=0.1), 0.312)
CUP = carried(cylinder("cup", inner_radius=0.032, inner_height=0.1), 0.186)

ACTION = Action(
    angular_velocity=100 * DEG,
    x_offset=0.09,
    height=0.1,
    max_angle=105 * DEG,
    hold_time=0.1,
    return_velocity=100 * DEG,
    angular_acceleration=600 * DEG,
)


def scene(liquid: str = "water") -> Scene:
    return Scene("dose", BEAKER, CUP, Liquid(name=liquid, mass=0.3))


def place(name: str, x: float, y: float, **values: Any) -> PlaceSettings:
    return PlaceSettings(name=name, pose=Pose.of(x, y, 0.08, TURN, TURN, TURN), tool=Pose(z=0.17), **values)


def rack(**values: Any) -> PlaceSettings:
    """Two cups side by side, as the gripper reaches for them along x."""
    settings = {"rows": 1, "columns": 2, "row_pitch": 0.12, "column_pitch": 0.12, "direction": math.pi / 2, **values}
    return place("rack", 0.62, 0.24, holds=("receiver",), rack=RackSettings(**settings))


def spec(pace: float = PACE) -> LaboratorySettings:
    """The shipped night with a rack and two sources, in a wider box."""
    lab = load_laboratory(LABORATORIES / "night.yaml")
    assert lab.arm is not None
    assert lab.balance is not None
    assert lab.bench is not None
    limits = lab.arm.limits  # type: ignore[attr-defined]
    low, high = limits.box.low.with_values(y=-0.9), limits.box.high.with_values(y=0.9)
    limits = limits.with_values(box=limits.box.with_values(low=low, high=high))
    places = (
        lab.places[0].with_values(tray=None),
        lab.places[1].with_values(name="source/water", holds=("pourer",)),
        place("source/ethanol", 0.6, -0.56, holds=("pourer",)),
        rack(),
    )
    vessels = (
        CellVessel("source/water", BEAKER, "water", 0.3, 0.3e-3),
        CellVessel("source/ethanol", BEAKER, "ethanol", 0.3, 0.3e-3),
        *(CellVessel(f"rack/{name}", CUP, "", 0.08, 0.08e-3) for name in ("A1", "A2")),
    )
    return lab.with_values(
        in_process=True,
        places=places,
        vessels=vessels,
        arm=lab.arm.with_values(time_scale=pace, warning_time=0.2, limits=limits),
        balance=lab.balance.with_values(time_scale=pace),
        bench=lab.bench.with_values(time_scale=pace),
        operator=lab.operator.with_values(time=1.0),
        safeguard="fence, gate at input SI0",
        unattended=UnattendedSettings(pours=20, until="07:00"),
    )


async def dosed(
    stage: Stage, grams: float, liquid: str, cup: str, *, held: float = 0.3, fill: bool = True, **about: Any
) -> Any:
    source = DoseSource(f"source/{liquid}", held, 5e-4, fill, 11, vessel=f"source/{liquid}")
    target = DoseTarget(1e-3 * grams, 1e-3, cup, source, cup=cup, **about)
    return await stage.bench.pour(scene(liquid), ACTION, seed=5, dose=target)


WASTE = place("waste", 0.75, -0.72, use="waste", holds=(), container=ContainerSettings(diameter=0.2, height=0.12))


def played(
    open_stage: OpenStage, folder: Path, play: Callable[[Stage, Watched], Awaitable[Any]], **changes: Any
) -> tuple[Stage, Watched]:
    async def run() -> tuple[Stage, Watched]:
        record = Watched(folder, "night")
        async with open_stage(spec=spec().with_values(**changes), record=record) as stage:
            record.follow(stage)
            await play(stage, record)
            return stage, record

    return asyncio.run(run())


@pytest.mark.slow
@pytest.mark.realtime
def test_a_cup_gets_two_liquids_alone_and_every_gram_is_accounted(open_stage: OpenStage, tmp_path: Path) -> None:
    notes: list[dict[str, Any]] = []
    paces: list[float] = []

    async def play(stage: Stage, record: Watched) -> None:
        first = await dosed(stage, 10, "water", "rack/A1", stays=True)
        assert stage.contents.stands["rack/A1"] == "pan"
        begun, clock = time.monotonic(), await stage.now()
        second = await dosed(stage, 20, "ethanol", "rack/A1")
        paces.append((await stage.now() - clock) / (time.monotonic() - begun))
        notes.extend(measured.notes["dose"] for measured in (first, second))

    stage, record = played(open_stage, tmp_path, play)
    assert stage.heard == ["vessels_laid_out", "unattended"]
    consent = stage.operator.heard[-1].text
    assert "from the sources source/water (water), source/ethanol (ethanol), into the cups rack/A1" in consent
    assert stage.unsafe == []
    assert stage.contents.stands == {name: name for name in ("source/water", "source/ethanol", "rack/A1", "rack/A2")}
    assert record.stands() == stage.contents.stands
    for about, grams in zip(notes, (10.0, 20.0), strict=True):
        assert about["cup"] == "rack/A1"
        assert about["missing_mass"] == 0.0  # of its stream; "missing" is what the source lacked before
        assert 1e3 * about["received"] == pytest.approx(grams, abs=4.0)  # less exact on a busy machine
        assert about["received"] == pytest.approx(about["true"], abs=5e-4)
        assert about["gross"][0] - about["tare"][0] == pytest.approx(about["received"], abs=5e-4)
        assert len(about["placed_at"]) > 10  # the placing shows the lag of the balance, for both doses
    assert notes[1]["missing"] == pytest.approx(0.0, abs=3e-4)
    assert notes[1]["tare"] == notes[0]["gross"]  # the cup stood on the balance all the time
    assert 2.0 < paces[0] < 0.8 * PACE  # only the dose itself took its time
    mixture = record.composition("rack/A1")
    assert list(mixture) == ["", "water", "ethanol"]
    assert mixture["ethanol"][0] == notes[1]["received"]
    held = record.held("rack/A1")
    assert held is not None
    assert held[0] == pytest.approx(stage.contents.liquids["rack/A1"], abs=3e-4)
    assert record.held("rack/A2") == (0.0, 0.0)


@pytest.mark.slow
@pytest.mark.realtime
def test_no_liquid_is_dosed_into_a_cup_twice_and_an_unknown_cup_needs_a_person(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    async def play(stage: Stage, record: Watched) -> None:
        record.content("rack/A1", 0.0401, 1e-4, "water")
        record.add_component("rack/A1", "", 0.186, 1e-4)
        record.add_component("rack/A1", "water", 0.0401, 1e-4, "source/water")
        stage.answers = {"cups_kept": ["yes"]}
        with pytest.raises(InvalidActionError, match=r"'rack/A1' has 40.1 g of water already"):
            await dosed(stage, 10, "water", "rack/A1")
        # the program was killed while the cup was carried with liquid
        record.content("rack/A2", 0.02, 1e-4, "ethanol")
        record.add_component("rack/A2", "ethanol", 0.02, 1e-4)
        record.account.put("night/rack/A2", None, note="the arm began to carry it to 'rack/A2'")

        async def enter() -> None:
            record.account.weigh("night/rack/A2", 0.0, 0.0, by="me")

        stage.before["cup_unknown"] = enter
        stage.before["move"] = stage.before["unattended"] = stage.laboratory.stop_arm
        stage.answers = {"unattended": ["no"], "move": ["no"]}
        with pytest.raises(NotPouredError, match="did not let the arm move"):
            await dosed(stage, 10, "water", "rack/A2")

    stage, _ = played(open_stage, tmp_path, play)
    assert stage.heard[:2] == ["cups_kept", "vessels_laid_out"]
    assert "rack/A1 (40.1 g)" in stage.operator.heard[0].text
    assert stage.heard.count("cup_unknown") == 1


@pytest.mark.slow
@pytest.mark.realtime
def test_a_cup_lost_on_its_way_is_unknown_and_an_interrupted_dose_leaves_an_unknown_content(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    async def play(stage: Stage, record: Watched) -> None:
        async def lose() -> None:
            await stage.site.gripper_fault("lost")

        record.once["rack/A1: the arm began to carry it to 'pan'"] = lose
        with pytest.raises(NotPouredError, match=r"the gripper may have lost 'rack/A1'"):
            await dosed(stage, 10, "water", "rack/A1")
        assert record.stands()["rack/A1"] is None
        assert record.composition("rack/A1").keys() <= {""}

        async def stop() -> None:
            while stage.contents.stands.get("source/water") != "" or not record.unknown("rack/A2"):
                await asyncio.sleep(0.02)
            await stage.laboratory.stop_arm()
            await stage.laboratory.stop_arm()

        stopping = asyncio.ensure_future(stop())
        stage.answers = {"recover": ["no"] * 9}
        with pytest.raises(UnknownPourError):
            await dosed(stage, 20, "water", "rack/A2")
        await stopping
        assert record.unknown("rack/A2")
        assert record.composition("rack/A2")["water"][0] is None
        # between nothing and all of the 20 g may have left the source
        assert record.held("source/water") == (pytest.approx(0.29), pytest.approx(0.01, abs=1e-3))

    stage, _ = played(open_stage, tmp_path, play)
    assert stage.unsafe == []
    again = [question for question in stage.operator.heard if question.about == "vessels_laid_out"]
    assert len(again) == 2
    assert again[1].problem == "it is unknown where 'rack/A1' stands"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("moment", ["approach", "tilt"])
def test_a_dose_is_made_by_a_restarted_bench_after_the_link_was_lost_before_the_tilt(
    open_stage: OpenStage, tmp_path: Path, moment: str
) -> None:
    """Nothing flowed: the cup is not UNKNOWN, and nothing is laid out anew but what the arm held."""

    async def play(stage: Stage, record: Watched) -> None:
        await dosed(stage, 20, "water", "rack/A1")
        left = record.held("source/water")
        assert left is not None
        truth = stage.bench.ground_truth
        step, name = (truth.flows, "flows") if moment == "tilt" else (truth.prepare_dose, "prepare_dose")

        async def struck(*arguments: Any) -> None:
            await step(*arguments)
            await stage.site.fault("drop")

        if moment == "tilt":
            setattr(truth, name, struck)
        else:
            record.once["source/water: the arm began to take it from 'source/water'"] = lambda: stage.site.fault("drop")
        with pytest.raises(LinkLostError):
            await dosed(stage, 10, "water", "rack/A2", held=left[0], fill=False)
        assert not record.unknown("rack/A2")
        again = record.held("source/water")
        assert again is not None
        assert again[0] == pytest.approx(left[0], abs=1e-4)
        record.stage = None
        await stage.laboratory.restart_bench()
        stage.attend()
        measured = await dosed(stage, 10, "water", "rack/A2", held=left[0], fill=False)
        assert measured.notes["dose"]["received"] == pytest.approx(0.01, abs=2e-3)
        held = record.held("rack/A1")
        assert held is not None
        assert held[0] == pytest.approx(0.02, abs=2e-3)

    played(open_stage, tmp_path, play)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_cup_is_emptied_at_the_waste_place_and_what_leaves_it_is_accounted(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    notes: list[dict[str, Any]] = []

    async def play(stage: Stage, record: Watched) -> None:
        record.content("rack/A1", 0.04, 1e-4, "water")
        record.add_component("rack/A1", "", 0.186, 1e-4)
        record.add_component("rack/A1", "water", 0.04, 1e-4, "source/water")
        stage.answers = {"cups_kept": ["yes"]}
        measured = await dosed(stage, 15, "water", "rack/A1", emptied=True)
        notes.append(measured.notes["dose"])

    stage, record = played(open_stage, tmp_path, play, places=(*spec().places, WASTE))
    assert stage.heard == ["cups_kept", "vessels_laid_out", "unattended"]
    assert record.held("waste") == (pytest.approx(0.04), pytest.approx(0.5e-3, rel=0.1))
    assert list(record.composition("rack/A1")) == ["", "water"]
    assert record.composition("rack/A1")["water"][0] == notes[0]["received"]
    assert notes[0]["tare"][0] == pytest.approx(0.1864, abs=3e-4)  # with the film that the emptying has left
    held = record.held("rack/A1")
    assert held is not None
    assert held[0] == pytest.approx(stage.contents.liquids["rack/A1"], abs=3e-4)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_cup_is_emptied_by_the_operator_where_there_is_no_waste_place(open_stage: OpenStage, tmp_path: Path) -> None:
    async def play(stage: Stage, record: Watched) -> None:
        await dosed(stage, 10, "water", "rack/A1", stays=True)
        assert stage.heard == ["vessels_laid_out", "unattended"]
        await dosed(stage, 20, "water", "rack/A1", held=0.29, fill=False, emptied=True)

    stage, record = played(open_stage, tmp_path, play)
    exchanged = next(question for question in stage.operator.heard if question.about == "cup_exchanged")
    assert exchanged.text == "Take 'rack/A1' from 'pan', and put it back there empty and dry, or another one."
    assert "unattended: the consent has ended" in stage.said("warning")  # nobody was there to empty it
    held = record.held("rack/A1")
    assert held is not None
    assert held[0] == pytest.approx(stage.contents.liquids["rack/A1"], abs=3e-4)
    assert held[0] == pytest.approx(0.02, abs=1e-3)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_source_is_filled_by_the_pump_and_a_dose_that_is_weighed_stays_known_whatever_follows(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    measured: list[Any] = []
    vessels = (replace(spec().vessels[0], filled=False), *spec().vessels[1:])

    async def play(stage: Stage, record: Watched) -> None:
        record.content("source/water", 0.1, 5e-4, "water")
        record.content("reservoir", 1.0, 1e-3, "water")

        async def lose() -> None:
            await stage.site.gripper_fault("lost")

        record.once["source/water: the arm began to carry it to 'source/water'"] = lose
        source = DoseSource("source/water", 0.3, 5e-4, True, 11, before=0.1, vessel="source/water")
        target = DoseTarget(0.015, 1e-3, "A1", source, cup="rack/A1")
        measured.append(await stage.bench.pour(scene(), ACTION, seed=5, dose=target))

    stage, record = played(open_stage, tmp_path, play, vessels=vessels)
    assert stage.heard == ["vessels_laid_out", "unattended", "recover", "home"]
    assert record.held("reservoir") == (pytest.approx(0.8), pytest.approx(2e-3, abs=8e-3))
    about = measured[0].notes["dose"]
    assert about["received"] == pytest.approx(about["true"], abs=5e-4)
    held, laid_out = record.held("rack/A1"), stage.operator.heard[0].text
    assert held is not None
    assert held[0] == pytest.approx(stage.contents.liquids["rack/A1"], abs=5e-4)
    assert "'source/water' on 'source/water' as it is" in laid_out
    assert stage.contents.liquids["source/water"] == pytest.approx(0.285, abs=0.02)
    left = record.held("source/water")
    assert left is not None
    assert left[0] == pytest.approx(0.3 - about["received"], abs=5e-3)
    assert record.stands()["source/water"] is None
    assert "the dose is weighed, and its vessels are not put back: the gripper may have lost" in stage.said("warning")
    assert "unattended: the consent has ended" in stage.said("warning")


@pytest.mark.realtime
@pytest.mark.parametrize(("grams", "asked"), [(300.0, False), (100.0, True)])
def test_a_resumed_series_has_a_source_filled_only_if_it_is_not_full(
    open_stage: OpenStage, tmp_path: Path, grams: float, asked: bool
) -> None:
    vessels = (replace(spec().vessels[0], filled=False), *spec().vessels[1:])

    async def play(stage: Stage, record: Watched) -> None:
        record.content("source/water", 1e-3 * grams, 5e-4, "water")
        stage.answers = {"unattended": ["no"], "move": ["no"]}
        with pytest.raises(NotPouredError, match="did not let the arm move"):
            await dosed(stage, 10, "water", "rack/A1")

    stage, _ = played(open_stage, tmp_path, play, vessels=vessels)
    assert ("source_refill" in stage.heard) is asked


def test_a_cup_is_emptied_only_where_there_is_waste_and_the_arm_reaches_over_it() -> None:
    lab = spec()
    assert lab.arm is not None
    _, loads, _ = check_vessels(all_places((*lab.places, WASTE)), lab.vessels, lab.arm, GRIPPER)
    assert "waste" not in loads
    beside = WASTE.with_values(pose=Pose.of(0.66, -0.62, 0.08, TURN, TURN, TURN))
    with pytest.raises(InvalidActionError, match="places 'source/ethanol' and 'waste' overlap"):
        check_vessels(all_places((*lab.places, beside)), lab.vessels, lab.arm, GRIPPER)
    far = WASTE.with_values(pose=Pose.of(0.99, -0.89, 0.08, TURN, TURN, TURN))
    for waste, problem in ((WASTE, ""), (far, "'rack/A1' cannot be emptied at 'waste': ")):
        places, loads, _ = check_vessels(all_places((*lab.places, waste)), lab.vessels, lab.arm, GRIPPER)
        shapes = shapes_of(all_places((*lab.places, waste)), loads)
        if problem:
            with pytest.raises(InvalidActionError, match=problem):
                plan_waste(places, lab.arm, scene(), lab.vessels[2], shapes)
        else:
            assert plan_waste(places, lab.arm, scene(), lab.vessels[2], shapes) is not None


GRIPPER = GRIPPERS.get("robotiq")(model="2F-140")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda vessels: [*vessels, replace(vessels[2], name="rack/C1")], "there is no place 'rack/C1' for a vessel"),
        (lambda vessels: [replace(vessels[0], name="rack/A2")], "place 'rack/A2' is not for a pourer"),
        (lambda vessels: [vessels[2], replace(vessels[2], name="b", home="rack/A1")], "two vessels belong to place"),
        (
            lambda vessels: [replace(vessels[2], spec=cylinder("cup", inner_radius=0.03, inner_height=0.1))],
            "empty mass",
        ),
        (lambda vessels: [replace(vessels[0], volume=0.502e-3)], "'beaker' would be too full to be carried"),
        (lambda vessels: [replace(vessels[0], mass=1.5)], "'beaker' is too heavy when full"),
    ],
)
def test_vessels_that_cannot_be_carried_are_refused(change: Callable[[Any], Any], message: str) -> None:
    lab = spec()
    assert lab.arm is not None
    vessels = tuple(change(lab.vessels))
    with pytest.raises(InvalidActionError, match=message) as caught:
        check_vessels(all_places(lab.places), vessels, lab.arm, GRIPPER)
    assert set(caught.value.problems.values()) <= {vessel.name for vessel in vessels}  # whose problems these are


def test_positions_that_overlap_are_all_refused_also_where_only_open_fingers_do() -> None:
    lab = load_laboratory(LABORATORIES / "rack.yaml")
    assert lab.arm is not None
    for radius, text in (
        (0.048, "places 'rack/A1' and 'rack/A2' overlap: what stands there is 2 mm within each other, 15 mm have to"),
        (0.037, "places 'rack/A1' and 'rack/A2' overlap when the gripper is open: its fingers and the neighbour are"),
    ):
        wide = carried(cylinder("cup", inner_radius=radius, inner_height=0.08, wall=0.003), 0.09)
        cups = tuple(CellVessel(f"rack/A{i}", wide, "", 0.08, 0.08e-3) for i in range(1, 7))
        with pytest.raises(InvalidActionError) as caught:
            check_vessels(all_places(lab.places), cups, lab.arm, GRIPPER)
        assert text in str(caught.value)
        assert len(caught.value.problems) >= 5  # each pair of neighbours
        assert set(caught.value.problems) == set(pickle.loads(pickle.dumps(caught.value)).problems)


def test_rows_of_a_rack_stand_as_on_stairs_if_the_gripper_reaches_over_them() -> None:
    lab = spec()
    assert lab.arm is not None
    values = {"rows": 2, "row_pitch": 0.12}
    for rise, problem in ((0.0, "would run into a vessel at 'rack/"), (0.13, "")):
        places = all_places((*lab.places[:3], rack(**values, row_rise=rise)))
        cups = tuple(CellVessel(f"rack/{name}", CUP, "", 0.08, 0.08e-3) for name in ("A1", "A2", "B1", "B2"))
        if problem:
            with pytest.raises(InvalidActionError, match=problem):
                check_vessels(places, (*lab.vessels[:2], *cups), lab.arm, GRIPPER)
        else:
            _, _, ways = check_vessels(places, (*lab.vessels[:2], *cups), lab.arm, GRIPPER)
            assert {name for name, _ in ways} == {"pan", *(v.name for v in (*lab.vessels[:2], *cups))}


def test_the_only_vessels_of_a_dose_are_those_of_the_scene_at_their_places() -> None:
    lab = load_laboratory(LABORATORIES / "night.yaml")
    source, cup = vessels_of(lab.places, scene(), DoseTarget(0.02, 1e-3))
    assert (source.name, source.place, source.liquid, source.filled) == ("beaker", "left", "water", True)
    assert (cup.name, cup.place, cup.liquid) == ("cup", "right", "")
    assert cup.volume == pytest.approx(21e-6, rel=0.01)
