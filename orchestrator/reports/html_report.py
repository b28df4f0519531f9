"""HTML pages: the report of a run, finished or not, and the rendering of templates.

Pages are self-contained. The templates escape all content of a campaign (autoescape). A page loads nothing from other
addresses, and its content security policy forbids it.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from actors.laboratory_settings import MODE_LABELS
from orchestrator.reports import wording
from orchestrator.reports.mixture_report import mixture_table, mixtures_of
from orchestrator.reports.run_summary import RunSummary

if TYPE_CHECKING:
    from jinja2 import Environment

STYLE = "style.css"

REPORT_NAME = "report.html"

LARGEST_VECTOR = 1_500_000
"""Maximum size of an SVG in a page [bytes]; the PNG replaces a larger one, for example with many facets."""

_THETA_FIGURES = ("discrepancy", "posterior", "test discrepancy")

_FIRST_FIGURES = ("rack", "recommended pour", "loss against pours", "loss map")
"""Figures at the top of the page, in this order."""

_NARROW = ("test discrepancy", "loss", "uncertainty", "posterior")
"""Figures that can be placed next to each other."""

_FIGURES: dict[str, tuple[str, str]] = {
    "discrepancy map": (
        "Map of the discrepancy between simulated and weighed spillage over the parameters θ, with the θ that were "
        "tried as dots and θ* as a star.",
        "How far simulations are from the weighed pours, over θ. The star is θ*.",
    ),
    "discrepancy trials": (
        "Discrepancy of every tried θ against each searched parameter.",
        "Every θ that was tried, against each parameter.",
    ),
    "posterior": (
        "Histograms of each parameter and clouds of each pair of parameters, of θ that fit the weighed pours.",
        "θ that fit the pours. Where a cloud fills its panel, the pours say little.",
    ),
    "test discrepancy": (
        "Bars: mean difference of simulated and weighed spillage for θ*, for uncalibrated and random θ, and for "
        "regressions, on pours used for calibration and on others.",
        "Gain of calibration: θ* and its rivals, on the pours of the calibration and on others.",
    ),
    "loss against pours": (
        "Loss of every pour in the order made, with its prediction and the best so far.",
        "Loss of every pour (dots), its prediction (bars: nine in ten lie inside), and the best so far (line).",
    ),
    "rack": (
        "The cups of the rack from above, each with a ring of its liquids and the differences from the wanted amounts.",
        "Rings show the wanted shares, numbers the amounts and differences from the table in g. After a dose that "
        "missed (bold), the others of its cup may be corrected, so that their ratio holds.",
    ),
    "dose ": (
        "Readings of the balance and tilt of the pourer over the time of a dose.",
        "Balance (dots), wanted amount (line) and tilt over time.",
    ),
    "loss map": (
        "Map of the expected loss over the searched actions with the pours as numbered dots and the recommended action "
        "as a star.",
        "Expected loss by action. Numbers are pours in their order, the star is the recommended action.",
    ),
    "uncertainty": (
        "Map of the standard deviation of the expected loss over the searched actions.",
        "How uncertain the expected loss is: its standard deviation.",
    ),
    "film of dose": (
        "Film strip of a dose: vessels cut open, with coloured particles.",
        "Particles of the virtual bench in one dose. Blue: in the pourer, light blue: falling, green: received, red: "
        "spilled.",
    ),
    "recommended pour": (
        "Film strip of the recommended pour as simulated: vessels cut open, with coloured particles.",
        "One simulation of the recommended pour. Blue: in the pourer, light blue: falling, green: received, red: "
        "spilled.",
    ),
}
"""Alt text and caption of a figure, by the beginning of its name."""


def run_page(summary: RunSummary, resolved: Mapping[str, Any] | None = None) -> str:
    """The report of a run.

    Args:
        summary: the result document, with the figures that go into the page.
        resolved: the campaign's file with all values filled in.

    Returns:
        HTML.

    Raises:
        OSError: a figure can't be read.
    """
    pictures = {name: _picture(name, path) for name, path in summary.files.figures.items() if path.is_file()}
    mixtures = mixtures_of(summary.results)
    seed = "" if summary.seed is None else f" Seed {summary.seed}."
    # The paths of the machine are left out.
    settings = {key: value for key, value in (resolved or {}).items() if key != "outputs"}
    return render(
        "run.html.j2",
        title=f"{summary.campaign}: {summary.run}",
        kicker=f"Report of a pouring campaign · run {summary.run}",
        heading=summary.campaign,
        mode=MODE_LABELS.get(summary.mode, "SIMULATION ONLY"),
        mode_look=summary.mode,
        unmet=[goal.line for goal in summary.verdict.unmet],
        lead=f"Begun {_date(summary.began_at)}, last entry {_date(summary.ended_at)}.{seed}",
        run=summary,
        stages=wording.stage_table(summary.outcome),
        cost=wording.cost_table(summary),
        questions=wording.question_table(summary.outcome),
        theta=wording.theta_table(summary.learning) if summary.learning.parameters else None,
        theta_fixed=wording.fixed_parameters(summary.learning),
        scores=wording.score_table(summary.learning),
        theta_figures=[pic for name, pic in pictures.items() if name.startswith(_THETA_FIGURES)],
        receivers=wording.receiver_table(summary.outcome),
        first=[pic for start in _FIRST_FIGURES for name, pic in pictures.items() if name.startswith(start)],
        figures=[pic for name, pic in pictures.items() if not name.startswith((*_THETA_FIGURES, *_FIRST_FIGURES))],
        pours=[
            *([] if mixtures is None else [mixture_table(mixtures)]),
            *wording.pour_tables(summary),
        ],
        not_simulated=wording.validity_table(summary.outcome),
        notes=[(_date(note.time), note.text) for note in summary.log.notes],
        resolved=json.dumps(settings, indent=2, ensure_ascii=False) if settings else "",
        footer="Made by Decant from the run's journal.",
    )


def _date(seconds: float | None) -> str:
    return "—" if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(seconds))


def _picture(name: str, file: Path) -> Picture:
    alt, caption = next((texts for start, texts in _FIGURES.items() if name.startswith(start)), (name, ""))
    return Picture.of(file, f"{name}: {alt}", caption or name, wide=not name.startswith(_NARROW))


@dataclass(frozen=True)
class Picture:
    """A picture on a page.

    Attributes:
        source: a data URI.
        alt: description for readers who do not see the picture.
        wide: whether it covers the full width of the page.
    """

    source: str
    alt: str
    caption: str
    wide: bool = False

    @classmethod
    def of(cls, file: Path, alt: str, caption: str, *, wide: bool = False) -> Picture:
        """An embedded file: the SVG next to a PNG if there is one, for print.

        Raises:
            OSError: it can't be read.
        """
        vector = file.with_suffix(".svg")
        file = vector if vector.is_file() and vector.stat().st_size <= LARGEST_VECTOR else file
        kind = "svg+xml" if file.suffix == ".svg" else "png"
        data = base64.b64encode(file.read_bytes()).decode("ascii")
        return cls(f"data:image/{kind};base64,{data}", alt, caption, wide)


@cache
def _templates() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("orchestrator.reports", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **content: Any) -> str:
    """Render a page.

    Args:
        template: 'run.html.j2' or 'study.html.j2'.
        content: values for the template; all of them are escaped.
    """
    from markupsafe import Markup

    style = resources.files("orchestrator.reports").joinpath("templates", STYLE).read_text(encoding="utf-8")
    return _templates().get_template(template).render(style=Markup(style), **content)
