"""`vessel_account`: a cup is one vessel for the station, for its place and for a run at the terminal, so that no liquid
is dosed into it twice: also after it was moved, and after a state of an earlier format was converted or half converted.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import LaboratoryError
from orchestrator.daemon.rigs.materials import MaterialError, Materials
from orchestrator.daemon.state.daemon_settings import Rig
from orchestrator.daemon.state.daemon_store import Store, StoreError
from orchestrator.materials.vessel_account import FILE_NAME, FORMAT, MIXTURE, LaboratoryPlaces, Transfer, VesselAccount
from tests.support.cli_inputs import invoke
from tests.support.station import order
from tests.support.toy_daemon import serving

FORMER = Path(__file__).parents[2] / "data" / "daemon" / "state-places"
"""A station whose cups an arm carries, as version 0.3.0 wrote it while its account had format 0: cup-1 was filled by an
order, cup-2 and cup-3 by orders that were killed after and during the dose, a cup without an id at 'rack/A2' by a
series, cup-4 and cup-5 by a person."""

LABORATORIES = {"left": "rack", "right": "stairs"}


def opened(folder: Path, laboratory: str = "rack") -> tuple[VesselAccount, LaboratoryPlaces]:
    account = VesselAccount(folder / FILE_NAME)
    return account, LaboratoryPlaces(account, laboratory)


def begin(places: LaboratoryPlaces, cup: str, liquid: str = "water") -> None:
    """What the bench enters before a dose flows."""
    for name in places.stands():
        places.put(name, "", "laid out again")
    places.put(cup, cup, "laid out by the operator")
    places.put(cup, "pan")
    places.add_component(cup, "", 0.09, 5e-5)
    places.add_component(cup, liquid, None, 0.0, "source/water")
    places.content(cup, None, 0.0, liquid)


def finish(places: LaboratoryPlaces, cup: str, liquid: str = "water") -> None:
    places.add_component(cup, liquid, 0.03, 1e-4, "source/water")
    places.content(cup, 0.03, 1e-4, liquid)
    places.put(cup, cup)


def fail(*_: Any, **__: Any) -> None:
    raise OSError("interrupted")


def liquids(places: LaboratoryPlaces, cup: str) -> dict[str, float | None]:
    return {name: mass for name, (mass, _) in places.composition(cup).items() if name}


def mass(account: VesselAccount, vessel: str) -> float | None:
    content = account.content(vessel)
    assert content is not None
    return content.mass


@contextlib.contextmanager
def station(folder: Path) -> Iterator[Materials]:
    with contextlib.closing(Store(folder / "daemon.sqlite")) as store:
        yield Materials(store, LABORATORIES)


def register(materials: Materials) -> None:
    shape = {"profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}}
    materials.add_liquid("water", "", {"name": "water"})
    for position in ("rack/A1", "rack/B2"):
        materials.add_position(position, f"P-{position[-2:]}", "left", "")
    materials.add_vessel("cup-1", "", shape, "rack/A1", "ada")
    materials.add_vessel("cup-2", "", shape, "", "ada")


# ---- one vessel


def test_a_dose_at_the_terminal_and_one_by_the_station_are_in_the_account_of_the_same_cup(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path))
    account, places = opened(tmp_path)
    with station(tmp_path) as materials:
        register(materials)
        begin(places, "rack/A1")  # the bench of `decant run` knows places only
        assert materials.content("cup-1").mass is None
        finish(places, "rack/A1")
        assert materials.content("cup-1").mass == materials.content("P-A1").mass == 0.03
        account.transfer("order-1", "can", "cup-1", Transfer((0.005, 0.0), (0.005, 0.0)), by="bo")
        assert places.held("rack/A1") == (pytest.approx(0.035), pytest.approx(1e-4))
        assert [one.vessel for one in account.all()] == ["can", "cup-1", "cup-2"]
        assert [one.id for one in materials.everything().sources] == ["can"]
    assert invoke("materials weigh rack/rack/A1 '20 g'").exit_code == 0  # without the daemon
    assert mass(account, "cup-1") == 0.02
    assert "cup-1" in invoke("materials list").stdout


def test_a_cup_that_a_person_moves_keeps_its_content_and_leaves_none_at_its_former_place(tmp_path: Path) -> None:
    account, places = opened(tmp_path)
    with station(tmp_path) as materials:
        register(materials)
        begin(places, "rack/A1")
        finish(places, "rack/A1")
        materials.place("cup-1", "P-B2", "ada")
        assert liquids(places, "rack/B2") == {"water": 0.03}
        assert places.composition("rack/A1") == {}
        assert places.stands() == {"rack/B2": "rack/B2"}
        with pytest.raises(MaterialError, match="position rack/B2 is taken by vessel cup-1; move that one first"):
            materials.place("cup-2", "rack/B2", "ada")
        materials.place("cup-2", "rack/A1", "ada")
        assert (materials.vessel("rack/A1").id, materials.vessel("rack/B2").id) == ("cup-2", "cup-1")
        materials.place("cup-1", "", "ada")
        assert mass(account, "cup-1") == 0.03
        assert places.composition("rack/B2") == {}


def test_a_cup_that_is_registered_again_keeps_what_was_dosed_into_it(tmp_path: Path) -> None:
    """A client may repeat its registration, as after a lost answer."""
    account, places = opened(tmp_path)
    with station(tmp_path) as materials:
        register(materials)
        begin(places, "rack/A1")
        finish(places, "rack/A1")
        register(materials)
    assert (mass(account, "cup-1"), liquids(places, "rack/A1")) == (0.03, {"water": 0.03})


def test_a_cup_whose_registration_was_interrupted_keeps_what_was_dosed_before_it_is_repeated(tmp_path: Path) -> None:
    account, places = opened(tmp_path)
    with station(tmp_path) as materials:
        register(materials)
        shape = {"profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(VesselAccount, "weigh", fail)
            with pytest.raises(OSError, match="interrupted"):
                materials.add_vessel("cup-3", "", shape, "", "ada")
        materials.place("cup-3", "rack/B2", "ada")
        begin(places, "rack/B2")
        finish(places, "rack/B2")
        materials.add_vessel("cup-3", "", shape, "rack/B2", "ada")
    assert (mass(account, "cup-3"), liquids(places, "rack/B2")) == (0.03, {"water": 0.03})


def test_a_cup_into_which_a_run_has_dosed_a_liquid_of_its_own_can_be_weighed(tmp_path: Path) -> None:
    _, places = opened(tmp_path)
    with station(tmp_path) as materials:
        register(materials)
        begin(places, "rack/A1", "ethanol 70 %")
        materials.weigh("cup-1", 0.02, 1e-4, "", "ada")
        assert (materials.content("cup-1").mass, materials.content("cup-1").liquid) == (0.02, "ethanol 70 %")
        materials.weigh("cup-1", 0.0, 0.0, "", "ada")
        assert liquids(places, "rack/A1") == {}


def test_a_registered_cup_is_shown_in_the_gripper_while_a_campaign_moves_it(tmp_path: Path) -> None:
    _, places = opened(tmp_path)
    with station(tmp_path) as materials:
        register(materials)
        places.put("rack/A1", None, "the arm began to take it from 'rack/A1'")
        shown = [materials.everything(running).vessels[0].position for running in (["rack"], ["another"])]
        assert shown == ["in the gripper, from 'rack/A1'", "UNKNOWN (the arm began to take it from 'rack/A1')"]
        places.put("rack/A1", "pan")
        assert materials.everything(["rack"]).vessels[0].position == "rack/A1"


def test_a_dose_that_began_with_an_entry_of_the_liquid_only_is_taken_over(tmp_path: Path) -> None:
    account, places = opened(tmp_path)
    places.add_component("rack/A1", "water", None, 0.0, "source/water")  # killed before the content was entered
    with station(tmp_path) as materials:
        register(materials)
    assert liquids(places, "rack/A1") == {"water": None}
    assert [part.liquid for part in account.composition("cup-1")] == ["water"]


def test_a_filled_cup_without_an_id_is_the_one_that_gets_its_place(tmp_path: Path) -> None:
    """What 'decant run' has dosed before the cup was registered counts."""
    account, places = opened(tmp_path)
    begin(places, "rack/A1")
    finish(places, "rack/A1")
    with station(tmp_path) as materials:
        register(materials)
        assert liquids(places, "rack/A1") == {"water": 0.03}
        assert mass(account, "cup-1") is None  # it was registered as an empty one: a person has to look
        assert "cup-1: holds UNKNOWN; weigh the vessel" in materials.refusal("cup-2", "cup-1", "water", 0.01)
        materials.weigh("cup-1", 0.03, 1e-4, "", "ada")
        assert liquids(places, "rack/A1") == {"water": 0.03}
        materials.weigh("cup-1", 0.0, 0.0, "", "ada")
        assert liquids(places, "rack/A1") == {}


@pytest.mark.parametrize(
    ("held", "place", "expected"), [(0.03, "rack/A1", 0.03), (0.035, "rack/A1", None), (0.03, None, None)]
)
def test_a_content_is_kept_if_two_accounts_of_it_agree_and_no_motion_was_interrupted(
    held: float, place: str | None, expected: float | None, tmp_path: Path
) -> None:
    account, places = opened(tmp_path)
    account.weigh("cup-1", 0.03, 1e-4, liquid="water")
    places.content("rack/A1", held, 1e-4, "water")
    places.put("rack/A1", place, "the arm began to take it from 'rack/A1'")
    account.assign("cup-1", ("rack", "rack/A1"), by="ada")
    assert mass(account, "cup-1") == expected


def test_a_cup_that_gets_an_id_in_the_middle_of_a_dose_has_that_dose(tmp_path: Path) -> None:
    account, places = opened(tmp_path)
    begin(places, "rack/A1")
    with station(tmp_path) as materials:
        register(materials)
    assert (mass(account, "cup-1"), liquids(places, "rack/A1")) == (None, {"water": None})
    finish(places, "rack/A1")
    assert (mass(account, "cup-1"), liquids(places, "rack/A1")) == (0.03, {"water": 0.03})


def test_places_with_the_same_name_of_two_laboratories_hold_two_vessels(tmp_path: Path) -> None:
    (account, places), (_, others) = opened(tmp_path), opened(tmp_path, "stairs")
    with station(tmp_path) as materials:
        register(materials)
    begin(others, "rack/A1", "oil")
    finish(others, "rack/A1", "oil")
    assert (liquids(places, "rack/A1"), liquids(others, "rack/A1")) == ({}, {"oil": 0.03})
    assert (mass(account, "cup-1"), mass(account, "stairs/rack/A1")) == (0.0, 0.03)
    assert places.stands() == others.stands() == {"rack/A1": "rack/A1"}


@pytest.mark.parametrize("vessel", ["rack/rack/A1", "cup-1"])
def test_a_liquid_that_was_poured_by_hand_on_top_of_another_one_is_in_the_cup(vessel: str, tmp_path: Path) -> None:
    account, places = opened(tmp_path)
    if vessel == "cup-1":
        account.assign(vessel, ("rack", "rack/A1"), by="ada")
    begin(places, "rack/A1", "oil")
    finish(places, "rack/A1", "oil")
    account.weigh("jar/water", 0.1, 1e-4, liquid="water")
    for _ in range(2):
        account.pour_by_hand("m-1", "jar/water", "rack/rack/A1", 0.01, 1e-4, by="ada")
    assert liquids(places, "rack/A1") == {"oil": 0.03, "water": 0.01}
    assert places.held("rack/A1") == (pytest.approx(0.04), pytest.approx(2**0.5 * 1e-4))
    assert {one.vessel for one in account.all()} == {vessel, "jar/water"}


# ---- a state of an earlier format


@pytest.fixture
def former(tmp_path: Path) -> Path:
    for name in ("daemon", "vessels"):
        database = sqlite3.connect(tmp_path / f"{name}.sqlite")
        database.executescript((FORMER / f"{name}.sql").read_text(encoding="utf-8"))
        database.close()
    return tmp_path


def state_of(folder: Path) -> dict[str, Any]:
    """Where each vessel stands, and what is in it."""
    account, places = opened(folder)
    composition = {
        one.vessel: {part.liquid: part.mass for part in account.composition(one.vessel)} for one in account.all()
    }
    stands = {name: (one.home, one.place) for name, one in account.places().items() if "/" not in name}
    contents = {one.vessel: (one.mass, one.liquid) for one in account.all()}
    return {"contents": contents, "composition": composition, "stands": stands, "bench": places.stands()}


def moved(folder: Path) -> None:
    with station(folder) as materials:
        materials.move_positions()


def check_moved(folder: Path) -> None:
    account, places = opened(folder)
    found = state_of(folder)
    assert found["contents"] == {
        "can": (None, "water"),  # a motion with it was interrupted
        "cup-1": (pytest.approx(0.03, abs=1e-4), "water"),
        "cup-2": (None, "water"),  # the station had it empty
        "cup-3": (None, "water"),
        "cup-4": (0.012, "oil"),
        "cup-5": (0.008, "oil"),
        "jar/oil": (pytest.approx(0.092), "oil"),
        "night/pourer": (0.1, "water"),
        "night/receiver": (0.02, "water"),
        "rack/rack/A2": (pytest.approx(0.01, abs=1e-4), "water"),
    }
    for cup, mass in {"A1": 0.03, "A2": 0.01, "B2": 0.025, "C1": None}.items():
        assert liquids(places, f"rack/{cup}")["water"] == mass, cup
    assert liquids(places, "rack/B1") == {"oil": 0.008}
    assert found["composition"]["cup-1"][""] == 0.0901  # its tare
    assert found["stands"] == {
        "can": ("source/water", None),
        "cup-1": ("rack/A1", ""),  # outside the cell: it was not part of the last order
        "cup-2": ("rack/B2", ""),
        "cup-3": ("rack/C1", "pan"),
        "cup-4": ("shelf", "shelf"),
        "cup-5": ("rack/B1", "rack/B1"),
    }
    assert LaboratoryPlaces(account, "night").stands() == {"pourer": "left", "receiver": None}


def test_a_state_of_the_former_format_is_converted_and_no_dose_of_it_is_lost(former: Path) -> None:
    moved(former)
    check_moved(former)
    before = state_of(former)
    moved(former)  # a restart changes nothing
    assert state_of(former) == before


async def test_a_station_of_the_former_format_goes_on_and_refuses_what_would_be_a_second_dose(tmp_path: Path) -> None:
    from orchestrator.campaigns.file_loading import load_laboratory

    rack = Path(__file__).parents[3] / "configs" / "laboratories" / "rack.yaml"
    (tmp_path / "state").mkdir()
    for name in ("daemon", "vessels"):
        database = sqlite3.connect(tmp_path / "state" / f"{name}.sqlite")
        database.executescript((FORMER / f"{name}.sql").read_text(encoding="utf-8"))
        database.close()
    async with serving(tmp_path, rigs=(Rig("left", rack, load_laboratory(rack)),)) as served:
        vessels = {one["id"]: one["position"] for one in (await served.get("/materials"))["vessels"]}
        assert vessels == {
            "can": "UNKNOWN (the arm began to take it from 'source/water')",
            **{
                f"cup-{number}": at
                for number, at in enumerate(("rack/A1", "rack/B2", "rack/C1", "shelf", "rack/B1"), 1)
            },
        }
        await served.post("/materials/vessels/can/weighed", {"mass": "200 g"})
        for number, (cup, said) in enumerate(
            {
                "P-A1": "cup-1: has 30.0 g of water already",
                "cup-2": "cup-2: holds UNKNOWN; weigh the vessel",
                "rack/C1": "cup-3: holds UNKNOWN; weigh the vessel",
            }.items()
        ):
            body = order(f"again-{number}", source="can", receiver=cup, amount="5 g")
            assert said in (await served.post("/pours", body, status=409))["detail"], cup


def test_a_file_that_a_run_has_converted_before_the_daemon_started_keeps_what_the_run_has_dosed(former: Path) -> None:
    account, places = opened(former)
    assert account.identity("rack/rack/B1") == "rack/rack/B1"  # only the daemon's store has where cup-5 stands
    begin(places, "rack/B1")
    finish(places, "rack/B1")
    moved(former)
    assert liquids(places, "rack/B1") == {"oil": 0.008, "water": 0.03}
    content = account.content("cup-5")
    assert content is not None
    assert (content.mass, content.liquid) == (None, MIXTURE)


def killed(folder: Path, after: int) -> bool:
    """Convert a state in a process that dies before the statement of this number. Whether it lived to the end."""
    child = os.fork()
    if child == 0:
        try:
            count, connect = 0, sqlite3.connect

            def die(statement: str) -> None:
                nonlocal count
                count += 1
                if count == after:
                    os.kill(os.getpid(), signal.SIGKILL)

            def traced(*arguments: Any, **more: Any) -> sqlite3.Connection:
                connection = connect(*arguments, **more)
                connection.set_trace_callback(die)
                return connection

            sqlite3.connect = traced  # type: ignore[assignment]
            moved(folder)
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_a_conversion_that_is_killed_at_any_statement_loses_no_dose_and_is_completed_by_the_next_start(
    former: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    content = {name: (former / f"{name}.sqlite").read_bytes() for name in ("daemon", "vessels")}
    statement, lived = 0, False
    while not lived:
        statement += 7
        folder = tmp_path_factory.mktemp("killed")
        for name, data in content.items():
            (folder / f"{name}.sqlite").write_bytes(data)
        lived = killed(folder, statement)
        _, places = opened(folder)  # a run at the terminal that comes first
        for cup in ("A1", "A2", "B2", "C1"):
            assert liquids(places, f"rack/{cup}").keys() == {"water"}, (statement, cup)
        moved(folder)
        check_moved(folder)
    assert statement > 100


def test_a_conversion_by_several_programs_at_once_loses_no_dose(former: Path) -> None:
    """Runs at the terminal open the file while the daemon starts."""
    reading, writing = os.pipe()
    children = []
    for _ in range(4):
        if (child := os.fork()) == 0:
            try:
                os.read(reading, 1)
                kinds = liquids(opened(former)[1], "rack/A2").keys()
                os._exit(0 if kinds == {"water"} else 1)
            finally:
                os._exit(2)
        children.append(child)
    os.write(writing, b"4444")
    moved(former)
    assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0, 0, 0, 0]
    os.close(reading)
    os.close(writing)
    check_moved(former)


def test_a_program_of_the_former_format_that_still_runs_cannot_enter_anything_for_a_vessel_with_an_id(
    former: Path,
) -> None:
    running = sqlite3.connect(former / FILE_NAME)  # as `decant run` of the former version, before its next motion
    running.execute("select * from stand").fetchall()
    moved(former)
    insertions: dict[str, tuple[str, Callable[[], tuple[Any, ...]]]] = {
        "NOT NULL constraint failed: stand.laboratory": (
            "insert into stand (vessel, t, place, by, note) values (?, ?, ?, ?, ?)",
            lambda: ("rack/rack/A1", 1.0, None, "", "the arm began to take it"),
        ),
        "the vessel at this place has an id": (
            "insert into component (vessel, t, liquid, mass, deviation, source) values (?, ?, ?, ?, ?, ?)",
            lambda: ("rack/rack/A1", 1.0, "oil", None, 0.0, ""),
        ),
        "and this entry does not name it": (
            "insert or ignore into entry (key, vessel, t, kind, deviation, liquid, pour, by, note) "
            "values (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            lambda: ("late", "rack/rack/A1", 1.0, "unknown", 0.0, "oil", "", "", ""),
        ),
    }
    for said, (statement, values) in insertions.items():
        with pytest.raises(sqlite3.IntegrityError, match=said):
            running.execute(statement, values())
    running.close()
    check_moved(former)


def test_an_account_of_a_later_version_is_refused_in_one_sentence_and_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    account, places = opened(tmp_path)
    account.weigh("rack/rack/A1", 0.03, 1e-4, liquid="water")
    database = sqlite3.connect(tmp_path / FILE_NAME)
    database.execute(f"pragma user_version = {FORMAT + 1}")
    database.close()
    before = (tmp_path / FILE_NAME).read_bytes()
    said = f"written in format {FORMAT + 1}, and this version of Decant reads formats up to {FORMAT}"
    with pytest.raises(OSError, match=said):
        VesselAccount.open(tmp_path)
    with pytest.raises(LaboratoryError, match=said):
        places.put("rack/A1", None)
    with station(tmp_path) as materials, pytest.raises(StoreError, match=said):
        materials.move_positions()
    monkeypatch.setenv("DECANT_STATE", str(tmp_path))
    listed = invoke("materials list")
    assert listed.exit_code == 2
    assert listed.stderr.count("\n") == 1
    assert said in listed.stderr
    assert (tmp_path / FILE_NAME).read_bytes() == before
