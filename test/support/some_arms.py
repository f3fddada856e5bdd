"""Arms that are not the demonstration's, as `longarm init` is asked to make them."""

PRINTED = "tube_a=20/17 material=petg"
CARBON = "material=carbon servo_kg=0.3"


def flags(*rows: str, tip: tuple[float, float, float], payload: float) -> list[str]:
    words = [word for row in rows for word in ("--joint", row)]
    return [*words, "--tip-at", *map(str, tip), "--payload", str(payload)]


HOBBY = flags(
    "d=0.09 limits=-60..60 servo_kg=0.06",
    "alpha=90 theta=60 limits=-30..30 servo_kg=0.06",
    f"a=0.16 theta=-70 limits=-40..40 {PRINTED} servo_kg=0.06",
    f"a=0.12 theta=-20 limits=-40..40 {PRINTED} servo_kg=0.05",
    "alpha=-90 d=0.05 limits=-40..40 servo_kg=0.05",
    "alpha=90 limits=-40..40 servo_kg=0.02",
    tip=(0.06, 0.0, 0.03),
    payload=0.03,
)
NINE = flags(
    "d=0.3 limits=-30..30",
    "alpha=90 theta=45 limits=-25..25",
    f"a=0.4 theta=-30 limits=-25..25 tube_a=50/46 {CARBON}",
    f"alpha=-90 a=0.3 limits=-25..25 tube_a=45/41 {CARBON}",
    f"alpha=90 a=0.3 limits=-25..25 tube_a=40/36 {CARBON}",
    f"alpha=-90 a=0.25 limits=-25..25 tube_a=40/36 {CARBON}",
    f"alpha=90 a=0.2 limits=-25..25 tube_a=35/31 {CARBON}",
    "type=prismatic alpha=90 d=0.2 limits=0..0.15 tube_d=30/26 servo_kg=0.1",
    "limits=-45..45 servo_kg=0.1",
    tip=(0.02, 0.0, 0.1),
    payload=0.3,
)
COLUMN = flags(
    "type=prismatic name=lift d=0.5 limits=0..0.4 tube_d=80/72",
    "type=prismatic name=stage mimic=lift d=0.4",
    "name=swing limits=-60..60",
    "name=elbow a=0.5 limits=-60..60 tube_a=50/44 servo_kg=1.2",
    "name=wrist a=0.4 alpha=90 limits=-40..40 tube_a=40/36 servo_kg=0.6",
    tip=(0.3, 0.02, 0.03),
    payload=1.0,
)
"""A column with two stages: the second follows the first."""
