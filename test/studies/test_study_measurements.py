"""The study of measurements: what it counts, and that more rows of anything help."""

import numpy as np
from small_arm import ARM

from studies import measurements


def test_every_kind_calibrates_and_a_distance_says_least() -> None:
    counts = (20, 80)
    found = [measurements.errors_by_rows(ARM, seed, counts) for seed in range(2)]
    rows = measurements.table(found, counts)
    for kind in measurements.KINDS:
        few, many = (row[f"{kind}_mm"] for row in rows)
        assert many < few
        assert many < 0.4
    assert rows[0]["distance_mm"] > rows[0]["position_mm"]
    assert rows[0]["touch_mm"] > rows[0]["pose_mm"]


def test_rows_needed_are_counted_between_the_counts() -> None:
    left = {kind: np.array([4e-3, 1e-3, 0.25e-3]) for kind in measurements.KINDS}
    rows = measurements.rows_needed([left], (10, 40, 160), (5e-3, 2e-3, 0.5e-3, 0.1e-3))
    assert [row["pose"] for row in rows] == [10, 20, 80, None]
