"""Results of a run that has ended, was interrupted or is still running.

`open_run` returns a `Run` with stage results, pours, decisions and curves as tables, and figures. `publish` writes its
files. This module does not start or resume runs.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.calibration.calibration_base import Calibrated, CalibratedTheta
from orchestrator.learning.calibration.calibration_scores import CalibrationGain
from orchestrator.learning.campaign_plan import CampaignPlan, receiver_names
from orchestrator.learning.deployment.deployment_result import Recommended
from orchestrator.learning.requests import Failed, Simulate, Simulated
from orchestrator.learning.stage_result import UNIT_SUFFIXES, displayed_action
from orchestrator.learning.strategy import plural
from orchestrator.records.codec import Results
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.run_record import CampaignResult, Row, answers, read_record, read_result
from orchestrator.records.verdict import Verdict, verdict_of
from orchestrator.reports.loss_units import loss_of_pour
from orchestrator.reports.mixture_report import mixture_rows, mixtures_of, with_unfinished
from orchestrator.reports.publishing import Published, report_on, summary_of
from orchestrator.reports.publishing import publish as write
from orchestrator.reports.run_summary import RunSummary
from orchestrator.reports.stage_views import deployments_of, gain_of, predictions_of, recommended_theta_of, theta_of
from sim_engine.action import described
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import SampleStatistics
from sim_engine.resources import require

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Run:
    """A run. Its tables are pandas.DataFrames, created on access; `attrs['units']` has the units of their columns.

    Attributes:
        campaign: its campaign.
        result: state, counts, times, and the result of each stage.
        published: the files written about it; None if the run was only opened.
    """

    campaign: CampaignPlan
    result: CampaignResult
    published: Published | None = None

    @property
    def directory(self) -> Path:
        """Its folder."""
        return self.result.directory

    @property
    def results(self) -> Results:
        """The result of each closed stage, by its name."""
        return self.result.results

    @property
    def summary(self) -> RunSummary:
        """The result document: everything that the report shows, in numbers and in words with units.

        Raises:
            RunError: the journal cannot be read.
        """
        return summary_of(self.campaign, self.result) if self.published is None else self.published.summary

    @property
    def verdict(self) -> Verdict:
        """What the run reached of what was wanted: 'complete', 'incomplete' or 'nothing', with counts and reasons.

        Raises:
            RunError: the journal cannot be read.
        """
        return verdict_of(read_record(self.directory))

    @property
    def calibrated(self) -> CalibratedTheta | None:
        """θ*, its predictions and other θ that fit; None without a calibration."""
        return theta_of(self.results)

    @property
    def theta(self) -> SimulationParameters | None:
        """The θ to simulate with: θ*, or the uncalibrated one if the pours do not justify θ*.

        None without a calibration.
        """
        return recommended_theta_of(self.results)

    @property
    def calibration_gain(self) -> CalibrationGain | None:
        """Whether the weighed pours justify θ*, in numbers and words (`text`); None if this was not compared."""
        return gain_of(self.results)

    @property
    def recommended(self) -> dict[str, Recommended]:
        """The action to use from now on, by receiver."""
        names = receiver_names(self.campaign)
        actions = {names.get(scene, scene): d.recommended for scene, d in deployments_of(self.results).items()}
        return {name: action for name, action in actions.items() if action is not None}

    @property
    def predictions(self) -> dict[str, dict[str, SampleStatistics]]:
        """Outcomes of the recommended actions with new seeds, by receiver and quantity."""
        names = receiver_names(self.campaign)
        return {names.get(scene, scene): p.over_seeds for scene, p in predictions_of(self.results).items()}

    @property
    def pours(self) -> pd.DataFrame:
        """One row for each pour: action in display units, masses [g], spillage r, loss in its own unit."""
        return table_of(self._pours())

    @property
    def simulations(self) -> pd.DataFrame:
        """One row for each simulation: action in display units, θ, fractions of the load, CPU seconds."""
        return table_of(self._simulations())

    @property
    def decisions(self) -> pd.DataFrame:
        """The reasons for the strategies' requests, in words and numbers."""
        return table_of(self._decisions())

    @property
    def curves(self) -> pd.DataFrame:
        """Progress of each stage: the loss of every pour and the discrepancy of every θ, with the best so far."""
        return table_of(self._curves())

    @property
    def outflows(self) -> pd.DataFrame:
        """Outflow of every simulation over time: fractions of the load that have been poured and spilled."""
        return table_of(self._outflows())

    @property
    def mixtures(self) -> pd.DataFrame:
        """One row for each liquid of each cup of `mixtures`: wanted and received mass [g] and share, with half of their
        90 % intervals, dose, source, batch, time [s since 1970] and state of the cup; empty without mixtures.
        """
        mixtures = mixtures_of(with_unfinished(self.campaign, self.result).results)
        return table_of([] if mixtures is None else mixture_rows(mixtures, read_record(self.directory)))

    def figures(self) -> dict[str, Figure]:
        """All figures that its results allow, by name."""
        from orchestrator.reports.run_figures import figures_of

        return figures_of(self.campaign, self.results)

    def report(self, path: Path | str | None = None) -> Path:
        """Write the report of the run: one self-contained HTML file with newly drawn figures.

        Args:
            path: of the page; 'report.html' in the run's folder unless given.

        Raises:
            OSError: it cannot be written.
            RunError: the journal cannot be read.
        """
        return report_on(self.campaign, self.result, None if path is None else Path(path).expanduser())[0]

    def save_tables(self, directory: Path | str | None = None) -> list[Path]:
        """Write all tables as Parquet files.

        Args:
            directory: 'tables' in the run's folder unless given.

        Raises:
            MissingExtraError: pyarrow is not installed.
        """
        require("pyarrow", "Parquet")
        folder = self.directory / "tables" if directory is None else Path(directory).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        paths = []
        for name in ("pours", "simulations", "decisions", "curves", "outflows"):
            path = folder / f"{name}.parquet"
            getattr(self, name).to_parquet(path)
            paths.append(path)
        return paths

    def _repr_html_(self) -> str:
        """Campaign, folder and recommended actions, in notebooks."""
        rows = [("campaign", self.campaign.name), ("verdict", self.verdict.text), ("folder", str(self.directory))]
        rows.append(("done", f"{plural(self.result.pours, 'pour')}, {plural(self.result.simulations, 'simulation')}"))
        for name, action in self.recommended.items():
            rows.append((f"recommended for {name}", described(action.action_si)))
        return html_table(rows)

    # -- rows --------------------------------------------------------------------------------------------------------

    def _pours(self) -> Iterator[Row]:
        names = receiver_names(self.campaign)
        for pour in read_record(self.directory).pours:
            if pour.outcome is not None:
                scene = pour.request.scene
                row: Row = {"stage": pour.stage, "id": pour.id, "receiver": names.get(scene, scene), **pour.row()}
                if pour.measured is not None:
                    row["loss"] = loss_of_pour(self.campaign, pour.request, pour.measured)
                yield {**row, "seconds": pour.seconds}

    def _simulations(self) -> Iterator[Row]:
        names = receiver_names(self.campaign)
        for answer in answers(self.directory, Simulate):
            request = answer.request
            assert isinstance(request, Simulate)
            row: Row = {"stage": answer.stage, "id": answer.id, "receiver": names.get(request.scene, request.scene)}
            row |= {"purpose": request.purpose, "seed": request.seed, **displayed_action(request.action.values())}
            row |= {f"theta_{name}": value for name, value in request.parameters.model_dump().items()}
            match answer.outcome:
                case Simulated(outcome):
                    fractions = outcome.fractions
                    row |= {"poured": fractions.poured, "spilled": fractions.spilled, "retained": fractions.retained}
                    row |= {"spillage": fractions.spillage, "cpu_s": outcome.cpu_s}
                    row["failed"] = outcome.invalid
                case Failed(kind, reason):
                    row["failed"] = f"{kind}: {reason}"
            yield row

    def _decisions(self) -> Iterator[Row]:
        for decision in read_record(self.directory).decisions:
            values = {f"value_{name}": value for name, value in decision.values.items()}
            yield {"time": decision.time, "stage": decision.stage, "text": decision.text, **values}

    def _curves(self) -> Iterator[Row]:
        for stage, result in self.results.items():
            if isinstance(result, Calibrated):
                best: float | None = None
                for number, trial in enumerate(result.trials, start=1):
                    best = _least(best, trial.discrepancy)
                    row = {"stage": stage, "what": "discrepancy", "number": number}
                    yield {**row, "value": trial.discrepancy, "best": best}
        for result in deployments_of(self.results).values():
            best = None
            for number, simulated in enumerate(result.simulated, start=1):
                best = _least(best, simulated.loss)
                row = {"stage": result.scene, "what": "simulated loss", "number": number}
                yield {**row, "value": simulated.loss, "best": best}
            best = None
            for pour in result.pours:
                best = _least(best, pour.loss)
                row = {"stage": result.scene, "what": "loss", "number": pour.number, "value": pour.loss, "best": best}
                yield {**row, "predicted": pour.predicted, "predicted_deviation": pour.predicted_deviation}

    def _outflows(self) -> Iterator[Row]:
        for answer in answers(self.directory, Simulate):
            if isinstance(answer.outcome, Simulated):
                outcome = answer.outcome.outcome
                for time, poured, spilled in zip(
                    outcome.curve_times, outcome.curve_poured, outcome.curve_spilled, strict=True
                ):
                    yield {"stage": answer.stage, "id": answer.id, "time_s": time, "poured": poured, "spilled": spilled}


def open_run(directory: Path | str, campaign: CampaignPlan | None = None) -> Run:
    """Open a run's folder. The run may have ended, be interrupted, or still be running.

    Args:
        directory: of the run.
        campaign: of the run; read from the folder unless given.

    Raises:
        FileNotFoundError: there is no run in that folder.
        JournalError: its journal cannot be read.
        ConfigError: its campaign cannot be read.
    """
    folder = Path(directory).expanduser()
    if not (folder / JOURNAL_NAME).is_file():
        raise FileNotFoundError(f"{folder}: there is no run in this folder (no {JOURNAL_NAME})")
    plan = load_campaign(folder / "resolved.json") if campaign is None else campaign
    return Run(plan, read_result(folder))


def publish(run: Run) -> Published:
    """Write a run's figures, `theta.json`, `summary.json` and report into its folder, as `decant run` does at its end.

    Raises:
        OSError: a file cannot be written.
    """
    return write(run.campaign, run.result)


def _least(best: float | None, value: float | None) -> float | None:
    return best if value is None else value if best is None else min(best, value)


def table_of(rows: Iterable[Row]) -> pd.DataFrame:
    """Rows as a table, with the units of its columns in `attrs`."""
    require("pandas", "A table")
    import pandas as pd

    table = pd.DataFrame(list(rows))
    ends = {**{f"_{suffix}": unit for unit, suffix in UNIT_SUFFIXES.items()}, "_g": "g", "seconds": "s"}
    units = {name: next((unit for end, unit in ends.items() if name.endswith(end)), "") for name in table.columns}
    table.attrs["units"] = {name: unit for name, unit in units.items() if unit}
    return table


def html_table(rows: Iterable[tuple[str, str]]) -> str:
    """A table of names and texts, for notebooks."""
    cells = (f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows)
    return f"<table>{''.join(cells)}</table>"
