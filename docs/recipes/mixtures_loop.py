"""A closed loop: Ax proposes four mixtures, Decant pours them, a property is measured, and again: one run, one consent.

Run from a checkout: python docs/recipes/mixtures_loop.py [ROUNDS]. Needs `pip install ax-platform`. Without it a small
stand-in with the same interface proposes random mixtures. The property is synthetic.
"""

import json
import sys
from pathlib import Path

import numpy as np

import decant

LIQUIDS = ("water", "ethanol", "oil")
CONFIGS = Path(__file__).parents[2] / "configs"
TOTAL, SMALLEST = 60.0, 0.15  # g; smallest share

try:
    from ax.api.client import Client
    from ax.api.configs import RangeParameterConfig
except ImportError:

    class RangeParameterConfig(dict):
        """A searched share."""

    class Client:
        """Stands in for the client of Ax: random shares that keep the constraint."""

        def __init__(self, random_seed=None):
            self._rng, self._trials = np.random.default_rng(random_seed), 0

        def configure_experiment(self, parameters, parameter_constraints):
            """See Ax."""

        def configure_optimization(self, objective):
            """See Ax."""

        def get_next_trials(self, max_trials):
            """Return parameters by the index of the trial."""
            first, self._trials = self._trials, self._trials + max_trials
            shares = SMALLEST + (1.0 - 3.0 * SMALLEST) * self._rng.dirichlet(np.ones(3), max_trials)
            if first == 0:  # the centre, as Ax does
                shares[0] = 0.425, 0.425, SMALLEST
            return {first + i: {"water": float(row[0]), "ethanol": float(row[1])} for i, row in enumerate(shares)}

        def complete_trial(self, trial_index, raw_data):
            """See Ax."""

        def attach_trial(self, parameters):
            """Return the index of a trial with parameters of the caller."""
            self._trials += 1
            return self._trials - 1

        def mark_trial_abandoned(self, trial_index):
            """See Ax."""


class Loop:
    """Asks for four mixtures at a time, and tells what was reached.

    Args:
        cups: number of all mixtures.
        seed: of the optimiser.
    """

    def __init__(self, cups, seed):
        self.cups = cups
        largest = 1.0 - 2.0 * SMALLEST
        self.client = Client(random_seed=seed)
        self.client.configure_experiment(
            parameters=[
                RangeParameterConfig(name=liquid, parameter_type="float", bounds=(SMALLEST, largest))
                for liquid in LIQUIDS[:2]
            ],
            parameter_constraints=[f"water + ethanol <= {1.0 - SMALLEST}"],  # the rest is oil
        )
        self.client.configure_optimization(objective="property")
        self.proposed, self.told, self.best = [], 0, (0.0, [])

    def ask(self):
        """Up to four mixtures as Decant takes them; none if all cups are used."""
        mixtures, left = [], self.cups - len(self.proposed)
        trials = self.client.get_next_trials(max_trials=min(4, left)) if left else {}
        for index, shares in trials.items():
            self.proposed.append(index)
            amounts = [shares["water"], shares["ethanol"], 1.0 - shares["water"] - shares["ethanol"]]
            mixtures.append({name: f"{TOTAL * share:.2f} g" for name, share in zip(LIQUIDS, amounts, strict=True)})
        return mixtures

    def tell(self, table):
        """Measure the new cups of a run's table, and tell the shares that were reached instead of those proposed."""
        for _, rows in list(table.groupby("cup", sort=False))[self.told :]:
            index, self.told = self.proposed[self.told], self.told + 1
            if not (rows["state"] == "full").all():  # a cup that is not full tells nothing
                self.client.mark_trial_abandoned(trial_index=index)
                continue
            shares = rows.set_index("liquid")["share"][list(LIQUIDS)].to_numpy()
            value = measured(shares)
            try:
                reached = self.client.attach_trial({"water": float(shares[0]), "ethanol": float(shares[1])})
                self.client.mark_trial_abandoned(trial_index=index)
            except ValueError:  # just outside of the searched shares
                reached = index
            self.client.complete_trial(trial_index=reached, raw_data={"property": value})
            self.best = max(self.best, (value, [round(float(share), 3) for share in shares]))
        print(json.dumps({"cups": self.told, "best": round(self.best[0], 3), "shares": self.best[1]}), flush=True)

    def propose(self, table):
        """The next mixtures, from the table of those that were poured."""
        self.tell(table)
        return self.ask()


def measured(shares):
    """The property: largest, 1, at 50 % water, 30 % ethanol and 20 % oil."""
    return float(np.exp(-20.0 * np.sum((shares - [0.5, 0.3, 0.2]) ** 2)))


def campaign(first, rounds):
    """The first mixtures, and empty cups for the others."""
    cups = [f"{row}{i}" for row in "ABCDEFGH"[:rounds] for i in range(1, 5)]
    return decant.build_campaign(
        {
            "name": "loop",
            "seed": 1,
            "laboratory": "laboratories/twin.yaml",
            "pourer": "vessels/beaker.yaml",
            "receiver": "vessels/tumbler.yaml",
            "motion": {"x_offset": "90 mm", "height": "100 mm"},
            "mixtures": {
                "tolerance": "1 g",
                "liquids": [
                    {"name": "water", "liquid": {"name": "water", "mass": "350 g"}},
                    {"name": "ethanol", "liquid": {"name": "ethanol", "mass": "280 g"}},
                    {"name": "oil", "liquid": {"name": "rapeseed oil", "mass": "320 g"}},
                ],
                "wanted": dict(zip(cups, first, strict=False)),
                "cups": {"proposals": cups[len(first) :]},
            },
            "outputs": {"directory": str(Path("runs").absolute()), "recording": False},
        },
        CONFIGS,
    )


if __name__ == "__main__":
    rounds = int(sys.argv[1] if len(sys.argv) > 1 else 3)
    loop = Loop(cups=4 * rounds, seed=1)
    run = decant.run(campaign(loop.ask(), rounds), propose=loop.propose)
    loop.tell(run.mixtures)
