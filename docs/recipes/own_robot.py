"""Pours of your own robot: Decant chooses the motions and keeps the journal, this program pours and weighs.

Run from a checkout: python docs/recipes/own_robot.py FOLDER. The same command continues an interrupted session.
"""

import sys
from pathlib import Path

import decant


def pour_and_weigh(settings, load_g):
    """Replace this: have your robot pour, and return the masses next to the receiver and in it [g]."""
    spilled = 0.5 + 0.2 * abs(settings["x_offset_mm"] - 110.0)  # a robot that pours best from 110 mm
    return spilled, load_g - spilled


campaign = {
    "name": "own-robot",
    "laboratory": {"name": "my-robot", "mode": "external"},
    "liquid": {"name": "water", "mass": "200 g"},
    "pourer": "vessels/beaker.yaml",
    "deployment": {
        "strategy": "D2",  # learns from pours only; D3 also simulates
        "receiver": "vessels/narrow.yaml",
        "motion": {"max_angle": "120 deg", "height": "110 mm", "return_velocity": "90 deg/s"},
        "actions": {"angular_velocity": ["50 deg/s", "150 deg/s"], "x_offset": ["95 mm", "130 mm"]},
        "pours": 8,
    },
}

with decant.AskTell(decant.build_campaign(campaign, Path(__file__).parents[2] / "configs"), sys.argv[1]) as session:
    while (pour := session.ask()) is not None:
        if pour.unknown:  # the session before this one ended while it was poured
            session.fail(pour, "interrupted")
        else:
            spilled, received = pour_and_weigh(pour.settings, pour.load_g)
            session.tell(pour, spilled_g=spilled, received_g=received)
print(session.run.recommended)
