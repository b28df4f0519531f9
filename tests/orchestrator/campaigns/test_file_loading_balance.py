"""`file_loading`: a balance in a laboratory's file means what it says, and says where it is wrong."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import pytest

from actors.balance.balance_settings import SerialBalanceSettings, SettlingRule
from actors.balance.display_behaviour import DisplayBehaviour
from actors.balance.scale_model import ScaleSettings
from actors.balance.weighing_plan import Placement
from orchestrator.campaigns.fingerprint import deciding
from orchestrator.campaigns.yaml.section_validation import PlacedProblems, validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report
from tests.support.campaign_files import written_out


def load(text: str, mode: str = "hardware") -> SerialBalanceSettings:
    report = Report()
    place = Place(Document.parse(dedent(text), Path("lab.yaml").resolve()))
    balance = validate(SerialBalanceSettings, place, report)
    if balance is not None:
        if balance.typed:
            balance.check_manual(PlacedProblems(place, report))
        balance.check_laboratory(PlacedProblems(place, report), mode=mode)
    report.raise_if_any()
    assert balance is not None
    return balance


FULL = """
    placement: receiver
    port: /dev/serial/by-id/usb-KERN
    dialect: kern-swt
    baud: 4800
    format: "7E1"
    handshake: software
    dtr: false
    rts: false
    step: 0.05 g
    repeatability: 0.02 g
    settling: {readings: 6, span: 2 s, steps: 2, deadline: 30 s}
    interval: 0.2 s
    answer_time: 2 s
    reconnect_time: 60 s
    pourer: elsewhere
    load_tolerance: 2 g
"""
SIMPLE = "placement: tray\nport: /dev/serial/by-id/usb-KERN\n"
VIRTUAL = "virtual: {resolution: 0.01 g, noise: 0.02 g, drift: 0.001 g/s, settling_time: 2 s, capacity: 3 kg}\n"


def test_an_address_in_the_network_is_a_port_without_line_settings():
    balance = load("placement: tray\nport: 192.168.0.20:4001\ndialect: ohaus\n")
    assert (balance.port, len(balance.candidates())) == ("192.168.0.20:4001", 1)
    with pytest.raises(ConfigError) as caught:
        load("placement: tray\nport: 192.168.0.20:4001\nbaud: 9600\nrts: false\n")
    assert len(caught.value.problems) == 2
    assert "baud: has no effect over TCP; set it in the serial server" in str(caught.value)


def test_every_key_reaches_the_balance():
    serial = load(FULL)
    assert serial.position is Placement.RECEIVER
    assert serial.pourer == "elsewhere"
    assert serial.load_tolerance == pytest.approx(2e-3)
    assert (serial.port, serial.dialect, serial.baud, serial.format) == (
        "/dev/serial/by-id/usb-KERN", "kern-swt", 4800, "7E1")  # fmt: skip
    assert serial.handshake == "software"
    assert (serial.dtr, serial.rts) == (False, False)
    assert serial.step == pytest.approx(5e-5)
    assert serial.repeatability == pytest.approx(2e-5)
    assert serial.settling == SettlingRule(readings=6, span=2.0, steps=2.0, deadline=30.0)
    assert (serial.interval, serial.answer_time, serial.reconnect_time) == (0.2, 2.0, 60.0)


def test_a_port_is_enough_and_the_rest_is_found_out():
    serial = load(SIMPLE)
    assert (serial.dialect, serial.baud, serial.format) == ("auto", None, None)


def test_a_virtual_balance_has_a_data_sheet():
    sheet = ScaleSettings(resolution=1e-5, capacity=3.0, noise=2e-5, drift=1e-6, settling_time=2.0)
    assert load(VIRTUAL, mode="virtual").virtual == sheet
    assert load(VIRTUAL + "dialect: sbi\n", mode="virtual").dialect == "sbi"


def test_a_virtual_balance_behaves_as_a_real_one_if_the_laboratory_says_so():
    text = "virtual: {resolution: 2 g, behaviour: {repeat_probability: 0.42, jitter: 30 ms, creep: 0.0002}}\n"
    found = load(text + "interval: 0.2 s\n", mode="virtual").virtual
    assert found is not None
    assert found.behaviour == DisplayBehaviour(repeat_probability=0.42, jitter=0.03, creep=2e-4)


def test_an_ideal_display_leaves_the_fingerprint_of_earlier_runs():
    assert "behaviour" not in deciding(ScaleSettings())
    held = ScaleSettings(behaviour=DisplayBehaviour(repeat_probability=0.42))
    assert deciding(held)["behaviour"]["repeat_probability"] == 0.42


def test_where_the_operator_types_there_is_no_line():
    assert load("placement: manual\nload_tolerance: 1 g\n").typed


@pytest.mark.parametrize(("text", "mode"), [(FULL, "hardware"), (SIMPLE, "hardware"), (VIRTUAL, "virtual"),
                                            ("placement: manual", "hardware")])  # fmt: skip
def test_the_resolved_balance_loads_to_the_same(text, mode):
    spec = load(text, mode)
    assert load(written_out(SerialBalanceSettings, text), mode) == spec


def test_the_balance_shown_on_that_page_is_one():
    page = (Path(__file__).parents[3] / "docs" / "laboratory" / "connect-a-balance.md").read_text(encoding="utf-8")
    shown = page.partition("```yaml\nbalance:\n")[2].partition("```")[0]
    assert load(shown).placement == "tray"


@pytest.mark.parametrize(
    ("text", "mode", "said"),
    [
        ("placement: tray", "hardware", r"'tray' reads the balance; add 'port: /dev/serial/by-id/usb-…', or type"),
        ("placement: tray", "virtual", r"add 'virtual: \{resolution: 0.1 g\}'"),
        (VIRTUAL, "hardware", r"lab.yaml:1:10: virtual: a laboratory of hardware weighs on a balance that is there"),
        (SIMPLE, "virtual", r"lab.yaml:2:7: port: a virtual laboratory has no port"),
        (SIMPLE + VIRTUAL, "hardware", r"has a 'port' or is 'virtual', not both"),
        ("placement: manual\nport: x", "hardware", r"lab.yaml:2:7: port: is not used with placement 'manual'"),
        ("placement: manual\npourer: here", "hardware", r"pourer: is not used with placement 'manual'"),
        (SIMPLE + "format: 8X1", "hardware", r"lab.yaml:3:9: format: '8X1' should be bits, parity and stop bits"),
        (SIMPLE + "format: 7E1", "hardware", r"format: should be text, got the number 70.0; put it in quotes"),
        (SIMPLE + "dialect: KCP", "hardware", r"'KCP' is not known here; did you mean 'kcp'\?"),
        (SIMPLE + "baud: fast", "hardware", r"baud: should be a whole number"),
        (SIMPLE + "repeatability: 0.1", "hardware", r"0.1 has no unit; write '0.1 g'"),
        (SIMPLE + "repeatability: 0.1 kg", "hardware", r"lab.yaml:3:16: repeatability: 0.1 kg is outside 0 … 10 g"),
        (SIMPLE + "placment: tray", "hardware", r"did you mean 'placement'\?"),
        (SIMPLE + "settling: {span: 5 s, deadline: 2 s}", "hardware", r"'deadline' should be longer than 'span'"),
        (SIMPLE + "settling: {readings: 1}", "hardware", r"readings: 1 is too small; at least 2"),
        (SIMPLE + "baud: 9601", "hardware", r"lab.yaml:3:7: baud: no balance talks at 9601 baud; .* 9600, "),
        (SIMPLE + "step: 50 g", "hardware", r"lab.yaml:3:7: step: .* steps of 50 g can't tell .* load_tolerance, 5 g"),
        ("virtual: {resolution: 2 g}\nload_tolerance: 1 g", "virtual", r"lab.yaml:1:23: virtual.resolution: a display"),
        (
            "virtual: {behaviour: {repeat_probability: 1.2}}",
            "virtual",
            r"behaviour.repeat_probability: 1.2 is outside 0 … 0.95",
        ),
        ("virtual: {behaviour: {jitter: 30}}", "virtual", r"behaviour.jitter: 30 has no unit"),
        (
            "virtual: {behaviour: {longest_repeat: 0}}",
            "virtual",
            r"behaviour.longest_repeat: 0 is too small; at least 1",
        ),
        (
            "virtual: {behaviour: {repeats: 0.4}}",
            "virtual",
            r"behaviour: unknown key 'repeats'|behaviour.repeats: unknown",
        ),
        (SIMPLE + "step: 0 g", "hardware", r"step: 0 g should be above 0"),
    ],
)
def test_mistakes_are_shown_with_their_place_and_what_would_be_right(text, mode, said):
    with pytest.raises(ConfigError, match=said):
        load(text, mode)
