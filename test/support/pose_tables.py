"""Tables of poses under the names that an instrument gives their columns."""

import numpy as np


def split(names: str) -> list[str]:
    return names.split("|") if "|" in names else names.split()


def line(names: str, values: np.ndarray) -> str:
    joints = ["q1_deg", "q2_deg", "q3_m", "q4_deg"]
    head = ",".join([*joints, *split(names)])
    return head + "".join(
        "\n1,20,0.05,3," + ",".join(repr(float(v)) for v in row) for row in values
    )


POSE = np.array([[0.1, 0.2, 0.3, 0.1, -0.5, 0.7, 0.5], [0.2, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8]])
