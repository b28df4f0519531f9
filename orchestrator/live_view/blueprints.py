"""Blueprints of the viewer: one layout for each phase of a campaign, and recordings side by side.

`campaign_blueprint` and `simulation_blueprint` define layouts. `put_beside` merges several recordings into one: each is
below its own name, on shared timelines. The rows are written by other modules.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from orchestrator.reports.figure_style import safe_name

Moment = Literal["calibrating", "deploying", "replaying"]

BACKGROUND = [246, 247, 249]

LEGEND = 0.5
"""Space for a legend next to a curve, as a fraction of the curve's time range."""


def simulation_blueprint() -> rrb.Blueprint:
    """Return the layout of one simulated pour: the scene above the fractions of the liquid."""
    return _blueprint(rrb.Vertical(_simulation(), _shares(), row_shares=[3, 1]), "replaying")


def campaign_blueprint(
    moment: Moment,
    receivers: Mapping[str, str],
    loss_label: str,
    *,
    theta_slices: bool = False,
    action_slices: bool = False,
    doses: bool = False,
    rack: bool = False,
) -> rrb.Blueprint:
    """Return the layout of a campaign.

    Args:
        moment: 'calibrating', 'deploying', or 'replaying' after the end.
        receivers: display name of each deployment scene, by the scene's name.
        loss_label: label of the pours' loss.
        theta_slices: whether θ has more axes than one picture shows.
        action_slices: whether actions have more axes.
        doses: the campaign pours wanted amounts and does nothing else.
        rack: they are mixtures.
    """
    if doses:
        picture = rrb.Spatial2DView(origin="/rack", name="Rack: amounts, and differences [g]", background=BACKGROUND)
        dosing = rrb.Horizontal(
            rrb.Tabs(picture, _cell()) if rack else _cell(),
            rrb.Vertical(*_dose(), row_shares=[5, 3]),
            rrb.Vertical(_status(), _log(), _activity(), row_shares=[5, 3, 3]),
            column_shares=[8, 5, 4] if rack else [5, 7, 4],
            name="Dosing",
        )
        # Doses have no films: their signals are on the wall clock, also after the end.
        return _blueprint(rrb.Tabs(dosing), "deploying")

    # Created again for each tab: a view has one parent, and remains empty in a second one.
    def losses() -> list[Any]:
        named = [(safe_name(scene), name) for scene, name in receivers.items()]
        return [_loss(place, f"{name}: {loss_label}") for place, name in named] + [
            _whole(f"/learning/{place}", f"{name}: model check", contents=["$origin/trust"]) for place, name in named
        ]

    def maps(under: str = "") -> list[Any]:
        views = []
        for scene, name in receivers.items():
            views += _surrogate(f"{under}/learning/{safe_name(scene)}", f"{name}: expected loss", sliced=action_slices)
        return views

    def theta(under: str = "") -> list[Any]:
        place = f"{under}/learning/calibration"
        picture = _picture(f"{place}/theta", "θ* and which θ fit the pours")
        return [*_surrogate(place, "Discrepancy over θ", sliced=theta_slices), picture]

    def calibrated() -> Any:
        return _loss("calibration", "Calibration pours: spilled / poured [%]")

    *discrepancies, posterior = theta()
    calibrating = rrb.Horizontal(
        rrb.Vertical(_cell(), _simulation(), row_shares=[1, 1]),
        rrb.Vertical(
            rrb.Tabs(*discrepancies),
            posterior,
            rrb.Horizontal(calibrated(), _shares(), column_shares=[3, 4]),
            row_shares=[5, 4, 4],
        ),
        rrb.Vertical(_status(), _log(), _activity(), row_shares=[5, 3, 3]),
        column_shares=[5, 7, 4],
        name="Calibrating",
    )
    deploying = rrb.Horizontal(
        rrb.Vertical(_cell(), _simulation(), row_shares=[1, 1]),
        rrb.Vertical(rrb.Tabs(*maps()), rrb.Tabs(*losses()), rrb.Tabs(_weight(), _display()), row_shares=[5, 4, 4]),
        rrb.Vertical(_status(), _log(), _activity(), row_shares=[5, 3, 3]),
        column_shares=[5, 7, 4],
        name="Deploying",
    )
    replaying = rrb.Horizontal(
        rrb.Vertical(_cell(), _simulation(), row_shares=[1, 1]),
        rrb.Vertical(
            rrb.Horizontal(_weighed_pour(), _shares()),
            rrb.Tabs(*losses(), calibrated()),
            rrb.Tabs(*maps("/outcome"), *theta("/outcome")),  # the last ones, at every position of the time cursor
            row_shares=[4, 4, 5],
        ),
        rrb.Vertical(rrb.Tabs(_outcome(), _status()), _log(), row_shares=[5, 4]),
        column_shares=[5, 7, 4],
        name="Replaying",
    )
    # Every layout contains all three tabs, since a viewer that connects late may receive an earlier layout first.
    tabs = {"calibrating": calibrating, "deploying": deploying, "replaying": replaying}
    if not receivers:
        del tabs["deploying"]
        moment = "calibrating" if moment == "deploying" else moment
    return _blueprint(rrb.Tabs(*tabs.values(), active_tab=list(tabs).index(moment)), moment)


def beside_blueprint(names: Sequence[str]) -> rrb.Blueprint:
    """Return the layout of several recordings in one, each below its name.

    Args:
        names: first parts of the entities' paths.
    """
    columns = [
        rrb.Vertical(
            _cell(f"/{name}", f"{name}: the cell"),
            _simulation(f"/{name}", f"{name}: simulated pour"),
            _weighed_pour(f"/{name}", f"{name}: spilled [g], weighed and simulated"),
            _outcome(f"/{name}"),
            row_shares=[4, 4, 3, 3],
        )
        for name in names
    ]
    return _blueprint(rrb.Horizontal(*columns), "replaying")


def _blueprint(root: Any, moment: Moment) -> rrb.Blueprint:
    # After a campaign, the wall clock has minutes of computation between short pours. Playback
    # therefore uses the timeline of simulated time, in a loop.
    time = (
        rrb.TimePanel(timeline="sim_time", play_state="playing", loop_mode="all", state="collapsed")
        if moment == "replaying"
        else rrb.TimePanel(timeline="wall", play_state="following", state="collapsed")
    )
    return rrb.Blueprint(
        root, time, rrb.SelectionPanel(state="collapsed"), rrb.BlueprintPanel(state="collapsed"), auto_views=False
    )


def _cell(under: str = "", name: str = "The cell: planned (orange), done (blue)") -> Any:
    eye = rrb.EyeControls3D(position=(0.45, -0.95, 0.62), look_target=(0.12, 0.15, 0.22), eye_up=(0, 0, 1))
    return rrb.Spatial3DView(
        origin=f"{under}/cell",
        name=name,
        background=BACKGROUND,
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _simulation(under: str = "", name: str = "Simulated pour, by the fate of its liquid") -> Any:
    # From the side, slightly above: as in the figure of docs/reference/frames.md.
    eye = rrb.EyeControls3D(position=(-0.05, -0.42, 0.22), look_target=(-0.04, 0.0, 0.08), eye_up=(0, 0, 1))
    return rrb.Spatial3DView(
        origin=f"{under}/simulation",
        contents=[f"{under}/simulation/{entity}" for entity in ("pourer/**", "receiver/**", "liquid")],
        name=name,
        background=BACKGROUND,
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _recent(origin: str, name: str, before: float, *, contents: Any = "$origin/**", **options: Any) -> Any:
    """Return a view of curves over the last seconds; the space to the right of the cursor holds the legend."""
    at = rr.TimeRangeBoundary.cursor_relative
    shown = [
        rrb.VisibleTimeRange(line, start=at(seconds=-before), end=at(seconds=0.0)) for line in ("wall", "sim_time")
    ]
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=name,
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(at(seconds=-before), at(seconds=LEGEND * before))),
        time_ranges=shown,
        plot_legend=rrb.Corner2D.RightTop,
        **options,
    )


def _whole(origin: str, name: str, *, contents: Any = "$origin/**") -> Any:
    """Return a view of curves over the whole campaign; the viewer's default is half a minute around the cursor."""
    ever = rr.TimeRangeBoundary.infinite
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=name,
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(ever(), ever())),
        plot_legend=rrb.Corner2D.RightTop,
    )


def _shares() -> Any:
    axis = rrb.ScalarAxis(range=(-3.0, 104.0))
    return _recent("/simulation/share", "Simulated: where the liquid is [%]", 12.0, axis_y=axis)


def _weight() -> Any:
    contents = ["/balance/net", "/balance/verdict", "/balance/expected/**"]
    return _recent("/balance", "Balance: spilled [g], and what simulations expect", 60.0, contents=contents)


def _dose() -> list[Any]:
    amounts = ["/balance/dose/target", "/balance/dose/reading", "/balance/dose/estimated", "/balance/dose/stop"]
    return [
        _recent("/balance/dose", "Dose: wanted, balance and estimate [g]", 30.0, contents=amounts),
        _recent("/balance/dose", "Tilt [deg]", 30.0, contents=["/balance/dose/tilt"]),
    ]


def _display() -> Any:
    contents = ["/balance/shown", "/balance/stable", "/balance/tare"]
    return _recent("/balance", "Its display [g]", 60.0, contents=contents)


def _weighed_pour(under: str = "", name: str = "Pour: spilled [g], weighed and simulated") -> Any:
    return _recent(f"{under}/balance/pour", name, 12.0)


def _surrogate(place: str, name: str, *, sliced: bool) -> list[Any]:
    views = [_picture(f"{place}/surrogate", name)]
    return [*views, _picture(f"{place}/slices", f"{name}, two axes at a time")] if sliced else views


def _loss(place: str, name: str) -> Any:
    return _whole(f"/learning/{place}/loss", name)


def _picture(entity: str, name: str) -> Any:
    return rrb.Spatial2DView(origin=entity, name=name)


def _activity() -> Any:
    return rrb.Tabs(rrb.StateTimelineView(origin="/machine/activity", name="Activity"), _machine())


def _machine() -> Any:
    contents = ["/machine/load/**", "/machine/seconds", "/machine/wait", "/machine/dropped"]
    return _recent("/machine", "Queue, seconds, waits, drops", 120.0, contents=contents)


def _status(under: str = "") -> Any:
    return rrb.TextDocumentView(origin=f"{under}/status", name="Status")


def _outcome(under: str = "") -> Any:
    """Return a view of the run's outcome, which does not depend on the time cursor, unlike `_status`."""
    return rrb.TextDocumentView(origin=f"{under}/outcome", name="How it ended")


def _log() -> Any:
    # An empty list would show the active timeline as a narrow column of truncated numbers.
    hidden = [rrb.encodings.TimelineColumn(timeline, visible=False) for timeline in ("wall", "sim_time", "step")]
    columns = rrb.TextLogColumns(text_log_columns=[rrb.encodings.TextLogColumn("Body")], timeline_columns=hidden)
    return rrb.TextLogView(origin="/log", name="Events and decisions", columns=columns)


def put_beside(recordings: Mapping[str, Path], path: Path) -> Path:
    """Merge several recordings into one.

    Args:
        recordings: `.rrd` files by name; each name becomes a part of entity paths.
        path: `.rrd` to write.

    Returns:
        `path`.

    Raises:
        OSError: a file can't be read or written.
    """
    path.open("wb").close()
    stream = rr.RecordingStream("decant beside")
    stream.set_sinks(rr.FileSink(str(path)))
    stream.send_recording_name(" beside ".join(recordings))
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for name, file in recordings.items():
        for chunk in RrdReader(str(file)).stream():
            entity = str(chunk.entity_path)
            if entity != "/" and not entity.startswith("/__"):
                stream.send_chunks([chunk.with_entity_path(f"/{name}{entity}")])
    stream.send_blueprint(beside_blueprint(tuple(recordings)))
    stream.disconnect()
    return path
