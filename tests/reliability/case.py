"""What a case of the kill matrix is, which there are, and which have no meaning."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

TARGETS = ("program", "daemon", "simulator", "optimiser", "worker", "controller", "balance", "recording", "ray")
"""What is struck."""

KILLED, KILLED_AFTER, STOPPED, CUT, FULL, AHEAD, BACK = (
    "killed",
    "killed after it",
    "stopped",
    "cut",
    "full disk",
    "clock a day ahead",
    "clock an hour back",
)
FAULTS = (KILLED, KILLED_AFTER, STOPPED, CUT, FULL, AHEAD, BACK)

_CLOCKLESS = "reads no clock of the day: `actors` and `sim_engine` use the monotonic one alone (a test sees to it)"

_ANOTHER_TIME = "not tried: its programs can't be given another time than the machine's, which others use"

NO_MEANING: dict[tuple[str, str], str] = {
    ("program", CUT): "has no sockets of its own; those of its devices, its recording and Ray are struck as theirs",
    **{
        (target, clock): _CLOCKLESS
        for target in ("simulator", "optimiser", "worker", "controller", "balance")
        for clock in (AHEAD, BACK)
    },
    ("simulator", FULL): "keeps nothing on the disk but caches, which are rebuilt; its results go to the program",
    ("optimiser", FULL): "writes nothing",
    ("worker", FULL): "writes nothing but messages of its library",
    ("controller", FULL): "writes nothing",
    ("balance", FULL): "writes nothing",
    ("ray", AHEAD): _ANOTHER_TIME,
    ("ray", BACK): _ANOTHER_TIME,
}
"""Why a fault isn't tried on something."""


@dataclass(frozen=True)
class Case:
    """One fault of one thing at one moment.

    Attributes:
        at: what is being written into the journal at that moment: stage and kind.
        number: at the how manieth such write.
    """

    target: str
    fault: str
    at: str
    number: int

    @property
    def name(self) -> str:
        """In words."""
        return f"{self.target} {self.fault} at {self.at} {self.number}"


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    Attributes:
        ended: how the first life of the program ended, in words.
        told: what it said then.
        lives: how often it was started until the campaign was finished.
        asked: questions about pours that had begun.
        heard: what else the person at the bench was asked because of the fault.
        wrong: what should not be: empty.
        cpu_s: seconds of a core.
    """

    case: Case
    ended: str
    told: str
    lives: int
    asked: int
    heard: tuple[str, ...]
    wrong: tuple[str, ...]
    cpu_s: float = 0.0


Point = tuple[str, int]
"""A write of the journal: what is written, and at the how manieth such write."""


def points_of(writes: Iterable[str]) -> list[Point]:
    """All writes of a run."""
    seen: Counter[str] = Counter()
    points = []
    for write in writes:
        seen[write] += 1
        points.append((write, seen[write]))
    return points


def first_and_last(points: Sequence[Point]) -> list[Point]:
    """Of each kind of write in each stage the first and the last, in order."""
    last = dict(points)
    return [point for point in points if point[1] in (1, last[point[0]])]


def first_in_stages(points: Sequence[Point]) -> list[Point]:
    """Of each kind of write in each stage the first, in order."""
    return [point for point in points if point[1] == 1]


def first_of_kind(points: Sequence[Point]) -> list[Point]:
    """Of each kind of write in the whole campaign the first, in order."""
    kinds: set[str] = set()
    found = []
    for point in points:
        kind = point[0].partition(": ")[2]
        if kind not in kinds:
            kinds.add(kind)
            found.append(point)
    return found


def every(target: str, fault: str, points: Iterable[Point]) -> list[Case]:
    """A case at each of these."""
    return [Case(target, fault, at, number) for at, number in points]
