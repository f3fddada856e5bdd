"""`longarm stereo calibrate` on rendered pictures, judged by the tip that its files measure."""

from __future__ import annotations

import dataclasses
import errno
import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from cli_shell import Shell
from stereo_head import HEAD, marker_pose, rigid_rms

from longarm_comp.arm_folder.check import check_record
from longarm_comp.arm_folder.marker_sheet import lay_out_sheet
from longarm_comp.arm_folder.measured import camera_path, read_measured, write_cameras
from longarm_comp.core.errors import JobError
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.camera_file import read_camera
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.mounting import check_mounting
from longarm_comp.devices.stereo.refusal import StereoRefusal
from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard
from longarm_comp.devices.stereo.views import BoardView, find_view, list_gaps
from longarm_comp.sim.cameras import Conditions, charuco_plate, render, tag_plate

if TYPE_CHECKING:
    from longarm_comp.jobs.graph_client import GraphClient

TRUE = dataclasses.replace(
    HEAD, baseline_m=0.2, focal_px=640.0, size=(512, 384), d=(-0.15, 0.05, 0.0, 0.0, 0.0),
    right_turn_rad=(0.0, -0.03, 0.01),
)  # fmt: skip
BOARD = CharucoTarget(0.05, 0.036, 7, 5, "DICT_5X5_100")
SIDES = ("left", "right")
FLAGS = ("--board", "7x5", "--square-mm", 50, "--tag-mm", 36)
PLACES = [(-1, -1, 1.02), (0, -1, 0.9), (1, -1, 1.15), (-1, 0, 1.25), (0, 0, 0.85), (1, 0, 1.02),
          (-1, 1, 1.15), (0, 1, 1.2), (1, 1, 1.02), (0, 0, 1.3), (-0.5, 0.5, 1.02)]  # fmt: skip


def board_pose(across: float, down: float, depth: float, number: int) -> np.ndarray:
    """The board at a place of what both cameras see, tilted as its number says."""
    tilt = np.array([0.45 * (number % 3 - 1), 0.45 * (number // 3 % 3 - 1), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = (
        cv2.Rodrigues(tilt * [1, 0, 0])[0] @ cv2.Rodrigues(tilt * [0, 1, 0])[0]
        @ np.diag([1.0, -1.0, -1.0])
    )  # fmt: skip
    pose[:3, 3] = [0.1 + 0.17 * across * depth, 0.14 * down * depth, depth]
    return TRUE.left_in_base @ pose


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    plate = charuco_plate(0.05, 0.036, 7, 5, "DICT_5X5_100")
    rng = np.random.default_rng(7)
    for k, place in enumerate(PLACES):
        images = render(board_pose(*place, k), plate, TRUE, rng, Conditions(blur_px=0.5))
        for side, image in zip(("left", "right"), images, strict=True):
            (folder / side).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / side / f"{k:02d}.png"), image)
    return folder


def some(pictures: Path, to: Path, numbers: list[int]) -> Path:
    """A folder with some of the pairs."""
    to.mkdir()
    for k in numbers:
        for side in ("left", "right"):
            (to / f"{side}{k}.png").write_bytes((pictures / side / f"{k:02d}.png").read_bytes())
    return to


def test_the_written_files_measure_the_tip_where_it_is(
    shell: Shell, pictures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (shell.folder / "mine" / "cameras").mkdir(parents=True)
    for side in ("left", "right"):
        camera_path(Path("mine"), side).write_bytes(f"the maker's {side}".encode())
    blurred = some(pictures, shell.folder / "all", list(range(len(PLACES))))
    picture = cv2.imread(str(blurred / "left4.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(blurred / "left99.png"), cv2.GaussianBlur(picture, (0, 0), 6.0))
    cv2.imwrite(str(blurred / "right99.png"), picture)
    found = shell.json("stereo", "calibrate", "mine", "--images", blurred, *FLAGS)
    assert "left99.png, right99.png are left out: image is blurred" in shell.err
    assert found["reprojection_rms_px"] < 0.08
    assert found["held_out_rms_mm"] < 0.2 and found["held_out_views"] >= 2
    assert found["baseline_mm"] == pytest.approx(200.0, abs=0.3)
    infos = [read_camera(camera_path(Path("mine"), side)) for side in ("left", "right")]
    rig = StereoRig.from_camera_info(infos[0], infos[1], rectified=False)
    raw_from_rectified = np.array(infos[0].r).reshape(3, 3).T
    tag, plate = TagBoard(0.1), tag_plate(0.1)
    rng = np.random.default_rng(3)
    seen, true = [], []
    for _ in range(6):  # another target, at places that are not the board's
        truth = marker_pose(TRUE, rng.uniform(0.85, 1.3), rng)
        sighting = StereoEye(rig, tag).measure(*render(truth, plate, TRUE, rng))
        seen.append(raw_from_rectified @ sighting.point)
        true.append((np.linalg.inv(TRUE.left_in_base) @ truth)[:3, 3])
    assert np.linalg.norm(np.subtract(seen, true), axis=1).max() < 1.5e-3
    # Where the head stands is found by hand-eye: what is left is what the tip is measured to.
    assert rigid_rms(np.array(seen), np.array(true)) < 0.2e-3
    assert [f.level for f in check_record(Path("mine"))] == ["measured"]
    measured = read_measured(Path("mine"))["cameras"]
    assert measured.facts["views"] == found["views_used"]
    kept = [camera_path(Path("mine"), f"{side}.previous").read_text() for side in ("left", "right")]
    assert kept == ["the maker's left", "the maker's right"]
    assert "*.previous.yaml" in shell.err

    def full(path: Path, *text: Any, **how: Any) -> int:
        if "right" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *text, **how)

    write = Path.write_text
    monkeypatch.setattr(Path, "write_text", full)
    fit = SimpleNamespace(rig=rig, used=(1, 2), rms_px=0.1)
    other = SimpleNamespace(fit=fit, held_out_mm=0.1, distances_m=(0.5, 1.0))
    with pytest.raises(JobError, match="No space"):
        write_cameras(Path("mine"), other)  # type: ignore[arg-type]
    assert [read_camera(camera_path(Path("mine"), side)) for side in ("left", "right")] == infos
    assert read_measured(Path("mine"))["cameras"] == measured


def test_views_that_do_not_cover_are_refused_in_words(shell: Shell, pictures: Path) -> None:
    (shell.folder / "mine").mkdir()
    above = some(pictures, shell.folder / "above", [0, 1, 2])
    words = ("stereo", "calibrate", "mine", *FLAGS, "--images")
    said = shell.refused(*words, above, code=3)
    assert "more views: 3 of 10" in said and not (shell.folder / "mine" / "cameras").exists()
    assert "more views: 0" in shell.refused(*words, above, "--dictionary", "DICT_4X4_50", code=3)
    (above / "right1.png").unlink()
    assert "right1.png" in shell.refused(*words, above)
    (above / "left1.png").rename(above / "right1.png")
    assert "no left image" in shell.refused(*words, above)
    assert "no folder" in shell.refused(*words, "nowhere")
    assert "--board" in shell.refused(*words, above, "--board", "7")
    assert "one of the two" in shell.refused("stereo", "calibrate", "mine")


def test_view_of_one_row_of_corners_is_refused() -> None:
    """Its distance and tilt were no numbers, and missing tilt was not told any more."""
    tall, plate = CharucoTarget(0.03, 0.022, 5, 12), charuco_plate(0.03, 0.022, 5, 12)
    covered = Conditions(covered=(0.6, 0.6))
    images = render(marker_pose(HEAD, 1.0), plate, HEAD, np.random.default_rng(1), covered)
    assert len(tall.detect(images[0])) == len(tall.detect(images[1])) == 11
    with pytest.raises(StereoRefusal, match="too few corners are seen") as caught:
        find_view(tall, *images)
    assert caught.value.facts == {"corners": 11, "at_least": "8, not on one line"}


def test_each_gap_is_named(pictures: Path) -> None:
    images = [
        [cv2.imread(str(pictures / side / f"{k:02d}.png"), 0) for side in ("left", "right")]
        for k in range(len(PLACES))
    ]
    views = [find_view(BOARD, *pair) for pair in images]
    assert list_gaps(views, TRUE.size) == []
    top = [v for v, place in zip(views, PLACES, strict=True) if place[1] < 0]
    said = " ".join(list_gaps(top * 4, TRUE.size))
    assert "left camera: no corner at the bottom left" in said and "right camera" in said
    near = [dataclasses.replace(view, distance_m=1.0) for view in views]
    assert [text.split(":")[0] for text in list_gaps(near, TRUE.size)] == ["nearer and farther"]
    for axis, name in enumerate(("horizontal", "vertical")):
        flat = [
            dataclasses.replace(
                v, tilt_deg=tuple(np.where([axis == 0, axis == 1], 3.0, v.tilt_deg))
            )
            for v in views
        ]
        assert [text.split(":")[0] for text in list_gaps(flat, TRUE.size)] == [
            f"tilt about the {name} axis"
        ]
    # The tilt and distance themselves, against where the board was (the focal length is guessed).
    for k, (view, place) in enumerate(zip(views, PLACES, strict=True)):
        assert view.distance_m == pytest.approx(place[2], rel=0.1)
        tilt = [-25.8 * (k % 3 - 1), 25.8 * (k // 3 % 3 - 1)]
        assert view.tilt_deg == pytest.approx(tilt, abs=8.0)


def test_a_camera_that_is_turned_is_said(shell: Shell, pictures: Path) -> None:
    """Not as a gap in what the views cover; also before they are enough."""
    (shell.folder / "mine").mkdir()
    words = ("stereo", "calibrate", "mine", *FLAGS, "--images")
    for side, count in (("right", len(PLACES)), ("left", 3)):
        folder = some(pictures, shell.folder / f"{side} turned", list(range(count)))
        for file in folder.glob(f"{side}*"):
            cv2.imwrite(str(file), cv2.rotate(cv2.imread(str(file), 0), cv2.ROTATE_180))
        said = shell.refused(*words, folder, code=3)
        assert "one camera is upside down: the right pictures are turned by 180 deg" in said
        assert "corner" not in said
    few = some(pictures, shell.folder / "few", [0, 1])  # a board may be held oddly
    for file in few.glob("right*"):
        cv2.imwrite(str(file), cv2.rotate(cv2.imread(str(file), 0), cv2.ROTATE_180))
    assert "more views: 2" in shell.refused(*words, few, code=3)


def test_a_camera_on_its_side_is_said(pictures: Path) -> None:
    views = [
        find_view(BOARD, *(cv2.imread(str(pictures / s / f"{k:02d}.png"), 0) for s in SIDES))
        for k in range(4)
    ]
    check_mounting(views)

    def turned(deg: float) -> list[BoardView]:
        c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
        pixels = [view.right.pixels @ np.array([[c, s], [-s, c]]) for view in views]
        rights = [
            dataclasses.replace(v.right, pixels=px) for v, px in zip(views, pixels, strict=True)
        ]
        return [dataclasses.replace(v, right=r) for v, r in zip(views, rights, strict=True)]

    check_mounting(turned(40.0))
    for deg, said in ((60.0, "on its side"), (-90.0, "turned by 90 deg")):
        with pytest.raises(JobError, match=said):
            check_mounting(turned(deg))


@pytest.mark.parametrize(("shift", "said"), [(1, "1 later"), (-1, "1 earlier"), (2, "2 later")])
def test_pairs_that_are_shifted_are_said(
    shift: int, said: str, shell: Shell, pictures: Path
) -> None:
    (shell.folder / "mine").mkdir()
    folder, count = some(pictures, shell.folder / "all", list(range(len(PLACES)))), len(PLACES)
    for k in range(count):
        picture = pictures / "right" / f"{(k - shift) % count:02d}.png"
        (folder / f"right{k}.png").write_bytes(picture.read_bytes())
    for k in range(count):  # in the order of their names
        for side in SIDES:
            (folder / f"{side}{k}.png").rename(folder / f"{side}_{k:02d}.png")
    line = shell.refused("stereo", "calibrate", "mine", *FLAGS, "--images", folder, code=3)
    assert f"the pairs look shifted: a left picture belongs to the right one {said}" in line


def test_pictures_that_no_shift_mends_are_not_called_shifted(pictures: Path) -> None:
    order = [3, 7, 0, 9, 5, 1, 8, 2, 10, 4, 6]
    pairs = [
        [cv2.imread(str(pictures / s / f"{k:02d}.png"), 0) for s, k in zip(SIDES, two, strict=True)]
        for two in zip(range(len(PLACES)), order, strict=True)
    ]
    check_mounting([find_view(BOARD, *pair) for pair in pairs])


def test_the_board_is_printed_in_true_size(shell: Shell) -> None:
    board = CharucoTarget(0.025, 0.018, 7, 5, "DICT_5X5_100")
    paper, page = lay_out_sheet(board)
    scan = io.BytesIO()
    page.savefig(scan, format="png", dpi=150)
    grey = cv2.imdecode(np.frombuffer(scan.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    seen = board.detect(grey)
    assert paper == "A4" and len(seen) == board.n_corners
    drawn = seen.pixels * [1, -1] * 0.0254 / 150
    known = board.points(seen.ids)[:, :2]
    np.testing.assert_allclose(drawn - drawn.mean(axis=0), known - known.mean(axis=0), atol=1e-4)
    assert shell("stereo", "marker", "--board", "3x3", "-o", "board.pdf") == 0
    assert re.match(rb"%PDF", Path("board.pdf").read_bytes())
    assert "one of the two" in shell.refused("stereo", "marker")


# ---- over topics --------------------------------------------------------------------------------


class Board:
    """Shows a picture until it was taken, then the next; blank ones in between."""

    def __init__(self, folder: Path) -> None:
        self._pairs = [
            [cv2.imread(str(folder / side / f"{k:02d}.png"), 0) for side in ("left", "right")]
            for k in range(len(PLACES))
        ]
        self.shown, self._topics = 0, None

    def step(self, client: GraphClient, number: int) -> None:
        from longarm_comp.nodes import interfaces as graph
        from longarm_comp.nodes.images import image_message

        topics = (graph.LEFT_IMAGE, graph.RIGHT_IMAGE)
        self._topics = self._topics or [t.publisher(client.node) for t in topics]
        pair = self._pairs[min(self.shown, len(self._pairs) - 1)]
        for topic, image in zip(self._topics, pair, strict=True):
            topic.publish(image_message(image, number * 10**8, "camera"))

    def told(self, text: str) -> None:
        """Go on to the next picture once as many views as pictures were shown are taken."""
        if text.split()[0].isdigit():
            self.shown = int(text.split()[0])


def test_a_board_shown_to_the_topics_calibrates_the_head(
    shell: Shell, pictures: Path, ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from publishing import publishing

    from longarm_comp.jobs import board_capture

    (shell.folder / "mine").mkdir()
    board, said = Board(pictures), []
    original = board_capture.capture

    def capture(client: Any, target: Any, tell: Callable[[str], None], **more: Any) -> Any:
        def both(text: str) -> None:
            board.told(text)
            tell(text)

        found = original(client, target, both, **more)
        said.append(list_gaps(*found))
        return found

    monkeypatch.setattr(board_capture, "capture", capture)
    with publishing(board.step, 0.05):
        words = ("stereo", "calibrate", "mine", "--live", "--save", "taken", *FLAGS)
        found = shell.json(*words)
    assert said == [[]]
    assert "hold the board still" in shell.err and "only -28 to -28 deg yet" in shell.err
    assert found["baseline_mm"] == pytest.approx(200.0, abs=0.5)
    again = shell.json("stereo", "calibrate", "mine", "--images", "taken", *FLAGS)
    assert again["focal_left_px"] == pytest.approx(found["focal_left_px"])


def test_a_camera_that_is_turned_ends_the_capture(
    shell: Shell, pictures: Path, ros_domain: int
) -> None:
    """It asks for no views that can never be enough."""
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from publishing import publishing

    from longarm_comp.jobs.board_capture import capture
    from longarm_comp.jobs.graph_client import GraphClient

    folder = shell.folder / "turned"
    shutil.copytree(pictures, folder)
    for file in (folder / "right").iterdir():
        cv2.imwrite(str(file), cv2.rotate(cv2.imread(str(file), 0), cv2.ROTATE_180))
    board = Board(folder)
    with (
        publishing(board.step, 0.05),
        GraphClient() as client,
        pytest.raises(JobError, match="upside down"),
    ):
        capture(client, BOARD, board.told)
    assert board.shown == 2


def test_a_view_is_taken_once_and_only_at_rest(pictures: Path) -> None:
    images = [cv2.imread(str(pictures / side / "04.png"), 0) for side in ("left", "right")]
    view = find_view(BOARD, *images)

    def shifted(px: float) -> BoardView:
        left = dataclasses.replace(view.left, pixels=view.left.pixels + np.array([px, 0.0]))
        return dataclasses.replace(view, left=left)

    width = TRUE.size[0]
    for near, far in (
        (shifted(0.08 * width), shifted(0.2 * width)),
        (dataclasses.replace(view, distance_m=1.05 * view.distance_m),
         dataclasses.replace(view, distance_m=1.3 * view.distance_m)),
        (dataclasses.replace(view, tilt_deg=(view.tilt_deg[0] + 5.0, view.tilt_deg[1])),
         dataclasses.replace(view, tilt_deg=(view.tilt_deg[0], view.tilt_deg[1] - 15.0))),
    ):  # fmt: skip
        assert not view.is_new([near], width) and view.is_new([far], width)
        assert not view.is_new([far, near], width)
    assert view.is_new([], width) and not view.is_still(None)
    assert view.is_still(shifted(0.5)) and not view.is_still(shifted(3.0))
