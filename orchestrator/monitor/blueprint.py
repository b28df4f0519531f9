"""What a viewer shows when it opens a recording: which views, where."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from orchestrator.report.style import safe_name

if TYPE_CHECKING:
    import rerun.blueprint as rrb


def _scene() -> Any:
    import rerun.blueprint as rrb

    return rrb.Spatial3DView(
        origin="/scene",
        contents=["/scene/pourer/**", "/scene/receiver/**", "/scene/liquid"],
        name="Pour",
        background=[250, 250, 250],
        # From the side, a little above: the picture in docs/frames.md.
        eye_controls=rrb.EyeControls3D(position=(-0.05, -0.55, 0.3), look_target=(-0.03, 0.0, 0.12), eye_up=(0, 0, 1)),
    )


def _shares() -> Any:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin="/scene/share",
        name="Where the liquid is [%]",
        axis_y=rrb.ScalarAxis(range=(0.0, 100.0)),
        plot_legend=rrb.Corner2D.RightTop,
    )


def simulation_blueprint() -> rrb.Blueprint:
    """For one simulated pour: the scene above the shares of the liquid."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Vertical(_scene(), _shares(), row_shares=[3, 1]),
        rrb.TimePanel(timeline="sim_time"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def campaign_blueprint(receivers: Mapping[str, str], loss_label: str) -> rrb.Blueprint:
    """For a campaign: scene and pool to the left, losses and maps in the middle, events and state to the right.

    Args:
        receivers: what people call each deployment scene, by its name.
        loss_label: of the pours' loss.
    """
    import rerun.blueprint as rrb

    losses = [
        rrb.TimeSeriesView(
            origin=f"/pours/{safe_name(scene)}", name=f"{name}: {loss_label}", plot_legend=rrb.Corner2D.RightTop
        )
        for scene, name in receivers.items()
    ]
    losses.append(rrb.TimeSeriesView(origin="/calibration/loss", name="Calibration pours: spilled / poured [%]"))
    maps = []
    for place, title in (
        ("/maps/calibration", "Discrepancy"),
        *((f"/maps/{safe_name(scene)}", name) for scene, name in receivers.items()),
    ):
        for which, meaning in (("mean", "mean"), ("deviation", "± 1 σ")):
            maps.append(
                rrb.Spatial2DView(
                    origin=f"{place}/{which}",
                    contents=["$origin/picture", "$origin/observed"],
                    name=f"{title}: {meaning}",
                )
            )
    numbers = [
        rrb.TensorView(origin=f"{place}/mean/values", name=f"{title}: numbers")
        for place, title in (
            ("/maps/calibration", "Discrepancy"),
            *((f"/maps/{safe_name(scene)}", name) for scene, name in receivers.items()),
        )
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                _scene(),
                _shares(),
                rrb.TimeSeriesView(origin="/laboratory", name="Laboratory", plot_legend=rrb.Corner2D.RightTop),
                row_shares=[3, 1, 1],
            ),
            rrb.Vertical(rrb.Tabs(*losses), rrb.Tabs(rrb.Grid(*maps, name="Surrogates"), *numbers), row_shares=[2, 3]),
            rrb.Vertical(
                rrb.TextDocumentView(origin="/state", name="State"),
                rrb.TextLogView(origin="/events", name="Events and decisions"),
                row_shares=[2, 3],
            ),
            column_shares=[3, 3, 2],
        ),
        rrb.TimePanel(timeline="wall"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )
