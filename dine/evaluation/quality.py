"""How close to the truth a moved source is; what is lost and what is accurate.

Definitions, units and sources of all of them: docs/reference/metrics.md.
"""

from __future__ import annotations

import numpy as np

FAILURE = 0.1
"""Correspondence error in the normalised frame above which a point, or a pair by its mean, is lost:
5 % of the diameter of the source, which is 2 there."""
WITHIN = {"accuracy_2_5": 0.05, "accuracy_5": FAILURE}
"""Largest error of an accurate point by metric, in the normalised frame: 2.5 and 5 % of the
diameter."""


def correspondence(moved: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Distances, not squared, of (N, 3) moved points from their true places (N, 3), normalised.

    ``mce``, ``mce_median`` and ``mce_p95`` are mean, median and 95th percentile over the points,
    ``accuracy_2_5`` and ``accuracy_5`` the shares with an error of at most 2.5 and 5 % of the
    diameter (0.05 and 0.1), ``far_points`` the share above 0.1.
    """
    errors = np.linalg.norm(moved - target, axis=1)
    median, p95 = np.percentile(errors, (50, 95))
    return {
        "mce": float(errors.mean()),
        "mce_median": float(median),
        "mce_p95": float(p95),
        **{name: float((errors <= limit).mean()) for name, limit in WITHIN.items()},
        "far_points": float((errors > FAILURE).mean()),
    }
