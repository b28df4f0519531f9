"""Sections of docs/evidence/performance.md, each from the JSON of one benchmark."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import page_figures
from standard_pour import LEFT, LEFT_LIMIT

PHYSICS = ("left at 2.3 s", "2.7 s", "3.1 s", "", "delivered")

Record = Mapping[str, Any]
"""A measurement: its `command` and printed `result`."""


def introduction(pours: Sequence[Record]) -> str:
    """Return the introduction: result and purpose of the page, and how to update it."""
    first, last = (f"{seconds(r['cpu_s'])} CPU seconds with {r['particles']:,}" for r in _ends(pours))
    times, whole = (
        f"{min(ratios):.0f} to {max(ratios):.0f}"
        for ratios in zip(*((r["ratio"], r["whole"]["ratio"]) for r in _with_peer(pours)), strict=True)
    )
    result = prose(
        f"""A simulated pour of 200 mL takes {first} particles and {last}, on one core. SPlisHSPlasH, the fastest open
        CPU solver that we know of, takes {times} times as long, and {whole} times as long as Decant without the use
        of symmetry."""
    )
    return f"""# Speed

<!-- written by benchmarks/make_page.py from docs/data/performance.json -->

{result}

<!-- needs: checkout and minutes -->
```
python benchmarks/make_page.py --measure    # measures everything again and writes this page
```

The standard pour: 200 mL in a straight cup (R 40 mm, H 100 mm), turned about its lip at 30 °/s to 120°, over a receiver
110 mm below; 6 s. CPU seconds: one core, one thread, kernels compiled, without set-up.
"""


def _ends(pours: Sequence[Record]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Results with the fewest and the most particles."""
    return pours[0]["result"], pours[-1]["result"]


def _with_peer(pours: Sequence[Record]) -> list[Mapping[str, Any]]:
    return [record["result"] for record in pours if "peer" in record["result"]]


def standard_pour(pours: Sequence[Record]) -> str:
    """Return the section on time and outcome of the standard pour, of both programs."""
    rows, physics = [], []
    for record in pours:
        r, peer = record["result"], record["result"].get("peer")
        number = f"{r['particles']:,}"
        ratios = () if peer is None else (f"**{r['ratio']:.3g}**", f"{r['whole']['ratio']:.3g}")
        rows.append(
            (
                number,
                f"**{seconds(r['cpu_s'])}**",
                seconds(r["whole"]["cpu_s"]),
                seconds(r.get("with_cohesion", {}).get("cpu_s")),
                "" if peer is None else seconds(peer["cpu_s"]),
                *(ratios or ("", "")),
            )
        )
        programs = (("mirrored", r), ("whole", r["whole"]), *((("peer", peer),) if peer else ()))
        physics += [(number, name, *_physics(figures)) for name, figures in programs]
    head = ("N", "mirrored", "whole", "mirrored, with cohesion", "peer", "peer over mirrored", "peer over whole")
    peers = _with_peer(pours)
    name = peers[0]["peer"]["name"] if peers else "none"
    about = prose(
        f"""Medians over seeds. The pour is its own mirror image, so that one half is simulated
        ([simulator](../explanation/simulator.md)), and it ends when nothing can change any more, here after
        {pours[0]["result"]["simulated_time_s"]:.1f} s. Peer: {name}, same core, runs of both in turns; it always
        simulates 6 s of the whole liquid. The pour has no surface tension, as the peer has none."""
    )
    fine = ", ".join(f"{value:g}" for value in LEFT)
    right = prose(
        f"""Right: the fractions left in the pourer are within {LEFT_LIMIT:g} of those of infinitely fine particles,
        {fine}. The [solver's page](validation.md#outflow-of-the-standard-pour) judges them with other seeds."""
    )
    return f"""## The standard pour

{table(head, rows, "rrrrrrr")}
{about}

![CPU seconds against the number of particles](../images/{page_figures.COST})

{right}

{table(("N", "", *PHYSICS), physics, "rlrrrlr")}
{settings(pours)}"""


def cost(record: Record) -> str:
    """Return the section on CPU seconds against N."""
    title = "Cost against the number of particles"
    r = record["result"]
    rows = [
        (
            f"{row['particles']:,}",
            seconds(row["cpu_s"]),
            f"{1e6 * row['cpu_s'] / row['particles']:.0f}",
        )
        for row in r["cost"]
    ]
    growth = (
        f"CPU seconds grow as N^{r['exponent']:.2f}: steps shorten with the spacing."
        if r["exponent"] is not None
        else ""
    )
    head = ("N", "CPU s", "µs a particle")
    return f"""## {title}

{table(head, rows, "rrr")}
{growth}

{settings([record])}"""


def start_up(record: Record) -> str:
    """Return the section on the first outcome of a new process."""
    title = "Start-up"
    r = record["result"]
    phases = tuple(r["warm"]["phases"])
    rows = [
        (
            f"{name} cache",
            f"**{r[name]['answered_s']:.1f}**",
            f"{r[name]['cpu_s']:.1f}",
            *(f"{r[name]['phases'][phase]:.2f}" for phase in phases),
        )
        for name in ("warm", "cold")
    ]
    about = prose(
        f"""Seconds from the start of a process to the answer to its first standard pour with {r["particles"]:,}
        particles. The cache has {r["cache_mb"]:g} MB of compiled kernels and vessels' grids."""
    )
    return f"""## {title}

{about}

{table(("", "answer after", "CPU s", *phases), rows, "lrr" + "r" * len(phases))}
{settings([record])}"""


def engines(record: Record) -> str:
    """Return the section that compares the packages that can compile the solver."""
    title = "Engines"
    r = record["result"]
    rows = [
        (
            row["engine"],
            *map(seconds, row["cpu_s"]),
            ", ".join(f"{value:.3f}" for value in row["left"]),
            f"{row['warm_cpu_s']:.1f}",
            f"{row['cold_cpu_s']:.1f}",
            f"{row['memory_mb']:,}",
            f"{row['size_mb']:,}",
        )
        for row in r["engines"]
    ]
    about = prose(
        """The packages that can compile the solver, in alternating processes: CPU seconds of the standard pour,
        fractions that it leaves in the pourer, CPU seconds up to the first pour with a warm and an empty cache,
        peak memory, installed size. Compare rows only: all share one busy core. Taichi is the default; Quadrants is
        maintained."""
    )
    head = (
        "",
        *(f"N = {n:,}" for n in r["particles"]),
        "left in the pourer",
        "start",
        "cold start",
        "memory [MB]",
        "size [MB]",
    )
    gpu = prose(
        """**GPU.** With CUDA on an NVIDIA H200, one pour of 500 particles takes 7.9 s (0.4 s on the CPU), 2,048 side
        by side take 63 s and 32,768 take 246 s: 133 a second, where the machine's 16 cores make 37 and are faster
        up to 2,048. Outcomes agree within 0.02 points. Measured with the solver of commit 2caae76a, not made again."""
    )
    return f"## {title}\n\n{about}\n\n{table(head, rows, 'lrrlrrrr')}\n{settings([record])}\n{gpu}\n"


def plan(record: Record) -> str:
    """Return the section on the duration of a plan for a new cup."""
    r = record["result"]
    cups = ", ".join(f"{row['receiver']} {row['seconds']:.1f} s" for row in r["plans"])
    about = prose(
        f"""`decant plan` for the quickstart's pour into an unseen cup, a fresh process with start, figures and report,
        kernels cached, two cores: {cups}, with {r["plans"][0]["simulations"]} simulations; median
        {r["seconds"]:.1f} s."""
    )
    return f"## Planning\n\n{about}\n\n{settings([record])}"


def validate(record: Record) -> str:
    """Return the section on the cost of checking every shipped file."""
    r = record["result"]
    costs = sorted(float(row["cpu_s"]) for row in r["files"])
    about = prose(
        f"""`decant validate` takes {costs[0]:.2f} to {costs[-1]:.2f} CPU seconds for each of {len(costs)} shipped
        files, with the start of the process and a warm cache."""
    )
    return f"## Checking a file\n\n{about}\n\n{settings([record])}"


def pool(record: Record) -> str:
    """Return the section on `pool_speed.py`."""
    r = record["result"]
    about = prose(
        f"""{r["workers"]} simulators of the pool (Ray actors) make {r["throughput_ratio"]:.3f} times the standard pours
        a minute of {r["workers"]} plain processes ({r["pours_per_minute_pool"]:.0f} with {r["particles"]:,}
        particles), and are busy for {100 * r["busy_fraction"]:.1f} % of the time while work is queued. A simulation
        costs {r["overhead_ms"]:.1f} ms more than its computing time. The first answer of a new laboratory comes
        after {r["start_s"]["first answer after opening"]:.1f} s."""
    )
    return f"## Pool\n\n{about}\n\n{settings([record])}"


def machines(records: Iterable[Record]) -> str:
    """Return a line with the machines and solvers of all measurements."""
    solvers: dict[str, list[str]] = {}
    for record in records:
        machine = record["result"]["machine"]
        named = "{processor}, {cores} cores, {system}, Python {python}, {engine}"
        place = named.format_map({**machine, "engine": machine["engine"].capitalize()})
        solvers.setdefault(place, []).append(machine["solver"])
    places = (f"{place}, solver {', '.join(dict.fromkeys(found))}" for place, found in solvers.items())
    return prose(f"Measured on {'; '.join(places)}.") + "\n" if solvers else ""


def settings(records: Sequence[Record]) -> str:
    """Return commands and times of one or several measurements, in small print."""
    made = []
    for record in records:
        m, core = record["result"]["machine"], record["result"].get("core")
        where = f"core {core}, " if core is not None else ""
        made.append(f"`{record['command']}` ({m['date']}, {where}load {m['load_average'][0]})")
    return f"<sub>{', '.join(made)}</sub>\n"


def prose(text: str) -> str:
    """Wrap a paragraph to the pages' line length."""
    return textwrap.fill(" ".join(text.split()), 120, break_long_words=False, break_on_hyphens=False)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], align: str) -> str:
    """Return a Markdown table; `align` has an l or r for each column."""
    marks = {"l": "---", "r": "---:"}
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(marks[a] for a in align) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def seconds(value: float | None) -> str:
    """Format CPU seconds: '0.61', '5.3', '176'."""
    if value is None:
        return ""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _physics(result: Record) -> tuple[str, ...]:
    left = tuple(result["left"].values())
    off = max(abs(value - reference) for value, reference in zip(left, LEFT, strict=True))
    word = "right" if off <= LEFT_LIMIT else "**off**"
    return (*(f"{value:.3f}" for value in left), word, f"{result['delivered']:.3f}")
