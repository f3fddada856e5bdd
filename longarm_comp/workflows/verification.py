"""Verifies at the tip that compensation helps: the same targets, driven without and with it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.errors import JobError
from longarm_comp.report.plots import draw_errors_at_tip
from longarm_comp.report.style import rc, save

LEAST = 2
"""Smallest number of targets that both runs must see, for an interval."""


@dataclass(frozen=True, eq=False)
class Verification:
    """Two runs over the same targets, compared target by target.

    Attributes:
        runs: (N, 3) tip - target, m, by name, at the targets that were seen in both runs.
        gain_m, gain_ci95_m: decrease of the mean ``|tip - target|`` by compensation, and its 95 %
            bootstrap interval.
    """

    runs: Mapping[str, np.ndarray]
    gain_m: float
    gain_ci95_m: tuple[float, float]

    @property
    def helps(self) -> bool:
        """True where compensation brings the tip nearer, beyond chance: the interval is above 0."""
        return self.gain_ci95_m[0] > 0.0

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The table: one row per run."""
        return [error_row(name, error) for name, error in self.runs.items()]

    @property
    def summary(self) -> str:
        """The result in one sentence."""
        low, high = (1e3 * g for g in self.gain_ci95_m)
        said = "helps" if self.helps else "does not help beyond chance"
        return (
            f"compensation {said}: the mean error falls by {1e3 * self.gain_m:.3f} mm "
            f"[{low:.3f}, {high:.3f}] over {self.rows[0]['n']} targets"
        )

    def picture(self, path: Path) -> None:
        """Write the two runs as a picture; the file's ending decides the format."""
        with rc():
            save(draw_errors_at_tip(self.runs), path)


def compare_runs(
    names: tuple[str, str], without: np.ndarray, compensated: np.ndarray, seed: int = 0
) -> Verification:
    """Compare two runs over the same targets, target by target.

    Args:
        names: names of the two runs.
        without, compensated: (N, 3) tip - target, m; NaN where the marker was lost.

    Raises:
        JobError: fewer than `LEAST` targets were seen in both runs.
    """
    both = np.isfinite(without).all(axis=1) & np.isfinite(compensated).all(axis=1)
    if both.sum() < LEAST:
        raise JobError(
            "the marker was not seen in both runs at enough targets",
            seen=int(both.sum()),
            targets=len(without),
            needed=LEAST,
        )
    before, after = without[both], compensated[both]
    gain = np.linalg.norm(before, axis=1) - np.linalg.norm(after, axis=1)
    # Of 5000 drawings, an end of the interval moves by 1 % of its width
    drawn = bootstrap(
        (gain,), np.mean, n_resamples=5000, method="percentile", rng=np.random.default_rng(seed)
    ).confidence_interval
    runs = dict(zip(names, (before, after), strict=True))
    return Verification(runs, float(gain.mean()), (float(drawn.low), float(drawn.high)))


def error_row(name: str, error: np.ndarray) -> dict[str, Any]:
    """Return a table row, in mm, from the errors tip - target (N, 3), m.

    ``mean_x_mm`` and its like are signed means.
    """
    figures = Errors.of(error)
    told = ("mean_mm", "rms_mm", "p95_mm", "max_mm", "mean_abs_z_mm")
    means = zip("xyz", error.mean(axis=0), strict=True)
    return {
        "run": name,
        "n": figures.n,
        **{key: figures.mm[key] for key in told},
        **{f"mean_{axis}_mm": 1e3 * float(mean) for axis, mean in means},
    }
