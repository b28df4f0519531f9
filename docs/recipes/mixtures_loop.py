"""A closed loop: an optimiser proposes four mixtures, Decant pours them, a property is measured, and again.

Run from a checkout: python docs/recipes/mixtures_loop.py [ROUNDS]. The optimiser has `ask` and `tell`, as Ax and BayBE
do; put yours in its place. The property is synthetic. Every round is one run, with one consent of its own.
"""

import json
import sys
from pathlib import Path

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel

import decant

LIQUIDS = ("water", "ethanol", "oil")
CONFIGS = Path(__file__).parents[2] / "configs"
TOTAL = 60.0  # g


class Optimiser:
    """Largest mean + 2 deviations of a Gaussian process over the shares of a mixture, on random candidates."""

    def __init__(self, seed: int) -> None:
        self._rng, self._shares, self._values = np.random.default_rng(seed), [], []

    def ask(self, count: int) -> list[np.ndarray]:
        """Propose shares of this many mixtures, each as if the ones before it had given what is expected."""
        candidates = 0.15 + 0.55 * self._rng.dirichlet(np.ones(len(LIQUIDS)), 500)  # every share is 15 % or more
        shares, values = [*self._shares], [*self._values]
        while values and len(shares) < len(self._shares) + count:
            model = GaussianProcessRegressor(RBF(0.2) + WhiteKernel(1e-3, "fixed"), normalize_y=True)
            mean, deviation = model.fit(shares, values).predict(candidates, return_std=True)
            best = int(np.argmax(mean + 2.0 * deviation))
            shares.append(candidates[best])
            values.append(mean[best])
        return shares[len(self._shares) :] or list(candidates[:count])

    def tell(self, shares: np.ndarray, value: float) -> None:
        """Learn from the shares that were reached, not those that were proposed."""
        self._shares.append(shares)
        self._values.append(value)


def measured(shares: np.ndarray) -> float:
    """The property: largest, 1, at 50 % water, 30 % ethanol and 20 % oil."""
    return float(np.exp(-20.0 * np.sum((shares - [0.5, 0.3, 0.2]) ** 2)))


def poured(proposals: list[np.ndarray], number: int) -> list[np.ndarray]:
    """Pour mixtures; returns the shares that were reached. A cup that is not full tells nothing, and is left out."""
    campaign = decant.build_campaign(
        {
            "name": f"loop-{number}",
            "seed": number,
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
                "wanted": {
                    f"A{i}": {liquid: f"{TOTAL * share:.2f} g" for liquid, share in zip(LIQUIDS, shares, strict=True)}
                    for i, shares in enumerate(proposals, start=1)
                },
            },
            "outputs": {"directory": str(Path("runs").absolute()), "recording": False},
        },
        CONFIGS,
    )
    table = decant.run(campaign).mixtures
    full = table[table["state"] == "full"]
    return [rows.set_index("liquid")["share"][list(LIQUIDS)].to_numpy() for _, rows in full.groupby("cup")]


if __name__ == "__main__":
    optimiser, best = Optimiser(seed=1), (0.0, None)
    for number in range(1, 1 + int(sys.argv[1] if len(sys.argv) > 1 else 3)):
        for shares in poured(optimiser.ask(4), number):
            value = measured(shares)
            optimiser.tell(shares, value)
            best = max(best, (value, [round(float(share), 3) for share in shares]))
        print(json.dumps({"round": number, "best": round(best[0], 3), "shares": best[1]}), flush=True)
