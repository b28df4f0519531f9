"""What a run came to, read from its journal: state, counts, costs, what each stage learnt."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from orchestrator.journal import JournalReader, Kind
from orchestrator.results import Results, decode_results
from orchestrator.states import State


@dataclass(frozen=True)
class CampaignResult:
    """What a campaign came to.

    Attributes:
        results: of the closed stages by name, in order.
        simulations: finished ones, failed ones included.
        pours: finished ones, failed ones included.
        cpu_s: CPU seconds of all simulations and suggestions.
        seconds: wall time of this process' part of the run.
    """

    name: str
    directory: Path
    state: State
    results: Results = field(default_factory=dict)
    simulations: int = 0
    pours: int = 0
    cpu_s: float = 0.0
    seconds: float = 0.0


def read_result(journal: JournalReader, directory: Path, *, seconds: float = 0.0) -> CampaignResult:
    """What the journal of a run, finished or not, says it came to."""
    simulations = pours = 0
    cpu_s = 0.0
    for entry in journal.entries(kinds=[Kind.FINISHED, Kind.POUR_FINISHED]):
        outcome = entry.body["outcome"]
        match outcome["type"]:
            case "Suggested":
                cpu_s += outcome["suggestion"]["seconds"]
                continue
            case "Simulated":
                cpu_s += outcome["outcome"]["cpu_s"]
        if entry.kind == Kind.POUR_FINISHED:
            pours += 1
        else:
            simulations += 1
    return CampaignResult(
        journal.header.name,
        directory,
        journal.state(),
        decode_results(journal.stage_results()),
        simulations,
        pours,
        cpu_s,
        seconds,
    )
