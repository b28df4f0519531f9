"""Sections of the performance page about plans, files and pools."""

from __future__ import annotations

from page_sections import Record, missing, prose, settings, table

SLOWEST = 3
"""Number of files that are shown by name."""


def plan(record: Record | None) -> str:
    """Return the section on the duration of a plan for a new cup."""
    title = "Planning"
    if record is None:
        return missing(title, "plan_speed.py")
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


def validate(record: Record | None) -> str:
    """Return the section on the cost of checking every shipped file."""
    title = "Checking a file"
    if record is None:
        return missing(title, "validate_cost.py")
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


def pool(record: Record | None) -> str:
    """Return the section on `pool_speed.py`."""
    title = "Pool and cluster"
    if record is None:
        return missing(title, "pool_speed.py")
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
        ("the same by CPU seconds", f"{r['throughput_ratio_by_cpu']:.3f}", "", ""),
        ("workers busy while work was queued", f"{100 * r['busy_fraction']:.1f} %", "", ""),
        ("CPU of all other processes", f"{100 * r['cpu_beside_the_workers']:.1f} %", "", ""),
        (
            f"overhead a simulation, pours of {r['tiny_pour_ms']:.0f} ms",
            f"**{r['overhead_ms']:.1f} ms**",
            "≤ 10 ms",
            _met(r["overhead_met"]),
        ),
        ("the same with a simulator that does nothing", f"{r['empty_overhead_ms']:.1f} ms", "", ""),
        ("one such simulation, there and back", f"{r['empty_round_trip_ms']:.1f} ms", "", ""),
        ("first answer after opening a laboratory", f"{r['start_s']['first answer after opening']:.1f} s", "", ""),
    ]
    shown = table(("", "", "required", ""), rows, "lrll")
    return f"## {title}\n\n{about}\n\n{shown}\n{settings([record])}"


def _met(met: bool) -> str:
    return "met" if met else "**missed**"
