"""`http_api`: the operator's page in a real Chromium: what somebody with wet hands, a keyboard or a screen reader
finds there.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import httpx
import pytest

from actors.emulators.ur_controller.controller_process import VirtualController
from actors.interfaces import Notice, OperatorQuestion
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.daemon.state.access_tokens import Role, token_of
from orchestrator.daemon.state.daemon_settings import Rig
from orchestrator.records.run_registry import VARIABLE, use_state_directory
from tests.orchestrator.daemon.rigs.test_campaign_queue_doses import held_dose
from tests.orchestrator.reports.test_mixture_report import MIXTURES
from tests.support.browser import OnPort, browser, on_port
from tests.support.hardware_laboratory import hardware_rig
from tests.support.toy_campaign import ToyOptimizer, ToySimulators
from tests.support.toy_daemon import CAMPAIGN, HeldBench, HeldLaboratory
from tests.support.waiting import PATIENCE

pytest.importorskip("playwright")

WAIT = 20_000
"""Of the browser for what a test waits for [ms]."""

MAIN = "from orchestrator.cli.app import main; main()"

SIZES = {"small phone": (320, 640), "phone": (390, 844), "tablet": (1024, 768), "desk": (1440, 900)}


@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture
def page(chrome: Any) -> Iterator[Any]:
    """A tab in which nothing may go wrong unnoticed; `requests` has all addresses that it asked for."""
    context = chrome.new_context(viewport={"width": 1024, "height": 768}, locale="en-GB")
    context.set_default_timeout(WAIT)
    tab = context.new_page()
    tab.problems, tab.requests = [], []
    tab.on("pageerror", lambda error: tab.problems.append(str(error)))
    tab.on("request", lambda request: tab.requests.append(request.url))
    tab.on(
        "console",
        lambda line: (
            tab.problems.append(line.text) if line.type == "error" and "Failed to load" not in line.text else 0
        ),
    )
    yield tab
    context.close()
    assert tab.problems == []


def is_problem(line: Any) -> bool:
    """Whether the browser complains; of answers that are refusals it says so itself, which is meant here."""
    return line.type == "error" and not line.text.startswith("Failed to load resource")


def asking(**question: Any) -> Any:
    """Makes laboratories whose first pour asks something."""

    def make() -> HeldLaboratory:
        bench = HeldBench()
        bench.question = OperatorQuestion(**question)
        return HeldLaboratory(ToySimulators(), bench, ToyOptimizer())

    return make


REFILL = {"text": "Fill the pourer and put it on the tray.", "wants": "done", "about": "pourer_full"}


def asked(lab: OnPort) -> str:
    """A campaign that has come to its question."""
    key = lab.do(lab.served.submit())
    lab.do(lab.served.question())
    return key


@pytest.mark.slow
def test_who_has_no_token_is_asked_for_one_and_it_stays_in_the_tab(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        page.goto(lab.url)
        page.get_by_label("Token").fill("a wrong one, but long enough")
        page.get_by_role("button", name="Sign in").click()
        page.get_by_text("this token is not known").wait_for()
        page.get_by_label("Token").fill(lab.served.tokens[Role.VIEWER])
        page.keyboard.press("Enter")
        page.get_by_text("Nothing runs here.").wait_for()
        assert page.evaluate("Object.keys(localStorage).length + document.cookie.length") == 0
        page.goto(lab.address())
        wait_until(page, lambda: page.url == f"{lab.url}/")
        page.get_by_text("Nothing runs here.").wait_for()


def test_a_question_is_answered_with_one_press_and_the_pour_goes_on(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, asking(**REFILL)) as lab:
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_text("Nothing runs here.").wait_for()
        key = asked(lab)
        page.get_by_role("heading", name="Fill the pourer and put it on the tray.").wait_for()
        page.get_by_text("A question: Fill the pourer").wait_for(state="attached")
        assert page.locator("#call").get_attribute("aria-live") == "assertive"
        wait_until(page, lambda: "(1) question" in page.title())
        page.get_by_role("button", name="Done").click()
        wait_until(page, lambda: lab.served.laboratories[0].bench.answers[:1] == ["done"])
        wait_until(page, lambda: lab.do(lab.served.get(f"/campaigns/{key}"))["pours_made"][0]["state"] == "weighed")


@pytest.mark.slow
def test_a_missed_dose_is_decided_with_one_press(page: Any, tmp_path: Path) -> None:
    options = ("accept", "correct", "repeat")
    decision = {"text": "Dose 3 missed its tolerance.", "wants": "option", "options": options, "about": "decision"}
    with on_port(tmp_path, asking(**decision, hands=False)) as lab:
        asked(lab)
        page.goto(lab.address(Role.OPERATOR))
        for name in ("Leave it as it is", "Pour it again"):
            page.get_by_role("button", name=name).wait_for()
        page.get_by_role("button", name="Correct the other amounts").click()
        wait_until(page, lambda: lab.served.laboratories[0].bench.answers[:1] == ["correct"])


@pytest.mark.slow
def test_a_chart_out_of_control_is_a_picture_with_what_to_check(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
    monkeypatch.setenv(VARIABLE, "")
    use_state_directory(tmp_path / "state")
    import laboratory_months as months

    days = [
        months.Bench(months.np.random.default_rng(day), film=0.002 * (day > 11), balance=0.01 * (day == 13))
        for day in range(14)
    ]
    months.enter([months.write_day(tmp_path / "days", day, bench) for day, bench in enumerate(days)])
    with on_port(tmp_path) as lab:
        page.goto(lab.address(Role.VIEWER))
        section = page.locator("#charts")
        section.get_by_text("wash and dry the receiver").wait_for()
        assert section.locator("svg").count() == 9
        assert section.get_by_role("img", name="zero of the balance: in control").count() == 1
        assert section.locator("figure", has_text="film in the receiver").locator("circle.out").count() == 2


@pytest.mark.slow
def test_a_keyboard_alone_answers_and_stops(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, asking(**REFILL | {"wants": "yes or no", "text": "May the arm move?"})) as lab:
        asked(lab)
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_role("button", name="Yes").wait_for()
        names = []
        for _ in range(14):
            page.keyboard.press("Tab")
            names.append(page.evaluate("document.activeElement.textContent.trim()"))
            if names[-1] == "No":
                page.keyboard.press("Enter")
                break
        assert names[-2:] == ["Yes", "No"]
        page.wait_for_timeout(300)
        while page.evaluate("document.activeElement.id") != "stop-all":
            page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        page.get_by_role("heading", name="Emergency stop").wait_for()
        assert lab.served.laboratories[0].bench.answers[0] == "no"


@pytest.mark.slow
def test_a_weight_is_typed_as_people_type_it_and_a_wrong_one_is_told(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, asking(text="Weigh the tray.", wants="weight", hands=False)) as lab:
        asked(lab)
        page.goto(lab.address(Role.OPERATOR))
        weight = page.get_by_label("Weight")
        weight.fill("twelve")
        page.get_by_role("button", name="Send the weight").click()
        assert not page.evaluate("document.querySelector('.weights').checkValidity()")
        assert lab.served.laboratories[0].bench.answers == []
        weight.fill("1,234")
        page.get_by_role("button", name="Send the weight").click()
        page.get_by_text("'1,234 g' may be 1.234 g or 1234 g").wait_for()
        assert lab.served.laboratories[0].bench.answers == []
        weight.fill("12,3")
        page.get_by_role("button", name="Send the weight").click()
        lab.do(lab.served.pouring())
        wait_until(page, lambda: lab.served.laboratories[0].bench.answers[:1] == ["12,3 g"])


@pytest.mark.slow
def test_what_somebody_types_survives_all_news(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, asking(text="Weigh the tray.", wants="weight")) as lab:
        key = asked(lab)
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_label("Weight").fill("3.")
        lab.do(lab.served.submit(priority=5))
        page.get_by_text("Take out").wait_for()
        assert page.get_by_label("Weight").input_value() == "3."
        assert page.evaluate("document.activeElement.tagName") == "INPUT"
        assert key


def test_the_emergency_stop_is_one_press_and_is_latched_until_it_is_cleared(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        key = lab.do(lab.served.submit())
        laboratory = lab.do(lab.served.pouring())
        page.goto(lab.address())
        page.get_by_text("tilting").wait_for()
        page.get_by_role("button", name="EMERGENCY STOP").click()
        page.get_by_role("heading", name="Emergency stop").wait_for()
        wait_until(page, lambda: laboratory.arm_stops == 1)
        assert lab.do(lab.served.until(key, "unknown"))["state"] == "unknown"
        page.locator("header").get_by_text("STOPPED").wait_for()
        page.get_by_role("button", name="Clear the stop").click()
        page.get_by_role("button", name="Yes, clear the stop").click()
        page.get_by_role("heading", name="Emergency stop").wait_for(state="hidden")
        assert lab.do(lab.served.get("/status"))["emergency"] is None


PHYSICAL = "To stop the arm, press the physical emergency stop: the red mushroom button on the teach pendant."


def test_signed_out_the_page_claims_no_stop_and_names_the_physical_one(page: Any, tmp_path: Path) -> None:
    """The token is no longer valid while a stop is latched; then the stop is cleared elsewhere."""
    with on_port(tmp_path) as lab:
        page.goto(lab.url)
        page.get_by_label("Token").wait_for()
        assert page.locator("#no-stop").is_visible()
        page.goto(lab.address())
        page.get_by_role("button", name="EMERGENCY STOP").click()
        page.get_by_role("heading", name="Emergency stop").wait_for()
        page.locator("header").get_by_text("STOPPED").wait_for()
        assert not page.locator("#no-stop").is_visible()
        wait_until(page, lambda: page.title().startswith("STOPPED"))

        unknown = {"detail": "this token is not known"}
        page.route("**/api/v1/**", lambda route: route.fulfill(status=401, json=unknown))
        page.get_by_label("Token").wait_for()
        lab.do(lab.served.post("/emergency-stop/clear", role=Role.ADMIN))
        shown = page.locator("body").inner_text()
        assert "stop request to all arms" not in shown
        assert "STOPPED" not in shown
        assert page.title() == "Decant"
        assert not page.get_by_role("button", name="EMERGENCY STOP").is_visible()
        assert PHYSICAL in " ".join(shown.split())
        assert in_view(page.locator("#no-stop"))

        page.unroute("**/api/v1/**")
        page.get_by_label("Token").fill(lab.served.tokens[Role.ADMIN])
        page.keyboard.press("Enter")
        page.get_by_text("Nothing runs here.").wait_for()
        assert page.get_by_role("heading", name="Emergency stop").count() == 0
        assert page.get_by_role("button", name="EMERGENCY STOP").is_enabled()


def test_a_page_whose_script_does_not_start_names_the_physical_stop(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        page.route("**/page.js", lambda route: route.abort())
        page.goto(lab.url)
        assert PHYSICAL in " ".join(page.locator("#no-stop").inner_text().split())


@pytest.mark.slow
@pytest.mark.parametrize(
    "act", ["Enter", *(pytest.param(act, marks=pytest.mark.slow) for act in ("Escape", "second press"))]
)
def test_the_default_answer_to_clearing_a_stop_keeps_it(page: Any, tmp_path: Path, act: str) -> None:
    with on_port(tmp_path) as lab:
        page.goto(lab.address())
        page.get_by_role("button", name="EMERGENCY STOP").click()
        clear = page.get_by_role("button", name="Clear the stop")
        clear.wait_for()
        if act == "second press":
            box = clear.bounding_box()
            page.mouse.dblclick(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            page.get_by_role("button", name="No, stay stopped").wait_for()
        else:
            clear.click()
            page.get_by_role("heading", name="Are all cells clear of people and obstacles?").wait_for()
            assert page.evaluate("document.activeElement.textContent") == "No, stay stopped"
            page.keyboard.press(act)
            page.get_by_role("button", name="No, stay stopped").wait_for(state="detached")
        assert lab.do(lab.served.get("/status"))["emergency"]["by"] == "admin"


@pytest.mark.slow
@pytest.mark.realtime
def test_the_card_of_an_idle_rig_says_why_its_arm_cannot_move_and_what_to_do(page: Any, tmp_path: Path) -> None:
    with VirtualController.start("127.81.4.9", "ur10e") as controller:
        rig = hardware_rig(tmp_path, controller.address, "ur10e")
        with on_port(tmp_path, rigs=(rig,), arm_interval=0.1) as lab:
            page.goto(lab.address(Role.VIEWER))
            card = page.get_by_role("article", name="rig rig")
            card.get_by_text("Arm: the arm is ready to move").wait_for()
            controller.fault("protective_stop", reason="a test")
            card.get_by_text(
                re.compile(r"The arm can't move \(since [\d:. APM]+\): protective stop is in force")
            ).wait_for()
            card.get_by_text("Find the cause, then unlock it on the teach pendant").wait_for()
            page.locator("#cells li").filter(has_text="rig: arm can't move").wait_for()


@pytest.mark.slow
def test_with_two_rigs_each_is_stopped_and_cleared_alone_and_all_together(page: Any, tmp_path: Path) -> None:
    laboratory = tmp_path / "numbers.yaml"
    laboratory.write_text("{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n")
    rigs = tuple(Rig(name, laboratory, load_laboratory(laboratory)) for name in ("left", "right"))
    with on_port(tmp_path, campaign=CAMPAIGN, rigs=rigs) as lab:
        keys = [lab.do(lab.served.submit(rig=rig.name)) for rig in rigs]
        for key in keys:
            lab.do(lab.served.until(key, "running"))
        wait_until(page, lambda: len(lab.served.laboratories) == 2)
        for one in lab.served.laboratories:
            lab.do(one.bench.begun.wait())
        page.goto(lab.address())
        lines = page.locator("#cells li")
        lines.filter(has_text="left: arm moves").wait_for()
        lines.filter(has_text="right: arm moves").wait_for()
        page.get_by_role("button", name="STOP left").click()
        page.get_by_role("heading", name="Emergency stop of left").wait_for()
        lines.filter(has_text="left: STOPPED").wait_for()
        assert sorted(one.arm_stops for one in lab.served.laboratories) == [0, 1]
        assert lines.filter(has_text="right: arm moves").count() == 1
        lab.do(lab.served.until(keys[0], "unknown"))
        told = lab.do(lab.served.post(f"/campaigns/{keys[0]}/resume", status=409))
        assert "emergency stop of rig left is latched" in told["detail"]
        page.get_by_role("button", name="EMERGENCY STOP ALL").click()
        lines.filter(has_text="right: STOPPED").wait_for()
        assert [one.arm_stops for one in lab.served.laboratories] == [1, 1]
        page.get_by_role("button", name="Clear the stop", exact=True).click()
        page.get_by_role("button", name="Yes, clear the stop").click()
        lines.filter(has_text="right: idle").wait_for()
        assert lines.filter(has_text="left: STOPPED").count() == 1  # its own stop is cleared by itself
        page.get_by_role("button", name="Clear the stop of left").click()
        page.get_by_role("button", name="Yes, clear the stop").click()
        lines.filter(has_text="left: idle").wait_for()


@pytest.mark.slow
def test_an_arm_that_did_not_confirm_its_stop_is_not_missed(page: Any, tmp_path: Path) -> None:
    text = "the arm of north did not confirm that it was stopped (no answer): use its own button"
    with on_port(tmp_path) as lab:
        page.goto(lab.address(Role.VIEWER))
        page.get_by_text("Nothing runs here.").wait_for()
        wait_until(page, lambda: lab.served.daemon.feed.readers > 0)
        lab.loop.call_soon_threadsafe(
            lab.served.daemon.feed.publish, "LogLine", {"level": "error", "text": text, "stage": ""}
        )
        page.get_by_role("alert").get_by_text(text).wait_for()
        assert page.evaluate(LEGIBLE) == []
        page.get_by_role("button", name="Read").click()
        page.get_by_text(text).wait_for(state="detached")


@pytest.mark.slow
def test_a_viewer_may_stop_everything_but_answers_nothing(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, asking(**REFILL)) as lab:
        asked(lab)
        lab.do(lab.served.submit())
        page.goto(lab.address(Role.VIEWER))
        page.get_by_text("An operator answers.").wait_for()
        page.get_by_text("viewer (viewer)").wait_for()
        for name in ("Done", "Give it up", "Hold the queue", "Take out", "Pause", "Finish and end", "Stop the motion"):
            assert page.get_by_role("button", name=name).count() == 0, name
        page.get_by_role("button", name="EMERGENCY STOP").click()
        page.get_by_text("An administrator clears it.").wait_for()
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_role("button", name="Hold the queue").wait_for()
        assert page.get_by_role("button", name="Clear the stop").count() == 0


@pytest.mark.slow
def test_the_header_of_four_rigs_is_one_line_on_a_phone_and_each_rig_has_its_stop(page: Any, tmp_path: Path) -> None:
    laboratory = tmp_path / "numbers.yaml"
    laboratory.write_text("{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n")
    names = ("north", "south", "east", "west")
    rigs = tuple(Rig(name, laboratory, load_laboratory(laboratory)) for name in names)
    page.set_viewport_size({"width": 390, "height": 844})
    with on_port(tmp_path, rigs=rigs) as lab:
        page.goto(lab.address(Role.VIEWER))
        page.get_by_role("button", name="STOP north").wait_for()
        assert page.locator("#head").bounding_box()["height"] <= 90
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert page.evaluate(LEGIBLE) == []
        page.evaluate("scrollTo(0, document.body.scrollHeight)")
        box = page.get_by_role("button", name="EMERGENCY STOP ALL").bounding_box()
        assert 0 <= box["y"] <= 90
        for name in names:
            assert page.get_by_role("button", name=f"STOP {name}").count() == 1
        page.get_by_role("button", name="STOP east").click()
        page.get_by_role("heading", name="Emergency stop of east").wait_for()
        page.get_by_role("article", name="rig east").get_by_text("STOPPED").wait_for()


@pytest.mark.slow
@pytest.mark.parametrize("size", ["small phone", "phone"])
def test_a_question_makes_the_header_of_a_phone_no_higher(page: Any, tmp_path: Path, size: str) -> None:
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    with on_port(tmp_path, asking(**REFILL)) as lab:
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_text("Nothing runs here.").wait_for()
        before = page.locator("#head").bounding_box()["height"]
        asked(lab)
        page.get_by_role("button", name="1 question").wait_for()
        assert page.locator("#head").bounding_box()["height"] == before <= 90
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        stop, question = (page.get_by_role("button", name=name) for name in ("EMERGENCY STOP", "1 question"))
        for shown in (stop, question, page.locator("#link"), page.locator("#mode")):
            assert in_view(shown)
        assert question.evaluate("(button) => button.scrollWidth <= button.clientWidth")
        assert question.bounding_box()["x"] + question.bounding_box()["width"] <= stop.bounding_box()["x"]
        assert page.evaluate(LEGIBLE) == []


@pytest.mark.slow
def test_real_and_virtual_cannot_be_mistaken(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        page.goto(lab.address())
        page.get_by_text("nothing real moves").wait_for()
        assert page.locator("header").get_by_text("VIRTUAL", exact=True).is_visible()
        virtual = page.evaluate("getComputedStyle(document.querySelector('header')).background")
    real = Rig("north", tmp_path / "north.yaml", LaboratorySettings(name="north", mode="hardware"))
    with on_port(tmp_path / "other", rigs=(real,)) as lab:
        page.goto(lab.address())
        page.get_by_text("north: a real arm").wait_for()
        assert page.locator("header").get_by_text("REAL", exact=True).is_visible()
        assert page.locator("article").get_by_text("REAL", exact=True).is_visible()
        assert page.evaluate("getComputedStyle(document.querySelector('header')).background") != virtual


@pytest.mark.slow
def test_the_queue_is_held_reordered_and_emptied(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        lab.do(lab.served.submit())
        lab.do(lab.served.pouring())
        second, third = lab.do(lab.served.submit()), lab.do(lab.served.submit())
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_role("button", name="Earlier").click()
        wait_until(page, lambda: queued(lab) == [third, second])
        page.get_by_role("button", name="Hold the queue").click()
        page.get_by_text("The queue is held").wait_for()
        assert lab.do(lab.served.get("/status"))["queue_paused"]
        page.get_by_role("button", name="Take out").first.click()
        wait_until(page, lambda: queued(lab) == [second])
        page.get_by_role("button", name="Pause", exact=True).click()
        wait_until(page, lambda: lab.do(lab.served.get("/campaigns"))[0]["desired_state"] == "pause")


@pytest.mark.slow
def test_pours_stand_with_what_was_expected_and_what_was_spilled(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, HeldLaboratory) as lab:
        key = lab.do(lab.served.submit())
        found = lab.do(lab.served.until(key, "finished"))
        page.goto(lab.address())
        page.locator("#pours tbody tr").first.wait_for()
        rows = page.locator("#pours tbody tr").all_inner_texts()
        assert len(rows) == len(found["pours_made"]) == 3
        assert f"{found['pours_made'][-1]['spilled_g']:.1f} g" in rows[0]
        assert found["pours_made"][-1]["predicted"] in rows[0]
        heads = page.locator("#pours thead th").all_inner_texts()
        assert (heads[0], heads[-1]) == ("Campaign", "Spilled")
        cells = page.locator("#pours tbody tr").first.locator("td").all_inner_texts()
        assert cells[0] == "cup"
        assert cells[5].split("\n")[-1].strip() == "(spilled + retained) / loaded"


def rack_of(page: Any) -> dict[str, str]:
    """The word at each cup of the rack's picture, by the cup's name, once the picture is shown."""
    image = page.locator("#racks img")
    wait_until(page, lambda: image.evaluate("(image) => image.complete && image.naturalWidth > 100"))
    texts = re.findall(r">([^<>]+)</text>", unquote(image.get_attribute("src")))
    names = [i for i, text in enumerate(texts) if re.fullmatch(r"[A-D][1-6]", text)]
    return {texts[i]: texts[i + 1] for i in names}


def test_the_rack_of_mixtures_fills_and_is_the_same_after_a_reload(page: Any, tmp_path: Path) -> None:
    page.set_viewport_size({"width": 320, "height": 640})
    with on_port(tmp_path, held_dose, campaign=MIXTURES) as lab:
        page.goto(lab.address(Role.VIEWER))
        page.get_by_text("Nothing runs here.").wait_for()
        assert page.locator("#racks").is_hidden()
        key = lab.do(lab.served.submit())
        lab.do(lab.served.pouring()).bench.begun.clear()
        page.locator("#racks img").wait_for()
        wait_until(page, lambda: rack_of(page) == {"B2": "being filled", "A1": "empty"})
        page.get_by_text("As a table").click()
        lab.served.laboratories[0].bench.go.set()
        wait_until(page, lambda: rack_of(page) == {"B2": "done", "A1": "done"})
        poured = lab.do(lab.served.get(f"/campaigns/{key}"))["mixtures"]
        rows = page.locator("#racks tbody tr").all_inner_texts()  # the table is open as it was
        for row, component in zip(rows, poured, strict=True):
            assert f"{component['received_g']:.2f}" in row
        assert page.evaluate("document.documentElement.scrollWidth") <= 320
        page.reload()
        wait_until(page, lambda: page.locator("#racks img").count() and rack_of(page) == {"B2": "done", "A1": "done"})


@pytest.mark.slow
def test_a_daemon_that_was_started_again_shows_the_cup_that_is_unknown(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, held_dose, campaign=MIXTURES) as lab:
        key = lab.do(lab.served.submit())
        lab.do(lab.served.pouring())
        page.goto(lab.address())
        page.locator("#racks img").wait_for()
        wait_until(page, lambda: rack_of(page) == {"B2": "being filled", "A1": "empty"})
        for _ in range(2):
            lab.do(lab.served.post(f"/campaigns/{key}/abort"))
        lab.do(lab.served.until(key, "unknown"))
        wait_until(page, lambda: rack_of(page) == {"B2": "UNKNOWN", "A1": "empty"})
    with on_port(tmp_path, held_dose, campaign=MIXTURES) as lab:
        page.goto(lab.address())
        page.locator("#racks img").wait_for()
        wait_until(page, lambda: rack_of(page) == {"B2": "UNKNOWN", "A1": "empty"})
        lab.do(lab.served.post(f"/campaigns/{key}/resume"))
        lab.do(lab.served.question())
        page.get_by_role("button", name="Lost: outcome unknown").wait_for()
        wait_until(page, lambda: rack_of(page) == {"B2": "UNKNOWN", "A1": "empty"})
        page.get_by_role("button", name="Lost: outcome unknown").click()
        wait_until(page, lambda: rack_of(page) == {"B2": "UNKNOWN", "A1": "being filled"})


class NightLaboratory(HeldLaboratory):
    """Tells what a bench tells of pours without a person."""

    def listen(self, hear: Any) -> None:
        for level, about, text in (
            ("note", "laid_out", "operator (laid_out): Put the receiver on the place 'right'. → 'done' after 4.0 s"),
            ("info", "consent", "unattended: agreed, up to 200 pours until 2026-11-27 07:00"),
            (
                "note",
                "accounted",
                "poured back: 163.62 g left the receiver, 163.58 g are in the pourer, missing 0.04 ± 0.05 g",
            ),
            ("warning", "fault", "unattended: the consent has ended. a question: protective stop during carry"),
            (
                "note",
                "recover",
                "operator (recover): The arm was stopped. Shall it be made ready again? → 'yes' after 12.0 s",
            ),
            ("note", "move", "operator (move): Hands out of the cell. May it? → 'yes' after 1.0 s"),
        ):
            hear(Notice(level, text, about=about))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_night_is_one_timeline_of_pours_masses_faults_and_answers(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, NightLaboratory) as lab:
        key = lab.do(lab.served.submit())
        found = lab.do(lab.served.until(key, "finished"))
        assert [one["kind"] for one in found["night"]] == ["consent", "accounted", "fault", "answer", *["pour"] * 3]
        page.goto(lab.address())
        page.locator("#night li").first.wait_for()
        assert re.fullmatch(r"3 pours since \d\d:\d\d, 1 fault", page.locator("#night p").inner_text())
        lines = page.locator("#night li").all_inner_texts()
        assert "Pour" in lines[0]  # the newest first
        assert "g spilled" in lines[0]
        assert "agreed, up to 200 pours" in lines[-1]
        assert "protective stop during carry" in page.locator("#night .fault").inner_text()
        assert "Shall it be made ready again? → 'yes' after 12.0 s" in page.locator("#night .answer").inner_text()


@pytest.mark.slow
def test_the_question_about_an_unknown_dose_is_answered_on_a_phone_without_scrolling(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, held_dose, campaign=MIXTURES) as lab:
        key = lab.do(lab.served.submit())
        lab.do(lab.served.pouring())
        for _ in range(2):
            lab.do(lab.served.post(f"/campaigns/{key}/abort"))
        lab.do(lab.served.until(key, "unknown"))
        lab.do(lab.served.post(f"/campaigns/{key}/resume"))
        details = lab.do(lab.served.question())["details"]
        assert {"liquid", "from", "into", "wanted_g", "last_reading_g", "load_g", "diagnostics"} <= details.keys()
        width, height = SIZES["phone"]
        page.set_viewport_size({"width": width, "height": height})
        page.goto(lab.address())
        field = page.get_by_label("Received by the cup")
        field.wait_for()
        card = page.locator("article.question")
        card.evaluate("card => card.scrollIntoView()")
        top, last = card.bounding_box()["y"], page.get_by_role("button", name="Send the weight").bounding_box()
        assert last["y"] + last["height"] - top <= height
        assert page.get_by_text("bench: simulated").is_hidden()  # diagnostics are folded
        page.get_by_text("What arm and balance show now").click()
        page.get_by_text("bench: simulated").wait_for()
        field.fill("19.5")
        page.get_by_role("button", name="Send the weight").click()
        wait_until(page, lambda: rack_of(page)["B2"] != "UNKNOWN")


@pytest.mark.slow
def test_a_pour_without_outcome_reads_unknown_while_its_question_is_open(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        key = lab.do(lab.served.submit())
        lab.do(lab.served.pouring())
        page.goto(lab.address())
        pour = page.locator("#pours tbody tr").first
        pour.get_by_text("under way").wait_for()
        page.get_by_role("button", name="Stop the motion").click()
        page.get_by_role("button", name="Stop the motion").click()
        pour.get_by_text("UNKNOWN").wait_for()
        lab.do(lab.served.until(key, "unknown"))
        lab.do(lab.served.post(f"/campaigns/{key}/resume"))
        lab.do(lab.served.question())
        page.get_by_role("button", name="Lost: outcome unknown").wait_for()
        assert page.locator("#pours").get_by_text("UNKNOWN").count() == 1
        assert page.locator("#pours").get_by_text("under way").count() == 0


@pytest.mark.slow
def test_news_that_never_pause_hide_nothing(page: Any, tmp_path: Path) -> None:
    """An arm tells where it is many times a second; what else happens is seen all the same."""
    with on_port(tmp_path) as lab:
        page.add_init_script("window.setInterval = () => 0")  # it also looks every few seconds, which would hide it
        page.goto(lab.address())
        page.get_by_text("Nothing runs here.").wait_for()

        async def chatter() -> None:
            key = await lab.served.submit()
            while lab.sockets:
                lab.served.daemon.feed.publish("PourProgressed", {"number": 1}, key, kept=False)
                await asyncio.sleep(0.1)

        asyncio.run_coroutine_threadsafe(chatter(), lab.loop)
        page.locator(".step", has_text="tilting").wait_for()
        page.wait_for_timeout(300)
        lab.do(lab.served.post("/queue/pause"))
        page.get_by_text("The queue is held").wait_for()
        lab.sockets.clear()


@pytest.mark.slow
def test_a_lost_connection_is_told_with_what_to_do(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        page.goto(lab.address())
        page.get_by_text("Nothing runs here.").wait_for()
        page.context.set_offline(True)
        page.locator("#lost").get_by_text("the red mushroom button on the teach pendant").wait_for()
        page.context.set_offline(False)
        page.get_by_text("No connection to the daemon").wait_for(state="hidden")
        assert page.get_by_role("button", name="EMERGENCY STOP").is_enabled()


@pytest.mark.parametrize("end", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", [pytest.param("small phone", marks=pytest.mark.slow), "desk"])
def test_without_a_daemon_the_stop_is_disabled_and_the_physical_one_is_named(
    page: Any, tmp_path: Path, size: str, end: signal.Signals
) -> None:
    """A daemon that is killed, and one that hangs."""
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    with a_process(tmp_path) as (process, address):
        page.goto(address)
        stop = page.get_by_role("button", name="EMERGENCY STOP")
        wait_until(page, stop.is_enabled)
        page.evaluate("document.body.style.minHeight = '3000px'; scrollTo(0, 3000)")
        assert in_view(stop)
        os.kill(process.pid, end)
        alert = page.get_by_role("alert").filter(has_text="the stop in this page does NOT work now")
        alert.wait_for()
        assert "press the physical emergency stop: the red mushroom button on the teach pendant" in alert.inner_text()
        assert in_view(alert)
        assert alert.bounding_box()["width"] == page.evaluate("document.documentElement.clientWidth")
        assert stop.is_disabled()
        assert in_view(page.locator("#mode"))
        assert in_view(page.locator("#link").filter(has_text="NO CONNECTION"))


@pytest.mark.slow
def test_a_stop_that_is_pressed_in_vain_is_not_missed(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        page.goto(lab.address())
        page.get_by_text("Nothing runs here.").wait_for()
        page.route("**/emergency-stop?*", lambda route: route.abort())
        page.get_by_role("button", name="EMERGENCY STOP").click()
        alert = page.get_by_role("alert").filter(has_text="EMERGENCY STOP was not confirmed: press the physical")
        alert.wait_for()
        assert in_view(alert)


@pytest.mark.slow
def test_nothing_but_the_operator_scrolls_the_page(page: Any, tmp_path: Path) -> None:
    """A question comes and goes while the operator looks at something else: that stays where it is."""
    page.set_viewport_size({"width": 390, "height": 600})
    with on_port(tmp_path, asking(**REFILL)) as lab:
        page.goto(lab.address())
        page.get_by_text("Nothing runs here.").wait_for()
        page.evaluate("document.body.style.minHeight = '3000px'")  # what is looked at can be the first in view
        page.evaluate("scrollTo(0, document.querySelector('#previous-head').offsetTop - 100)")
        assert page.evaluate("scrollY") > 0
        where = "document.querySelector('#previous-head').getBoundingClientRect().top"
        before = page.evaluate(where)
        asked(lab)
        page.get_by_role("button", name="1 question").wait_for()
        assert abs(page.evaluate(where) - before) < 2
        lab.served.laboratories[0].bench.question = None  # the pours after this one ask nothing
        number = lab.do(lab.served.get("/questions"))[0]["id"]
        lab.do(lab.served.post(f"/questions/{number}/answer", {"answer": "done"}))
        page.get_by_role("button", name="1 question").wait_for(state="detached")
        assert page.evaluate("scrollY") > 0


@pytest.mark.slow
def test_it_asks_nobody_else_and_shows_texts_as_texts(page: Any, tmp_path: Path) -> None:
    nasty = "<img src=x onerror=\"document.title='broken in'\"><script>document.title='broken in'</script>"
    with on_port(tmp_path, asking(text=nasty, wants="done", details={"note": nasty})) as lab:
        asked(lab)
        response = page.goto(lab.address())
        page.get_by_role("heading", name="<img src=x").wait_for()
        assert page.locator("#questions img, #questions script").count() == 0
        assert page.title() != "broken in"
        policy = response.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert {url for url in page.requests if not url.startswith((lab.url, "data:"))} == set()


LEGIBLE = """() => {
  const parse = (text) => { const m = text.match(/[\\d.]+/g).map(Number); return [...m.slice(0, 3), m[3] ?? 1]; };
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
    .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const bad = [];
  for (const one of document.querySelectorAll("body *")) {
    const own = [...one.childNodes].some((n) => n.nodeType === 3 && n.data.trim());
    if (!own || !one.checkVisibility() || one.closest(".unseen, .skip, noscript, :disabled")) continue;
    let ground = one;
    while (ground && parse(getComputedStyle(ground).backgroundColor)[3] === 0) ground = ground.parentElement;
    const style = getComputedStyle(one);
    const back = ground ? parse(getComputedStyle(ground).backgroundColor) : [255, 255, 255, 1];
    const [a, b] = [light(parse(style.color)), light(back)].sort((x, y) => y - x);
    const big = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.6 && +style.fontWeight >= 700);
    if ((a + 0.05) / (b + 0.05) < (big ? 3 : 4.5)) bad.push(`${one.tagName} '${one.textContent.slice(0, 30)}'`);
  }
  for (const one of document.querySelectorAll("button, input, summary")) {
    const box = one.getBoundingClientRect();
    if (one.checkVisibility() && (box.height < 44 || box.width < 44)) bad.push(`small: ${one.textContent || one.id}`);
  }
  return bad;
}"""


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [pytest.param("light", marks=pytest.mark.slow), "dark"])
def test_everything_is_legible_and_large_enough(page: Any, tmp_path: Path, scheme: str) -> None:
    """Contrast 4.5 : 1 (3 : 1 for large letters; WCAG 2.2 AA), targets of 44 px."""
    page.emulate_media(color_scheme=scheme)
    with on_port(tmp_path, asking(**REFILL | {"problem": "the balance shows 3 g"})) as lab:
        page.goto(lab.url)
        page.get_by_label("Token").wait_for()
        assert page.evaluate(LEGIBLE) == []
        asked(lab)
        lab.do(lab.served.submit())
        page.goto(lab.address())
        page.get_by_role("button", name="Done").wait_for()
        page.get_by_text("Take out").wait_for()
        page.get_by_text("This pour can't be made").click()
        assert page.evaluate(LEGIBLE) == []
        page.get_by_role("button", name="EMERGENCY STOP").click()
        page.get_by_role("heading", name="Emergency stop").wait_for()
        page.get_by_role("button", name="Clear the stop").click()
        assert page.evaluate(LEGIBLE) == []
        page.context.set_offline(True)
        page.get_by_text("does NOT work now").wait_for()
        assert page.evaluate(LEGIBLE) == []


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_it_fits_every_screen_with_the_stop_in_reach(page: Any, tmp_path: Path, size: str) -> None:
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    with on_port(tmp_path, asking(**REFILL)) as lab:
        asked(lab)
        page.goto(lab.address())
        page.get_by_role("button", name="Done").wait_for()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        for place in ("0", "document.body.scrollHeight"):
            page.evaluate(f"scrollTo(0, {place})")
            box = page.get_by_role("button", name="EMERGENCY STOP").bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width
            assert box["y"] + box["height"] <= height
        answer = page.get_by_role("button", name="Done").bounding_box()
        assert answer["height"] >= 72


@pytest.mark.slow
def test_a_screen_reader_finds_its_way(page: Any, tmp_path: Path) -> None:
    with on_port(tmp_path, asking(**REFILL)) as lab:
        asked(lab)
        page.goto(lab.address())
        page.get_by_role("button", name="Done").wait_for()
        for role in ("banner", "main"):
            assert page.get_by_role(role).count() == 1
        for name in ("Questions", "Now", "Last pours", "Queue", "Finished", "Previous runs", "Stop"):
            assert page.get_by_role("region", name=name, exact=True).count() == 1
        assert page.get_by_role("article", name="Fill the pourer").count() == 1
        assert page.evaluate("document.documentElement.lang") == "en"
        assert page.evaluate("document.activeElement.tagName") == "H2"  # the question, where nobody stood elsewhere


@pytest.mark.slow
def test_former_runs_are_found_and_what_is_noted_of_them_is_found_again(
    page: Any, tmp_path: Path, former: None
) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    with on_port(tmp_path, HeldLaboratory) as lab:
        key = lab.do(lab.served.submit())
        run = lab.do(lab.served.until(key, "finished"))["run"]
        page.goto(lab.address(Role.OPERATOR))
        page.get_by_label("Vessel, liquid, tag, any words").fill("narrow water")
        page.get_by_role("button", name="Find").click()
        found = page.locator("#previous li")
        found.get_by_text(run).wait_for()
        assert page.evaluate(LEGIBLE) == []
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.once("dialog", lambda asked: asked.accept("the tray was <b>wet</b>"))
        found.get_by_role("button", name="Note").click()
        found.get_by_text("the tray was <b>wet</b>").wait_for()
        with page.expect_download() as saved:
            found.get_by_role("button", name="Save report").click()
        assert saved.value.suggested_filename == f"{run}.html"
        page.get_by_label("Vessel, liquid, tag, any words").fill("narrow glycerol")
        page.keyboard.press("Enter")
        page.get_by_text("No run has all of this.").wait_for()


@pytest.fixture
def former(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The daemon's runs are in the catalogue of its own state directory, as `decant server start` has it."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "state"))


@contextlib.contextmanager
def a_process(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """`decant server start` as a process of its own, and the address of its page with a token."""
    settings, state = folder / "decant.yaml", folder / "state"
    settings.write_text("{listen: {port: 0}, in_process: true, keep_free: 40 MB}\n")
    command = [sys.executable, "-c", MAIN, "server", "start", str(settings), "--state", str(state)]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=dict(os.environ), start_new_session=True)
    try:
        deadline = time.monotonic() + PATIENCE
        while not answers(state / "url"):
            assert process.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield process, f"{(state / 'url').read_text().strip()}/#token={token_of(state / 'tokens', Role.ADMIN)}"
    finally:
        process.kill()
        process.wait()


def answers(address: Path) -> bool:
    """Whether a daemon that writes its address into a file answers there."""
    try:
        return httpx.get(f"{address.read_text().strip()}/healthz", trust_env=False).is_success
    except (OSError, httpx.HTTPError):
        return False


IN_VIEW = """(one) => {
  const box = one.getBoundingClientRect(), root = document.documentElement;
  const inside = box.top >= 0 && box.left >= 0 && box.bottom <= root.clientHeight && box.right <= root.clientWidth;
  return inside && one.contains(document.elementFromPoint((box.left + box.right) / 2, (box.top + box.bottom) / 2));
}"""


def in_view(found: Any) -> bool:
    """Whether all of an element is within the window, and nothing lies over its middle."""
    return bool(found.evaluate(IN_VIEW))


def queued(lab: OnPort) -> list[str]:
    return [one["id"] for one in lab.do(lab.served.get("/campaigns", state="queued"))]


def wait_until(page: Any, met: Any) -> None:
    for _ in range(int(WAIT / 50)):
        if met():
            return
        page.wait_for_timeout(50)
    raise AssertionError("it did not happen")
