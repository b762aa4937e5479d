"""The walls of an exported maze as exact squares, and what can be asked of them.

Shares nothing with the planner: distances come from the squares themselves, in double precision.
"""

import numpy as np
from scipy.spatial import cKDTree


class World:
    """Solid squares of one size on a raster whose origin is the origin of the map frame."""

    # A square's centre is at most 0.71 sides from its nearest point and at least half a side, so
    # the nearest square is among the squares whose centres are hardly farther than the nearest.
    CANDIDATES = 16

    def __init__(self, record):
        self.side = record["resolution_m"]
        rows = record["rows"]
        solid = np.array([[c == "#" for c in row] for row in rows])
        iy, ix = np.nonzero(solid)
        self.centres = (np.stack([ix, iy], axis=1) + 0.5) * self.side
        self.tree = cKDTree(self.centres)

    def nearest(self, points):
        """Distance to the nearest solid square and the point of it that is nearest."""
        points = np.asarray(points, float)
        _, index = self.tree.query(points, k=self.CANDIDATES)
        centres = self.centres[index]
        offset = points[:, None, :] - centres
        inside = np.clip(offset, -0.5 * self.side, 0.5 * self.side)
        distance = np.linalg.norm(offset - inside, axis=2)
        best = np.argmin(distance, axis=1)
        rows = np.arange(len(points))
        return distance[rows, best], (centres + inside)[rows, best]

    def distance(self, points):
        return self.nearest(points)[0]

    def reach(self, origins, directions, keep, longest):
        """How far each point can move along its direction with the distance never below `keep`.

        Sphere tracing: a point can always move on by what its distance exceeds `keep`.
        """
        travelled = np.zeros(len(origins))
        active = np.arange(len(origins))
        for _ in range(2000):
            at = origins[active] + travelled[active, None] * directions[active]
            room = self.distance(at) - keep
            travelled[active] += np.maximum(room, 0.0)
            active = active[(room > 1e-7) & (travelled[active] < longest)]
            if not len(active):
                break
        return np.minimum(travelled, longest)
