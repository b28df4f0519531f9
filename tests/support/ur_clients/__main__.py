"""What the unmodified client library sees: each scenario runs in a process of its own and prints one line of JSON.

    python clients SCENARIO ADDRESS '{"argument": 1}'

Not a test; tests judge what is printed. Nothing of this project is imported.
"""

from __future__ import annotations

import json
import os
import sys

import motion
import ports
import stops

SCENARIOS = {name: scenario for module in (motion, ports, stops) for name, scenario in vars(module).items()}


def main() -> None:
    scenario, address, arguments = sys.argv[1:4]
    seen = SCENARIOS[scenario](address, **json.loads(arguments))
    print(json.dumps(seen), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
