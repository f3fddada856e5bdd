"""Left and right images become pairs by their stamps, whatever the order of arrival."""

from longarm_comp.devices.stereo.pairing import Drop, Side, StereoPairer

MS = 1_000_000


def feed(pairer: StereoPairer[str], *arrivals: tuple[Side, int]) -> list[tuple[str, str]]:
    found = []
    for side, milliseconds in arrivals:
        name = f"{side.name[0]}{milliseconds}"
        found += [(p.left, p.right) for p in pairer.add(side, milliseconds * MS, name)]
    return found


L, R = Side.LEFT, Side.RIGHT


def test_pairs_in_any_order_of_arrival_within_the_slop() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=5 * MS)
    assert feed(pairer, (L, 0), (R, 3), (R, 35), (L, 33), (L, 66), (L, 100), (R, 65)) == [
        ("L0", "R3"),
        ("L33", "R35"),
        ("L66", "R65"),
    ]
    assert pairer.pairs == 3 and not pairer.drops


def test_images_without_a_partner_are_dropped_and_counted() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=5 * MS, queue=3)
    assert feed(pairer, (L, 0), (L, 33), (R, 34), (R, 50), (L, 66), (R, 66)) == [
        ("L33", "R34"),
        ("L66", "R66"),
    ]
    assert pairer.drops == {Drop.UNSYNCHRONISED: 2}
    feed(pairer, *[(L, 100 + 33 * i) for i in range(5)])  # the right camera died
    assert pairer.drops[Drop.OVERFLOW] == 2


def test_the_nearer_partner_wins() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=20 * MS)
    assert feed(pairer, (L, 0), (L, 12), (R, 14)) == [("L12", "R14")]


def test_late_images_and_a_clock_that_jumps_back() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=5 * MS)
    assert feed(pairer, (L, 5000), (R, 5001), (L, 4990), (L, 5000)) == [("L5000", "R5001")]
    assert pairer.drops == {Drop.OUT_OF_ORDER: 2}
    assert feed(pairer, (L, 5033), (L, 10), (R, 11), (L, 43), (R, 43)) == [
        ("L10", "R11"),
        ("L43", "R43"),
    ]
    assert pairer.drops[Drop.RESTARTED] == 1
