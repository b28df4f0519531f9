"""The columns of the catalogue's two tables, each declared once: for index, exports and their data dictionary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from orchestrator.strategies.display import displayed_action
from sim_engine.action import ACTION_DIMENSIONS

ColumnType = Literal["text", "texts", "integer", "number", "time", "values"]
"""'texts' are several, 'values' a mapping; both stand as JSON in the index and in CSV."""


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        unit: of its numbers; empty without one.
        meaning: one line for people.
    """

    name: str
    type: ColumnType
    meaning: str
    unit: str = ""


_WHICH_RUN = (
    Column("run", "text", "name of the run's folder"),
    Column("campaign", "text", "name of the campaign"),
    Column("mode", "text", "'virtual', or 'hardware' for a real bench"),
)

RUNS = (
    *_WHICH_RUN,
    Column("path", "text", "the run's folder"),
    Column("begun", "time", "when its journal was begun"),
    Column("ended", "time", "when the last entry was written; of a run that goes on, until now"),
    Column(
        "state",
        "text",
        "of the campaign, as in its journal; 'interrupted' where its process died without a word; "
        "'unreadable' if its journal is missing or damaged",
    ),
    Column("reason", "text", "why it is in that state, where there is something to report"),
    Column("laboratory", "text", "name of the laboratory"),
    Column("seed", "integer", "of every random choice"),
    Column("liquid", "texts", "names of the liquids"),
    Column("pourer", "texts", "names of the vessels that were poured from"),
    Column("receiver", "texts", "names of the vessels that were poured into"),
    Column("strategy", "texts", "of calibration and deployment"),
    Column("simulations", "integer", "that were finished, failed ones included"),
    Column("pours", "integer", "that were weighed"),
    Column("failed_pours", "integer", "that failed, or were lost"),
    Column("open_pours", "integer", "that had begun and have no outcome: under way, or UNKNOWN"),
    Column("spilled_g", "number", "beside the receiver, of all weighed pours together", "g"),
    Column("test_discrepancy", "number", "mean |measured − simulated| spillage of θ* on pours kept for testing", "1"),
    Column("theta", "values", "θ*, in SI units"),
    Column("recommended", "values", "by receiver: action to use from now on (display units), expected and best loss"),
    Column("tags", "texts", "given by people: `decant runs tag`"),
    Column("notes", "texts", "written by people: `decant runs note`"),
)
"""One row for each run."""

POURS = (
    *_WHICH_RUN,
    Column("path", "text", "the run's folder"),
    Column("time", "time", "when it was weighed, or had failed; when it began where it has no outcome"),
    Column("stage", "text", "of the campaign"),
    Column("id", "integer", "of the request within the run"),
    Column("number", "integer", "of the pour within its stage, from 1"),
    Column("purpose", "text", "'calibration', or 'pour' where something is minimised"),
    Column("strategy", "text", "that asked for it"),
    Column("pourer", "text", "vessel that was poured from"),
    Column("receiver", "text", "vessel that was poured into"),
    Column("liquid", "text", "what was poured"),
    *(
        Column(displayed, "number", dimension.meaning, dimension.display_unit)
        for displayed, dimension in zip(
            displayed_action(dict.fromkeys(ACTION_DIMENSIONS)), ACTION_DIMENSIONS.values(), strict=True
        )
    ),
    Column("outcome", "text", "'weighed', 'failed', or 'open': begun, no outcome; UNKNOWN once its process has died"),
    Column("loaded_g", "number", "in the pourer before", "g"),
    Column("spilled_g", "number", "beside the receiver", "g"),
    Column("retained_g", "number", "left in the pourer", "g"),
    Column("spillage", "number", "spilled / poured; empty where less than 5 % was poured", "1"),
    Column("loss", "number", "what the deployment minimised, as measured", "of loss_name"),
    Column("predicted_loss", "number", "what its strategy expected", "of loss_name"),
    Column("predicted_deviation", "number", "how well that was known: its standard deviation", "of loss_name"),
    Column("loss_name", "text", "which loss, see `loss` of a campaign; 'objectives' for a weighted sum"),
    Column("reason", "text", "why it failed"),
    Column("seconds", "number", "from its request to its outcome", "s"),
)
"""One row for each pour that had begun."""

ACTION_COLUMNS = tuple(displayed_action(dict.fromkeys(ACTION_DIMENSIONS)))
"""Those of POURS that say what was chosen."""

TABLES: dict[str, tuple[Column, ...]] = {"run": RUNS, "pour": POURS}
"""The index's tables."""
