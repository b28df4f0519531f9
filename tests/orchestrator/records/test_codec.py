"""`codec`: requests and outcomes survive the journal bit for bit: a replay must tell what the live run told."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.optimizer.questions import (
    BenchOffset,
    CalibrationQuery,
    Data,
    MinimumQuery,
    ModelDiscrepancy,
    OffsetPrior,
    PourQuery,
    RegressionQuery,
    SpaceFillingQuery,
    Suggestion,
    SurrogateMap,
)
from orchestrator.learning.calibration.pour_design import DesignResult
from orchestrator.learning.requests import Failed, Pour, Poured, Prediction, Simulate, Simulated, Suggest, Suggested
from orchestrator.records.codec import (
    CodecError,
    canonical,
    decode_outcome,
    decode_request,
    decode_result,
    encode_outcome,
    encode_request,
    encode_result,
    first_difference,
)
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.search_space import Axis, Space
from tests.support.hypothesis_examples import examples

# Numbers below 2e-308 are not numbers of a laboratory, and a process in which Taichi has run takes them for 0.
number = st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
fraction = st.floats(0, 1, allow_subnormal=False)
seed = st.integers(0, 2**63)
point = st.tuples(fraction, fraction)


def dimension(name: str) -> st.SearchStrategy[float | None]:
    d = ACTION_DIMENSIONS[name]
    values = st.floats(d.lower, d.upper, allow_subnormal=False)
    return st.none() | values if d.optional else values


actions = st.builds(Action, **{name: dimension(name) for name in ACTION_DIMENSIONS})
parameters = st.builds(
    SimulationParameters,
    particles=st.integers(200, 50_000),
    cohesion=st.floats(0, 0.2, allow_subnormal=False),
    xsph_rate=st.floats(0, 60, allow_subnormal=False),
    friction=st.floats(0, 1, allow_subnormal=False),
)


DISCREPANCY = ModelDiscrepancy((OffsetPrior(0.1), OffsetPrior(factor=0.05)), (BenchOffset((1.0, 1.0), (0.1, 0.0)),))


@st.composite
def data(draw: st.DrawFn) -> Data:
    points = draw(st.lists(point, max_size=4))
    return Data(tuple(points), tuple(draw(number) for _ in points))


space = Space((Axis("particles", 500, 4000, "log", integer=True), Axis("cohesion", 0.0, 0.1)))
points = st.lists(point, max_size=3).map(tuple)
asked = {"space": st.just(space), "seed": seed}
proposed = asked | {"data": data(), "kappa": number, "pending": points, "count": st.integers(1, 9)}
queries = st.one_of(
    st.builds(SpaceFillingQuery, **asked, known=points, count=st.integers(1, 9)),
    st.builds(RegressionQuery, **asked, data=data(), mean=st.sampled_from(["constant", "zero"])),
    st.builds(MinimumQuery, **proposed, plain=st.booleans()),
    st.builds(CalibrationQuery, **proposed, contexts=points),
    st.builds(PourQuery, **proposed, simulated=data(), discrepancy=st.none() | st.just(DISCREPANCY)),
)
rows = st.lists(st.lists(number, max_size=3).map(tuple), max_size=3).map(tuple)
suggestions = st.builds(
    Suggestion,
    points=st.lists(point, max_size=3).map(tuple),
    means=st.lists(number, max_size=3).map(tuple),
    best_point=st.none() | point,
    best_mean=st.none() | number,
    hyperparameters=st.none() | st.dictionaries(st.text(), number, max_size=3),
    surrogate=st.none()
    | st.builds(SurrogateMap, rows, rows, axes=st.just(()) | st.tuples(st.text(), st.text()), at=point),
)
outcomes = st.builds(
    PourOutcome,
    **dict.fromkeys(
        ("received", "spilled", "retained", "in_flight", "escaped", "spacing", "density_error", "simulated_time"),
        number,
    ),
    cpu_s=number,
    particles=st.integers(0, 10**6),
    steps=st.integers(0, 10**6),
    seed=seed,
    curve_times=st.lists(number, max_size=4).map(tuple),
    invalid=st.none() | st.text(),
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | number | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)
measurements = st.builds(PourMeasurement, number, number, number, st.dictionaries(st.text(), json_values, max_size=3))


def through_json(written: Any) -> Any:
    return json.loads(canonical(written))


@settings(max_examples=examples(60), deadline=None)
@given(
    st.one_of(
        st.builds(Simulate, st.text(), actions, parameters, seed, st.text()),
        st.builds(
            Pour,
            st.text(),
            actions,
            st.integers(1, 99),
            seed,
            st.none() | st.builds(Prediction, number, number),
            st.text(),
        ),
        st.builds(Suggest, queries),
    )
)
def test_requests_survive_bit_for_bit(request: Simulate | Pour | Suggest) -> None:
    written = encode_request(request)
    read = decode_request(through_json(written))
    assert read == request
    assert hash(read) == hash(request)  # strategies keep requests in dictionaries
    assert canonical(encode_request(read)) == canonical(written)


@settings(max_examples=examples(60), deadline=None)
@given(
    st.one_of(
        st.builds(Simulated, outcomes),
        st.builds(Poured, measurements),
        st.builds(Suggested, suggestions),
        st.builds(Failed, st.text(), st.text()),
    )
)
def test_outcomes_survive_bit_for_bit(outcome: Simulated | Poured | Suggested | Failed) -> None:
    written = encode_outcome(outcome)
    assert decode_outcome(through_json(written)) == outcome


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_json_can_not_say_is_said_otherwise(value: float) -> None:
    written = encode_outcome(Poured(PourMeasurement(value, 0.0, 0.0, {"reading": value})))
    read = decode_outcome(through_json(written))
    assert isinstance(read, Poured)
    assert str(read.measurement.loaded) == str(read.measurement.notes["reading"]) == str(value)


def test_whole_numbers_given_for_floats_are_the_same_request() -> None:
    assert canonical(encode_request(Suggest(MinimumQuery(space, Data(), kappa=2)))) == canonical(
        encode_request(Suggest(MinimumQuery(space, Data(), kappa=2.0)))
    )


def test_numbers_that_came_out_of_numpy_are_the_same_request() -> None:
    plain = Pour("cup", Action(1.0, 0.1, 0.03), 3, seed=5, predicted=Prediction(0.5, 0.25))
    action = Action(np.float64(1.0), np.float64(0.1), 0.03)
    drawn = Pour("cup", action, np.int64(3), np.uint64(5), Prediction(np.float32(0.5), np.float64(0.25)))  # type: ignore[arg-type]
    assert canonical(encode_request(drawn)) == canonical(encode_request(plain))
    notes = {"readings": np.array([1.0, 2.0]), "count": np.int64(3), "stable": np.bool_(True)}
    written = encode_outcome(Poured(PourMeasurement(0.2, 0.0, 0.0, notes)))
    assert written["measurement"]["notes"] == {"readings": [1.0, 2.0], "count": 3, "stable": True}


def test_entries_of_a_newer_version_are_refused_by_name() -> None:
    written = encode_outcome(Failed("simulation", "diverged"))
    with pytest.raises(CodecError, match="Failed has no field severity"):
        decode_outcome({**written, "severity": 3})
    with pytest.raises(CodecError, match="'Exploded'"):
        decode_outcome({**written, "type": "Exploded"})
    with pytest.raises(CodecError, match=r"Failed\.kind: expected str, got 3"):
        decode_outcome({**written, "kind": 3})
    with pytest.raises(CodecError, match="Failed lacks kind; was it written by an older version"):
        decode_outcome({key: value for key, value in written.items() if key != "kind"})
    asked = encode_request(Suggest(MinimumQuery(space, Data(((0.1, 0.2),), (1.0,)))))
    asked["query"]["data"]["costs"] = ["much"]
    with pytest.raises(
        CodecError, match=r"^Suggest\.query: MinimumQuery\.data: Data\.costs: expected a number, got much$"
    ):
        decode_request(asked)


def test_the_first_difference_is_named() -> None:
    old = {"action": {"x_offset": 0.1}, "seed": 4, "points": [1.0, 2.0]}
    assert first_difference(old, old) is None
    for change, path, text in (
        ({"points": [1.0, 2.5]}, ("points", 1), "points[1]: 2.0 became 2.5"),
        ({"action": {"x_offset": 0.2}}, ("action", "x_offset"), "action.x_offset: 0.1 became 0.2"),
        ({"action": {}}, ("action", "x_offset"), "action.x_offset: 0.1 became nothing"),
        ({"new": {}}, ("new",), "new: nothing became {}"),
    ):
        difference = first_difference(old, {**old, **change})
        assert difference is not None
        assert (difference.path, str(difference)) == (path, text)
    assert str(first_difference([1], [1, 2])) == "value: [1] became [1, 2]"
    assert first_difference(old, {**old, "new": None}) is None


def test_empty_fields_of_an_earlier_version_are_ignored_and_others_are_refused() -> None:
    answer = encode_outcome(Suggested(Suggestion(((0.5,),))))
    answer["suggestion"] |= {"risk": None}
    assert decode_outcome(answer) == Suggested(Suggestion(((0.5,),)))
    result = DesignResult(pours=())
    assert decode_result({**encode_result(result), "risk": None, "objectives": []}) == result
    answer["suggestion"]["risk"] = {"expected": [0.1]}
    with pytest.raises(CodecError, match="Suggestion has no field risk"):
        decode_outcome(answer)


def test_a_request_of_a_version_without_drawn_shapes_is_read() -> None:
    request = Simulate("cup", Action(angular_velocity=1.0, x_offset=0.1, height=0.05), SimulationParameters(), 1)
    written = encode_request(request)
    del written["drawn_shapes"]
    assert decode_request(written) == request
