"""Each circumstance has one range, from arm.yaml: what lies beyond it is refused everywhere."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from small_arm import ARM, measured

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import allowed_range, check_circumstance
from longarm_comp.core.arm.parts import Payload, PointMass
from longarm_comp.core.data.admission import admit
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sessions.poses import read_poses

CARRIES = ARM.model_copy(update={"payload": Payload(mass_kg=0.25, frame=4)})


def test_a_payload_is_bounded_by_what_arm_yaml_declares() -> None:
    assert allowed_range(CARRIES, "payload_kg") == (0.0, 2.5)
    heavy = CARRIES.model_copy(update={"point_masses": (PointMass(name="m", frame=1, mass_kg=8),)})
    assert allowed_range(heavy, "payload_kg") == (0.0, 8.0)
    crane = CARRIES.model_copy(update={"payload": Payload(mass_kg=0.25, most_kg=90.0, frame=4)})
    assert allowed_range(crane, "payload_kg") == (0.0, 90.0)
    assert allowed_range(ARM, "payload_kg") == (0.0, 0.0)  # it does not say where one would hang
    check_circumstance(ARM, "payload_kg", [0.0, math.nan], "s")
    with pytest.raises(InputError, match=r"payload_kg: 8.*declares no payload; say in arm\.yaml"):
        check_circumstance(ARM, "payload_kg", [0.0, 8.0], "s")
    assert allowed_range(CARRIES, "probe") == (-math.inf, math.inf)
    for other in (CARRIES, crane):  # models hold for any payload
        assert other.hash == CARRIES.hash
    with pytest.raises(InputError, match=r"payload\.most_kg: 0\.1; allowed: at least mass_kg"):
        Arm.parse({**_data(), "payload": {"mass_kg": 0.25, "most_kg": 0.1, "frame": 4}}, "arm")


def _data() -> dict[str, object]:
    return ARM.model_dump(exclude_defaults=True)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("payload_kg", -5.0, "0 to 2.5 of arm small; more: payload.most_kg"),
        ("payload_kg", 10.0, "0 to 2.5"),
        ("payload_kg", 1e30, "0 to 2.5"),
        ("payload_kg", math.inf, "0 to 2.5"),
        ("temperature_c", 293.15, "-80 to 120, 100 K about reference_temperature_c"),
        ("temperature_c", -90.0, "-80 to 120"),
        ("incl_0_x", 8.0, "-6.28319 to 6.28319"),
        ("probe", math.inf, "-inf to inf"),
    ],
)
def test_what_an_arm_cannot_be_in_is_refused(name: str, value: float, words: str) -> None:
    with pytest.raises(InputError, match=f"^payload topic: {name}: ") as caught:
        check_circumstance(CARRIES, name, value, "payload topic")
    assert words in str(caught.value)
    with pytest.raises(InputError, match=f"row 2, {name}: "):
        check_circumstance(CARRIES, name, [0.1, value, math.nan], "s")
    check_circumstance(CARRIES, name, [0.1, math.nan], "s")


def test_temperature_and_payload_swapped(rng: np.random.Generator) -> None:
    good = {"temperature_c": np.linspace(0.2, 20, 40), "payload_kg": np.full(40, 0.25)}
    session = measured(40, rng, columns=good)
    admit(session, CARRIES)
    swapped = dict(zip(good, [*good.values()][::-1], strict=True))
    with pytest.raises(InputError, match=r"row 6, payload_kg: 2\.7.*allowed: 0 to 2\.5"):
        admit(dataclasses.replace(session, columns=swapped), CARRIES)


def test_files_say_it_in_one_line(shell: Shell, tmp_path: Path, rng: np.random.Generator) -> None:
    import yaml

    data = CARRIES.model_dump(mode="json", exclude_defaults=True)
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(data))
    write_csv(measured(40, rng, columns={"payload_kg": np.full(40, 20.0)}), tmp_path / "s.csv")
    said = shell.refused("calibrate", "arm.yaml", "s.csv", "-o", "m.yaml")
    assert "s.csv: row 1, payload_kg: 20.0; allowed: 0 to 2.5" in said
    (tmp_path / "t.csv").write_text("x,y,z,payload_kg\n0.4,0,0.4,3\n")
    said = shell.refused("compensate", "arm.yaml", "--targets", "t.csv", "-o", "c.csv")
    assert "t.csv: payload_kg: 3.0; allowed: 0 to 2.5" in said
    (tmp_path / "p.csv").write_text("q1,q2,q3,q4,payload_kg\n0,0.5,0.05,0,3\n")
    with pytest.raises(InputError, match=r"p\.csv: payload_kg: 3\.0; allowed: 0 to 2\.5"):
        read_poses(tmp_path / "p.csv", CARRIES)
