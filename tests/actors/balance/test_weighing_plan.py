"""`weighing_plan`: wherever the balance stands, a pour has the same masses, and nothing is assumed where a weighing
is missing.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.balance.balance_interface import BalanceError
from actors.balance.weighing_plan import Placement, Weighing, measurement, needed, weighing_uncertainty, weighings

GRAM = 1e-3
EMPTY_POURER, EMPTY_RECEIVER, TRAY = 0.0873, 0.1421, 0.4096


def weighed(
    placement: Placement,
    loaded: float,
    spilled: float,
    retained: float,
    sigma: float = 0.0,
    changed: dict | None = None,
):
    """What somebody who follows the steps reads off an exact balance; keys in `changed` are read so much more [kg]."""
    received = loaded - spilled - retained
    pourer, pan, tared = 0.0, 0.0, 0.0  # what the steps bring onto the pan
    on_pan = {
        Placement.TRAY: lambda: TRAY + (spilled if poured else 0.0),
        Placement.RECEIVER: lambda: 0.0,
        Placement.EVERYTHING: lambda: TRAY + (spilled if poured else 0.0),
        Placement.TARED: lambda: 0.0 if pourer else TRAY + (spilled if poured else 0.0),  # one or the other
        Placement.MANUAL: lambda: 0.0,
    }[placement]
    readings: dict[str, Weighing] = {}
    poured = receiver_on = False
    for step in weighings(placement):
        pourer = EMPTY_POURER if step.about.startswith("dry_pourer") else 0.0
        match step.key:
            case "pourer_empty":
                pourer = EMPTY_POURER
            case "pourer_full":
                pourer = EMPTY_POURER + loaded
            case "pourer_after":
                pourer = EMPTY_POURER + retained
            case "receiver_empty":
                receiver_on = True
            case "receiver_gone":
                receiver_on = False
        if step.do == "pour":
            poured = True
            continue
        if step.do == "tare" and placement is Placement.RECEIVER:
            receiver_on = "receiver" in step.put
        receiver = EMPTY_RECEIVER + (received if poured else 0.0) if receiver_on else 0.0
        pan = on_pan() + pourer + receiver
        if step.key.startswith("tray"):
            pan = TRAY + (spilled if poured else 0.0)
        if step.do == "tare":
            tared = pan
            continue
        net = pan if step.by == "operator" else pan - tared
        readings[step.key] = Weighing(net + (changed or {}).get(step.key, 0.0), sigma)
    return readings


POURS = st.tuples(st.floats(0.02, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0)).map(
    lambda p: (p[0], p[0] * p[1] * (1.0 - p[2]), p[0] * p[2])
)


@pytest.mark.parametrize("placement", Placement)
@given(pour=POURS)
def test_exact_weighings_give_the_masses_of_the_pour_wherever_the_balance_stands(placement, pour):
    loaded, spilled, retained = pour
    found = measurement(placement, weighed(placement, *pour))
    assert found.loaded == pytest.approx(loaded, abs=1e-9)
    assert found.spilled == pytest.approx(spilled, abs=1e-9)
    assert found.retained == pytest.approx(retained, abs=1e-9)
    assert found.notes["received_g"] / 1e3 == pytest.approx(loaded - spilled - retained, abs=2e-9)


@pytest.mark.parametrize("placement", Placement)
@given(pour=POURS, noise=st.lists(st.floats(-2e-4, 2e-4), min_size=6, max_size=6))
def test_with_noise_the_masses_still_add_up_to_the_load_and_none_is_negative(placement, pour, noise):
    sigma = 1e-4
    changed = dict(zip(needed(placement), noise, strict=False))
    found = measurement(placement, weighed(placement, *pour, sigma=sigma, changed=changed))
    masses = [found.spilled, found.retained, found.notes["received_g"] / 1e3]
    assert min(masses) >= 0.0
    assert sum(masses) == pytest.approx(found.loaded, abs=8 * sigma)


@pytest.mark.parametrize("placement", Placement)
@pytest.mark.parametrize("left_out", range(3))
def test_a_missing_weighing_is_named_with_what_to_do_and_never_assumed(placement, left_out):
    readings = weighed(placement, 0.2, 0.004, 0.01)
    key = list(readings)[left_out]
    del readings[key]
    with pytest.raises(BalanceError, match=f"not weighed: {key}") as caught:
        measurement(placement, readings)
    assert "nothing is assumed" in str(caught.value)


@pytest.mark.parametrize("placement", Placement)
def test_a_weight_that_is_no_number_is_refused(placement):
    readings = weighed(placement, 0.2, 0.004, 0.01)
    readings[next(iter(readings))] = Weighing(float("nan"))
    with pytest.raises(BalanceError, match="is not a weight"):
        measurement(placement, readings)


@pytest.mark.parametrize("placement", Placement)
def test_a_spill_of_less_than_nothing_beyond_noise_is_a_mistake(placement):
    with pytest.raises(BalanceError, match=r"spilled -\d\S* ± .* is less than nothing"):
        measurement(placement, weighed(placement, 0.2, -0.002, 0.01, sigma=1e-4))


@pytest.mark.parametrize("placement", Placement)
def test_within_noise_less_than_nothing_is_nothing_and_the_notes_keep_what_was_read(placement):
    found = measurement(placement, weighed(placement, 0.2, -1e-4, 0.01, sigma=1e-4))
    assert found.spilled == 0.0
    assert found.notes["as_weighed_g"]["spilled"] == pytest.approx(-0.1)


@pytest.mark.parametrize("placement", Placement)
def test_more_out_than_in_is_a_mistake(placement):
    with pytest.raises(BalanceError, match=r"spilled 250 ± \S+ g is more than was loaded, 200 ± "):
        measurement(placement, weighed(placement, 0.2, 0.25, 0.01, sigma=1e-4))


@pytest.mark.parametrize("placement", Placement)
def test_an_empty_pourer_taken_for_a_full_one_is_a_mistake(placement):
    with pytest.raises(BalanceError, match=r"no more than the empty one\. Was it filled"):
        measurement(placement, weighed(placement, 0.0, 0.0, 0.0, sigma=1e-4))


@pytest.mark.parametrize("placement", Placement)
def test_another_load_than_asked_for_is_refused_where_that_is_set(placement):
    readings = weighed(placement, 0.19, 0.004, 0.01)
    assert measurement(placement, readings, nominal=0.2).loaded == pytest.approx(0.19)
    with pytest.raises(BalanceError, match=r"loaded 190 ± 0 g, but 200 ± 5 g was asked for\. Fill anew"):
        measurement(placement, readings, nominal=0.2, tolerance=5 * GRAM)


def test_uncertainties_follow_from_the_weighings_and_what_cancels_adds_none():
    sigma = 0.1
    of = {
        placement: measurement(placement, weighed(placement, 0.2, 0.004, 0.01, sigma=sigma * GRAM)).notes[
            "uncertainty_g"
        ]
        for placement in Placement
    }
    assert of[Placement.TRAY]["spilled"] == pytest.approx(sigma, abs=1e-6)
    assert of[Placement.EVERYTHING]["spilled"] == pytest.approx(sigma * 2**0.5, abs=1e-6)
    # full − after − received: the empty pourer, in both loaded and retained, is in none of them.
    assert of[Placement.RECEIVER]["spilled"] == pytest.approx(sigma * 3**0.5, abs=1e-6)
    assert of[Placement.TRAY]["loaded"] == pytest.approx(sigma * 2**0.5, abs=1e-6)


def test_one_weighing_is_as_uncertain_as_its_display_and_its_repetition():
    assert weighing_uncertainty(1e-4, 0.0, tared=False) == pytest.approx(1e-4 / 12**0.5)
    assert weighing_uncertainty(0.0, 2e-4) == pytest.approx(2e-4 * 2**0.5)


@pytest.mark.parametrize("placement", Placement)
def test_steps_come_in_the_order_in_which_they_can_be_done(placement):
    steps = weighings(placement)
    order = {"once": 0, "before": 0, "pour": 1, "after": 2}
    assert [order[s.when] for s in steps] == sorted(order[s.when] for s in steps)
    assert [s.do for s in steps].count("pour") == 1
    assert sorted(s.key for s in steps if s.key) == sorted(needed(placement))
    assert all(s.put.endswith(".") for s in steps)
    first_read = next((i for i, s in enumerate(steps) if s.do == "weigh" and s.by == "balance"), None)
    if first_read is not None:
        assert any(s.do == "tare" for s in steps[:first_read])


@pytest.mark.parametrize("placement", Placement)
def test_what_is_known_of_a_vessel_is_not_asked_again(placement):
    known = {"pourer_empty": Weighing(EMPTY_POURER)}
    assert "pourer_empty" not in [s.key for s in weighings(placement, known=known)]
    readings = {k: v for k, v in weighed(placement, 0.2, 0.004, 0.01).items() if k not in known}
    assert measurement(placement, readings | known).loaded == pytest.approx(0.2)


def test_with_another_balance_for_the_pourer_the_operator_is_asked_for_its_weights():
    steps = weighings(Placement.TRAY, pourer_elsewhere=True)
    assert [s.key for s in steps if s.by == "operator"] == ["pourer_empty", "pourer_full", "pourer_after"]
    assert [s.do for s in steps] == ["weigh", "weigh", "tare", "pour", "weigh", "weigh"]
    by_placement = {p: [s.by for s in weighings(p, pourer_elsewhere=True) if s.key] for p in Placement}
    assert by_placement[Placement.EVERYTHING] == ["operator", "operator", "balance", "balance", "balance"]
    assert set(by_placement[Placement.MANUAL]) == {"operator"}
