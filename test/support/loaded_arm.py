"""The small arm with a boom that bends and a payload, as data to be changed."""

from typing import Any

from small_arm import ARM


def arm_data() -> dict[str, Any]:
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    tube = {"type": "tube", "od_m": 0.05, "id_m": 0.04}
    data["links"] = [
        {"name": "boom", "row": 3, "role": "d", "length_m": "rest", "E_pa": 70e9, "poisson": 0.3,
         "section": tube, "mass_kg": 0.5, "body_length_m": 0.4}
    ]  # fmt: skip
    data["payload"] = {"frame": 4, "mass_kg": 0.1}
    return data
