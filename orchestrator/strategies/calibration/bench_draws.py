"""Benches as they may be: draws of θ with nuisances, from a calibration or from what is thought beforehand."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from sim_engine.liquids import SimulationParameters

FARTHEST = 3.0
"""Standard deviations beyond which no nuisance is drawn."""


def drawn_benches(
    best: SimulationParameters,
    count: int,
    seed: int,
    *,
    posterior: Sequence[SimulationParameters] = (),
    known: Collection[str] = (),
) -> tuple[SimulationParameters, ...]:
    """Equally likely θ of the bench that is to be poured on, its nuisances among them; pure.

    A posterior's draws are taken evenly, again and again if there are fewer than wanted. Nuisances that the calibration
    did not search differ between benches by their declared tolerances, around their values in those draws: normal,
    independent of each other, by a scrambled Sobol sequence, and within their bounds.

    Args:
        best: θ*, or whatever is in force: what all draws are where there is no posterior, nuisances aside.
        count: of draws, at least 1.
        seed: same seed, same draws.
        posterior: complete θ, equally likely.
        known: nuisances that are not to be drawn: the calibration has searched them, or a person vouches for them.

    Returns:
        `count` complete θ.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    if count < 1:
        raise ValueError(f"at least one draw is needed, got {count}")
    nuisances = [info for name, info in SimulationParameters.nuisances().items() if name not in known]
    rows = [posterior[(i * len(posterior)) // count] if count <= len(posterior) else posterior[i % len(posterior)]
            for i in range(count)] if posterior else [best] * count  # fmt: skip
    if not nuisances:
        return tuple(rows)
    sampler = qmc.Sobol(len(nuisances), scramble=True, rng=np.random.default_rng([seed % 2**64, *b"bench"]))
    uniform = sampler.random_base2(math.ceil(math.log2(count)) if count > 1 else 0)[:count]
    z = np.clip(ndtri(uniform), -FARTHEST, FARTHEST)
    benches = []
    for row, theta in zip(z, rows, strict=True):
        moved = {
            info.name: min(max(getattr(theta, info.name) + info.tolerance * float(u), info.lower), info.upper)
            for info, u in zip(nuisances, row, strict=True)
        }
        benches.append(theta.model_copy(update=moved))
    return tuple(benches)
