"""Which simulations a question carries where there are too many for a quick answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from actors.optimizer.core.problem import Data, Point


def thinned(data: Data, around: Sequence[Point], most: int) -> Data:
    """At most `most` observations: half of them those nearest to some places, the others spread over the rest.

    They are chosen by where they are and never by what they came to: leaving out high costs would make the others
    look better than they are.
    """
    if len(data) <= most:
        return data
    points = np.array(data.points)
    kept: list[int] = []
    if around:
        near = np.linalg.norm(points[:, None, :] - np.array(around)[None, :, :], axis=2).min(axis=1)
        kept = [int(i) for i in np.argsort(near, kind="stable")[: most // 2]]
    distance = np.full(len(points), np.inf)
    for i in kept:
        distance = np.minimum(distance, np.linalg.norm(points - points[i], axis=1))
    while len(kept) < most:
        distance[kept] = -1.0
        farthest = int(np.argmax(distance))
        kept.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    kept.sort()
    return Data(tuple(data.points[i] for i in kept), tuple(data.costs[i] for i in kept))
