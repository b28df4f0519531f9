"""Ask whether the explanation of a first day finds which quantity of a virtual bench is wrong.

    python benchmarks/first_day.py

Two benches each have a wrong lag (1 s), repeated readings (42 %), grip (±1°), height (±2 mm) and viscosity (50 to
100 mPa·s poured as 'water', and water poured as such a liquid). The question: is the wrong one the first that stands
out? Seeds and questions are fixed here. The bench is not the model of the fits (`actors.dosing.virtual_dosing_bench`).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from orchestrator.recordings.first_day import WRONG, practice_day
from orchestrator.recordings.rig_diagnosis import diagnose

FIRST_SEED = 52_000


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--in-order", type=int, default=0, help="benches without an error, in addition")
    options = parser.parse_args()
    cases = [(name, sign) for sign in (1, -1) for name in WRONG] + [(None, 1)] * options.in_order
    right = inside = 0
    for seed, (wrong, sign) in enumerate(cases, start=options.first):
        with tempfile.TemporaryDirectory() as folder:
            day = practice_day(Path(folder), seed, wrong, sign)
        begin = time.process_time()
        found = diagnose(day)
        main_one = None if found.main is None else found.main.name
        right += main_one == wrong
        evidence = ", ".join(f"{one.name} {one.evidence:.1f}" for one in found.explanations)
        inside += sum(one.inside for one in found.doses)
        spent = time.process_time() - begin
        print(f"{seed}: {wrong} {sign:+d} → {main_one}  ({evidence}; {spent:.0f} CPU s)", flush=True)
    print(f"{right} of {len(cases)} right; {inside} of {5 * len(cases)} doses inside their 90 % interval")


if __name__ == "__main__":
    main()
