"""Draw the pictures of README and pages: `make pictures`.

python docs/made_by/pictures.py build/demo     all; the folder is one that `longarm demo` wrote
python docs/made_by/pictures.py                those that need no demonstration
"""

import sys
from collections.abc import Callable
from pathlib import Path

import concepts
import own_arm
import touch
from drawing import save_svg
from matplotlib.figure import Figure

PICTURES = Path(__file__).resolve().parents[1] / "pictures"

COMPUTED: dict[Callable[[Figure], None], tuple[float, float]] = {
    concepts.deflection: (7.6, 3.9),
    concepts.play: (7.6, 3.6),
    concepts.not_told_apart: (7.6, 3.9),
    concepts.hold_out: (7.6, 3.9),
    concepts.pseudo_target: (7.6, 3.4),
    concepts.commanded_and_seen: (7.6, 3.0),
    concepts.how_many_poses: (7.6, 3.4),
    own_arm.mdh_row: (7.6, 3.2),
    own_arm.mdh_frames: (7.6, 4.7),
    own_arm.beams: (7.6, 3.0),
    own_arm.marker_and_cameras: (7.6, 4.4),
    touch.touch_parts: tuple(side / touch.INCH_MM for side in touch.SHEET_MM),
    touch.touch_postures: (7.6, 4.4),
}
"""Pictures that need nothing but the package, and their size in inches."""

OF_A_DEMONSTRATION = (
    "bent_and_straight.svg",
    "ladder.svg",
    "first_screen.png",
    "demonstration.webp",
    "view.png",
)


def draw_computed(to: Path) -> None:
    """Those that need no demonstration; an SVG is named as its function."""
    for picture, size in COMPUTED.items():
        save_svg(picture, to / f"{picture.__name__}.svg", size)


def draw_demonstration(folder: Path, to: Path) -> None:
    """Those of one demonstration, from the folder that it wrote."""
    from animation import write_animation
    from demonstration import Demonstration, bent_and_straight, ladder
    from live_page import write_live_page
    from screen import write_first_screen

    demo = Demonstration(folder)
    save_svg(bent_and_straight(demo), to / "bent_and_straight.svg", (9.6, 4.2))
    save_svg(ladder(demo), to / "ladder.svg", (7.6, 3.2))
    write_first_screen(folder / "report.html", to / "first_screen.png")
    write_animation(demo, to / "demonstration.webp")
    write_live_page(to / "view.png")


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    draw_computed(PICTURES)
    for given in sys.argv[1:2]:
        draw_demonstration(Path(given), PICTURES)
