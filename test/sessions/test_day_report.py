"""`longarm day-report`: a bag of work becomes a page."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bag_robot import asked, command, header, robot, sighting, state
from cli_shell import Shell
from small_arm import ARM

from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.sessions.day import Day, read_day
from longarm_comp.sessions.message_types import message_types

MISS = 0.5e-3


def said(
    put: Any, t: float, part: str, level: int, message: str, node: str = "/kinematics"
) -> None:
    """A line of /diagnostics."""
    types = message_types().types
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=level, name=f"{node}: {part}", message=message, hardware_id="", values=[]
    )
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    put("diagnostics", kind, t, header=header(t), status=[status])


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Four targets in two hours: one is refused, one is not seen."""
    model, rng = declared_model(ARM), np.random.default_rng(0)
    with robot(tmp_path / "today") as put:
        for k, t in enumerate((10.0, 1000.0, 4000.0, 5000.0)):
            q = ARM.lower + rng.random(ARM.n) * (ARM.upper - ARM.lower)
            target = model.tip(q)
            asked(put, t, q, target, "correction of 61 mm is too large" if k == 1 else "")
            if k == 1:
                continue
            command(put, t + 0.1, q.tolist())
            state(put, t + 3.0, q.tolist())
            state(put, t + 5.0, q.tolist())
            if k < 3:
                for s in (3.5, 4.0, 4.5):
                    tip = target + (k + 1) * MISS * np.eye(3)[2]
                    sighting(put, t + s, tip.tolist(), topic="tip_seen")
                    sighting(put, t + s, [9.0, 9.0, 9.0], frame="tracker")
            said(put, t + 6.0, LEARNED_SAID, 0, f"learning: friction ({90 + k} %)")
        said(put, 6000.0, "driver", 1, "joint 2 is 61 degC")
        said(put, 6100.0, "driver", 1, "joint 2 is 62 degC")
        said(put, 6200.0, "ready", 0, "ready")
        other = "/another/kinematics"
        said(put, 6300.0, LEARNED_SAID, 0, "learning: an arm that is not this one", other)
        said(put, 6400.0, "driver", 2, "its fault", other)
    return tmp_path / "today"


def test_a_day_is_read_from_its_bag(bag: Path) -> None:
    day = read_day(bag, ARM, None, (LEARNED_SAID,))
    assert day.error_mm == pytest.approx([0.5, 1.5, np.nan], nan_ok=True)
    first, second, whole = day.by_hour()
    assert (first["hours"], first["targets"], first["mean_mm"]) == ("0-1 h", 1, pytest.approx(0.5))
    assert (second["targets"], second["seen"]) == (2, 1)
    assert whole["mean_mm"] == pytest.approx(1.0) and whole["max_mm"] == pytest.approx(1.5)
    assert day.refused == {"correction of 61 mm is too large": 1}
    learned, hot = day.said
    assert learned.message == "learning: friction (93 %)"
    assert (learned.first_s, learned.last_s) == pytest.approx((6.0, 4996.0), abs=11.0)
    assert hot.message == "joint 2 is 62 degC" and hot.last_s - hot.first_s == pytest.approx(100.0)


def test_its_page_says_what_was_read(bag: Path, shell: Shell) -> None:
    Path("arm.yaml").write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    told = shell.json("day-report", "arm.yaml", bag)
    assert told["rows"][-1]["mean_mm"] == pytest.approx(1.0)
    page = Path("day.html").read_text()
    for words in ("3 targets in", "1.00 mm away", "friction (93 %)", "62 degC", "1 target refused"):
        assert words in page
    assert shell("day-report", "arm.yaml", bag) == 0, "its own page may be written again"
    Path("day.html").write_text("mine")
    assert "day.html" in shell.refused("day-report", "arm.yaml", bag)


def test_a_bag_without_targets_is_refused(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 1.0, ARM.mid.tolist())
        state(put, 3.0, ARM.mid.tolist())
        sighting(put, 4.0, [0.0, 0.0, 0.5], topic="tip_seen")
    with pytest.raises(InputError, match="compensation"):
        read_day(tmp_path / "bag", ARM, None, ())


def test_a_day_may_have_refused_targets_alone(tmp_path: Path, shell: Shell) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 1.0, ARM.mid.tolist())
        state(put, 3.0, ARM.mid.tolist())
        state(put, 5.0, ARM.mid.tolist())
        sighting(put, 4.0, [0.0, 0.0, 0.5], topic="tip_seen")
        asked(put, 6.0, ARM.mid, np.zeros(3), "out of reach")
    Path("arm.yaml").write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    told = shell.json("day-report", "arm.yaml", tmp_path / "bag")
    assert [(row["targets"], row["seen"]) for row in told["rows"]] == [(0, 0)]
    assert "1 target refused: out of reach" in Path("day.html").read_text()


def served(path: Path, tips: str, frame: str = "base", base: str = "base") -> Path:
    """A bag of one target that came in the frame of a tracker, with a learned error."""
    target = np.array([0.3, 0.1, 0.2])
    with robot(path, "/arm") as put:

        def put_story(topic: str, kind: str, t: float, **story: Any) -> None:
            far = story["target"].pose.position
            far.x, far.y, far.z = 7.0, 8.0, 9.0
            story["pseudo_target"].pose.position.x -= 0.02
            story["predicted_error"].x = 0.02
            story["header"].frame_id = base
            put(topic, kind, t, **story)

        asked(put_story, 10.0, ARM.mid, target)
        command(put, 10.1, ARM.mid.tolist())
        for t in (13.0, 15.0):
            state(put, t, ARM.mid.tolist())
        for t in (13.5, 14.0, 14.5):
            sighting(put, t, (target + MISS * np.eye(3)[2]).tolist(), frame=frame, topic=tips)
    return path


def test_tips_and_targets_are_compared_in_the_base(tmp_path: Path) -> None:
    bag = served(tmp_path / "known", "tip_seen", "arm_base", "arm_base")
    assert read_day(bag, ARM, None, ()).error_mm == pytest.approx([0.5])
    with pytest.raises(InputError, match=r"tip_seen frame_id: 'tracker'.*base: a model that knows"):
        read_day(served(tmp_path / "unknown", "tip_seen", "tracker"), ARM, None, ())
    with pytest.raises(InputError, match="tip_seen: 'no message'"):
        read_day(served(tmp_path / "raw", "tip_measured"), ARM, None, ())


def test_only_what_differs_in_its_figures_is_one_notice(tmp_path: Path) -> None:
    texts = ["joint1: stalled", "joint4: stalled", "Servo 3 is hot", "Servo 4 is hot"]
    texts += ["Joint 3, driver 1", "Joint 3, driver 2", "joint 12 lost", "joint 13 lost"]
    with robot(tmp_path / "faults") as put:
        for t, text in enumerate(texts, 1):
            said(put, t, "driver", 2, text)
        for t, text in enumerate(("-1.5e-3 m at 3:20", "12 m at 14:05"), 20):
            said(put, t, "driver", 2, text)
        asked(put, 40.0, ARM.mid, np.zeros(3))
        command(put, 40.1, ARM.mid.tolist())
        for t in (43.0, 45.0):
            state(put, t, ARM.mid.tolist())
        sighting(put, 44.0, [0.0, 0.0, 0.5], topic="tip_seen")
    notices = read_day(tmp_path / "faults", ARM, None, ()).said
    assert [notice.message for notice in notices] == [*texts, "12 m at 14:05"]


def test_a_day_on_which_nothing_was_seen_has_a_row() -> None:
    assert Day(1.0, np.zeros(0), np.zeros(0)).by_hour() == [
        {"hours": "all", "targets": 0, "seen": 0, "mean_mm": None, "p95_mm": None, "max_mm": None}
    ]
