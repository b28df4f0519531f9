"""Sections of docs/evidence/performance.md, each from the JSON of one benchmark."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import page_figures
from standard_pour import LEFT, LEFT_LIMIT

TARGETS = {2_000: (1.5, 0.6), 5_000: (5.0, 2.0), 10_000: (12.0, 5.0)}
"""Required and target CPU seconds of the standard pour, by particles."""

LEAST_SHARE = 0.05
"""Share of a pass from which the table of the profile has it; the picture has all."""

SLOWEST = 3
"""Number of checked files that are shown by name."""

PHYSICS = ("left at 2.3 s", "2.7 s", "3.1 s", "", "delivered", "density inside")

Record = Mapping[str, Any]
"""A measurement: its `command` and printed `result`."""


def introduction() -> str:
    """Return the introduction: purpose of the page and how to update it."""
    return """# Performance

<!-- written by benchmarks/make_page.py from docs/data/performance.json -->

The cost of a simulated pour, and a comparison with SPlisHSPlasH, the fastest open CPU solver that we know of. This
command measures everything again and writes the page:

<!-- needs: checkout and minutes -->
```
python benchmarks/make_page.py --measure
```

The standard pour: 200 mL in a straight cup (R 40 mm, H 100 mm), turned about its lip at 30 °/s to 120°, over a receiver
110 mm below; 6 s. CPU seconds: one core, one thread, kernels compiled, without set-up.
"""


def targets(pours: Sequence[Record]) -> str:
    """Return the section that compares speed with its targets, together with physical results."""
    rows, physics = [], []
    for record in pours:
        r = record["result"]
        required, aim = TARGETS.get(r["particles"], (None, None))
        rows.append(
            (
                f"{r['particles']:,}",
                seconds(required),
                seconds(aim),
                f"**{seconds(r['cpu_s'])}**",
                verdict(r["cpu_s"], required, aim),
                seconds(r["whole"]["cpu_s"]),
                seconds(r.get("with_cohesion", {}).get("cpu_s")),
                f"{r['steps']:,}",
                f"{r['iterations_per_step']:.3g}",
                f"{1e-6 * r['particle_iterations_per_s']:.2g} M",
            )
        )
        for name, figures in (("mirrored", r), ("whole", r["whole"])):
            compression = f"{100 * figures['density_error']:.2g} %"
            physics.append((f"{r['particles']:,}", name, *_physics(figures), compression))
    right = prose(
        f"""Speed counts only with the physics right. Fractions left in the pourer may differ by {LEFT_LIMIT:g} from
        those of infinitely fine particles, {", ".join(f"{value:g}" for value in LEFT)}.
        [Validation](validation.md#outflow-of-the-standard-pour) judges them with other seeds: near the limit the
        verdicts may differ. Density is that of Voronoi cells in the tilted cup at 1 s."""
    )
    speed_table = table(
        ("N", "required", "aim", "CPU s", "", "whole pour", "with cohesion", "steps", "iterations a step",
         "particle-iterations/s"),
        rows,
        "rrrrlrrrrr",
    )  # fmt: skip
    physics_table = table(("N", "", *PHYSICS, "mean compression"), physics, "rlrrrlrrr")
    about = prose(
        f"""Medians over seeds. The pour is its own mirror image, so that one half is simulated
        ([simulator](../explanation/simulator.md)); 'whole pour': the same with `symmetry: off`. A pour ends when
        nothing can change any more, here after {pours[0]["result"]["simulated_time_s"]:.1f} s. Particles that have left
        the solver count in particle-iterations. The pour has no surface tension, as the peer has none; 'with cohesion':
        at the default of 0.02 N/m."""
    )
    return f"""## Against the targets

{speed_table}
{about}

{right}

{physics_table}
{settings(pours)}"""


def beside_the_peer(pours: Sequence[Record]) -> str:
    """Return the section on the peer's figures, measured in the same session."""
    both = [record for record in pours if "peer" in record["result"]]
    rows, physics = [], []
    for record in both:
        r, peer = record["result"], record["result"]["peer"]
        rows.append(
            (
                f"{r['particles']:,}",
                seconds(r["cpu_s"]),
                seconds(peer["cpu_s"]),
                f"**{r['ratio']:.3g}**",
                f"{r['ratio_per_simulated_second']:.3g}",
                f"{r['whole']['ratio']:.3g}",
                f"{r['whole']['ratio_per_simulated_second']:.3g}",
                f"{peer['steps']:,}",
                f"{peer['iterations_per_step']:.3g}",
                f"{1e-6 * peer['particle_iterations_per_s']:.2g} M",
            )
        )
        physics.append((f"{r['particles']:,}", *_physics(peer)))
    head = (
        *("N", "Decant, CPU s", "peer, CPU s", "ratio", "ratio per simulated second"),
        *("ratio without symmetry", "the same per simulated second"),
        *("its steps", "its iterations a step", "its particle-iterations/s"),
    )
    about = prose(
        f"""{both[0]["result"]["peer"]["name"]}: same core, runs of both in turns, one thread each, without set-up. The
        peer always simulates 6 s of the whole liquid. Decant simulates one half of it: the first ratio contains this
        symmetry and an earlier end; the others leave out one or both."""
    )
    return f"""## Compared with the fastest peer

{about}

{table(head, rows, "rrrrrrrrrr")}
Its physics, measured as ours:

{table(("N", *PHYSICS), physics, "rrrrlrr")}
![CPU seconds against the number of particles](../images/{page_figures.COST})
"""


def passes(record: Record) -> str:
    """Return the section on the profile."""
    title = "Where the time goes"
    r = record["result"]
    moments = page_figures.MOMENTS
    rows = [
        (
            name,
            *(f"{100 * r[moment]['share'].get(name, 0.0):.1f} %" for moment in moments),
            f"{r[moments[0]]['calls_per_step'][name]:.2g}",
        )
        for name, share in r[moments[0]]["share"].items()
        if share >= LEAST_SHARE
    ]
    if r["slower"] > 1.0:
        clock = f"With the clock the pour takes {r['slower']:.2f} times as long"
    else:
        clock = "The cost of the clock is within the noise of two pours"
    about = prose(
        f"""A clock around every pass of the kernel, in one standard pour with {r["particles"]:,} particles. {clock};
        the passes make up {100 * r["explained"]:.0f} % of the time measured from outside. The table has those of
        {100 * LEAST_SHARE:.0f} % or more."""
    )
    return f"""## {title}

{about}

{table(("pass", *moments, "calls a step"), rows, "lrrr")}
![Share of each pass](../images/{page_figures.PASSES})

{settings([record])}"""


def cost(record: Record) -> str:
    """Return the section on CPU seconds against N."""
    title = "Cost against the number of particles"
    r = record["result"]
    rows = [
        (
            f"{row['particles']:,}",
            seconds(row["cpu_s"]),
            f"{1e6 * row['cpu_s'] / row['particles']:.0f}",
            f"{1e-6 * row['particle_iterations_per_s']:.2g} M",
        )
        for row in r["cost"]
    ]
    growth = (
        f"CPU seconds grow as N^{r['exponent']:.2f}: steps shorten with the spacing."
        if r["exponent"] is not None
        else ""
    )
    head = ("N", "CPU s", "µs a particle", "particle-iterations/s")
    return f"""## {title}

{table(head, rows, "rrrr")}
{growth}

{settings([record])}"""


def memory(record: Record) -> str:
    """Return the section on resident memory."""
    title = "Memory"
    first, *_, last = record["result"]["memory"]
    text = prose(
        f"""A process with one simulator has {first["process_mb"]:.0f} MB early in a pour with {first["particles"]:,}
        particles, and {last["process_mb"]:.0f} MB with {last["particles"]:,}: packages {last["imports_mb"]:.0f}, Taichi
        {last["taichi_mb"]:.0f}, the solver's arrays {last["arrays_mb"]:.0f}, kernels and vessels
        {last["kernels_and_vessels_mb"]:.0f}, the pour {last["pour_mb"]:.0f}."""
    )
    return f"## {title}\n\n{text}\n\n{settings([record])}"


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
    word, cold = ("met" if r[name] else "**missed**" for name in ("within_limit", "cold_within_limit"))
    about = prose(
        f"""Seconds from the start of a process to the answer to its first standard pour with {r["particles"]:,}
        particles. Required: {r["limit_s"]:g} s with a warm cache ({word}), {r["cold_limit_s"]:g} s with an empty one
        ({cold}). The cache has {r["cache_mb"]:g} MB of compiled kernels and vessels' grids."""
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
        """The packages that can compile the solver, in alternating processes: CPU seconds of the standard pour, the
        fractions that it leaves in the pourer with the most particles, CPU seconds of a process up to its first pour
        with a warm and an empty cache, peak memory, installed size. Compare rows only: all processes share one busy
        core. Taichi is the default, because all other figures are from it, and it starts faster once kernels are
        cached. Quadrants starts faster without a cache, is smaller, and is maintained."""
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
        """**GPU.** The solver of commit 2caae76a, with CUDA on an NVIDIA H200 (driver 580.159.04, Taichi 1.7.4, 500
        particles, 60 °/s to 85°, seeds from 0): the pourer keeps 15.439 ± 0.001 % (standard error) in 32,768 pours
        side by side, and 15.459 ± 0.010 % in 512 on that machine's CPU. A scene is a thread. One pour takes 7.9 s (0.4
        s on the CPU), 512 take 48 s, 2,048 take 63 s, 8,192 take 98 s, and 32,768 take 246 s: 133 a second; the 16
        cores make 37, and are faster up to 2,048."""
    )
    return f"## {title}\n\n{about}\n\n{table(head, rows, 'lrrlrrrr')}\n{settings([record])}\n{gpu}\n"


def plan(record: Record) -> str:
    """Return the section on the duration of a plan for a new cup."""
    title = "Planning"
    r = record["result"]
    rows = [
        (
            row["receiver"],
            f"{row['seconds']:.1f}",
            f"{row['cpu_s']:.1f}",
            str(row["simulations"]),
            f"{100 * row['predicted_spillage']:.1f} %",
        )
        for row in r["plans"]
    ]
    about = prose(
        f"""Seconds of `decant plan` for the quickstart's pour into unseen cups: fresh processes with start, figures and
        report; kernels cached. Required on two cores: {r["limit_s"]:g} s (median {r["seconds"]:.1f},
        {_met(r["within_limit"])})."""
    )
    titles = ("into", "s", "CPU s", "simulations", "predicted to spill")
    return f"## {title}\n\n{about}\n\n{table(titles, rows, 'lrrrr')}\n{settings([record])}"


def validate(record: Record) -> str:
    """Return the section on the cost of checking every shipped file."""
    title = "Checking a file"
    r = record["result"]
    files = sorted(r["files"], key=lambda row: float(row["cpu_s"]), reverse=True)
    rows = [(f"`{row['file']}`", f"{row['cpu_s']:.2f}") for row in files[:SLOWEST]]
    rest = f"{files[-1]['cpu_s']:.2f} to {files[SLOWEST]['cpu_s']:.2f}" if len(files) > SLOWEST else "none"
    rows.append(("all others", rest))
    about = prose(
        f"""CPU seconds of `decant validate` for {len(files)} shipped files: medians of {r["repeats"]} fresh processes
        with a warm cache, with their start. Required: {r["limit_s"]:g} ({_met(r["within_limit"])})."""
    )
    return f"## {title}\n\n{about}\n\n{table(('file', 'CPU s'), rows, 'lr')}\n{settings([record])}"


def pool(record: Record) -> str:
    """Return the section on `pool_speed.py`."""
    title = "Pool and cluster"
    r = record["result"]
    about = prose(
        f"""{r["workers"]} simulators of the pool (Ray actors) compared with {r["workers"]} plain processes, the same
        {r["pours"]} standard pours with {r["particles"]:,} particles, in turns; medians. Overhead: time of a busy
        worker without simulating, per simulation."""
    )
    rows = [
        ("pours a minute, pool", f"{r['pours_per_minute_pool']:.0f}", "", ""),
        ("pours a minute, plain processes", f"{r['pours_per_minute_plain']:.0f}", "", ""),
        ("pool over plain", f"**{r['throughput_ratio']:.3f}**", "≥ 0.95", _met(r["throughput_met"])),
        ("workers busy while work was queued", f"{100 * r['busy_fraction']:.1f} %", "", ""),
        ("CPU of all other processes", f"{100 * r['cpu_beside_the_workers']:.1f} %", "", ""),
        (
            f"overhead a simulation, pours of {r['tiny_pour_ms']:.0f} ms",
            f"**{r['overhead_ms']:.1f} ms**",
            "≤ 10 ms",
            _met(r["overhead_met"]),
        ),
        ("first answer after opening a laboratory", f"{r['start_s']['first answer after opening']:.1f} s", "", ""),
    ]
    shown = table(("", "", "required", ""), rows, "lrll")
    return f"## {title}\n\n{about}\n\n{shown}\n{settings([record])}"


def machines(records: Iterable[Record]) -> str:
    """Return a line with the machines and solvers of all measurements."""
    found = dict.fromkeys(_place(record["result"]["machine"]) for record in records)
    return prose(f"Measured on {'; '.join(found)}.") + "\n" if found else ""


def _place(machine: Mapping[str, Any]) -> str:
    named = "{processor}, {cores} cores, {system}, Python {python}, {engine}, solver {solver}"
    return named.format_map({**machine, "engine": machine["engine"].capitalize()})


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


def verdict(cpu_s: float, required: float | None, aim: float | None) -> str:
    """Compare a time with its targets."""
    if required is None or aim is None:
        return ""
    if cpu_s <= aim:
        return "aim reached"
    return "met" if cpu_s <= required else "**missed**"


def _physics(result: Record) -> tuple[str, ...]:
    left = tuple(result["left"].values())
    off = max(abs(value - reference) for value, reference in zip(left, LEFT, strict=True))
    word = "right" if off <= LEFT_LIMIT else "**off**"
    return (*(f"{value:.3f}" for value in left), word, f"{result['delivered']:.3f}", f"{result['density_at_rest']:.3f}")


def _met(met: bool) -> str:
    return "met" if met else "**missed**"
