"""The arm in 3-D: declared, as it hangs, target and tip, errors as arrows."""

from typing import Any

import numpy as np
import viser

from longarm_comp.core.model.link_frames import exaggerate_sag
from longarm_comp.view.words import PageState, Picture

GREY, PALE = (150, 150, 150), (205, 205, 205)
BLUE, GREEN, RED, ORANGE, YELLOW = (
    *((30, 100, 220), (20, 150, 60), (200, 30, 40), (225, 120, 0), (210, 170, 0)),
)
_FAR = np.array([0.2, -0.9, 0.3])
"""Where the camera stands at the start, seen from the middle of the arm."""


class Scene:
    """The drawn objects. They are made when the first picture of the arm comes, in its size."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._handles: dict[str, Any] = {}
        self._middle = self._away = np.zeros(3)
        self._beside: dict[str, np.ndarray] = {}
        server.on_client_connect(self._aim_camera)

    def show(self, state: PageState, now: float, factor: tuple[float, float]) -> None:
        """Draw a state, pale if it is out of date, with deflection and errors ``factor`` larger."""
        (times, longer), picture = factor, state.picture
        if picture is None:
            return
        with self._server.atomic():
            if not self._handles:
                self._begin_scene(picture)
            pale = state.is_old(now)
            hanging = exaggerate_sag(picture.hanging, picture.declared, times)
            self._draw_line("declared", picture.declared, PALE if pale else GREY)
            self._draw_line("hanging", hanging, PALE if pale else BLUE)
            end = hanging[-1]
            self._show_label("hanging", None if pale else end, f"deflection × {times:g}")
            tip = None if pale else state.seen_tip(now)
            for name, at in (
                ("target", picture.target),
                ("tip", tip),
                ("pseudo_target", picture.pseudo_target),
            ):
                self._handles[name].visible = at is not None and not pale
                if at is not None:
                    self._handles[name].position = at
            missed = "the picture is old" if pale else state.miss_at_target(now)
            beside = "the picture is old" if pale else state.miss_of_prediction(now)
            tip_at = self._draw_arrow("missed", picture.target, missed, longer)
            self._draw_arrow("beside", end, beside, longer)
            self._show_label("missed", tip_at, f"tip − target × {longer:g}")

    def _begin_scene(self, picture: Picture) -> None:
        scene, size = self._server.scene, float(np.ptp(picture.declared, axis=0).max())
        middle = 0.5 * (picture.declared.min(axis=0) + picture.declared.max(axis=0))
        scene.world_axes.visible = False
        scene.add_frame("/base", axes_length=0.08 * size, axes_radius=0.004 * size)
        scene.add_grid("/grid", width=2 * size, height=2 * size, cell_size=0.1, section_size=1.0)
        for name, radius, colour in (
            ("target", 0.012, GREEN),
            ("tip", 0.008, RED),
            ("pseudo_target", 0.006, YELLOW),
        ):
            self._handles[name] = scene.add_icosphere(
                f"/{name}", radius=radius * size, color=colour, visible=False
            )
        start = np.stack([picture.declared[:-1], picture.declared[1:]], axis=1)
        for name, width in (("declared", 3.0), ("hanging", 6.0)):
            self._handles[name] = scene.add_line_segments(
                f"/{name}", start, GREY, thickness=width, thickness_units="screen"
            )
        for name, colour in (("missed", RED), ("beside", ORANGE)):
            self._handles[name] = scene.add_arrows(
                f"/{name}",
                start[:1],
                colour,
                shaft_radius=0.003 * size,
                head_radius=0.008 * size,
                head_length=0.02 * size,
                visible=False,
            )
        for name, side in (("hanging", -1), ("missed", 1)):
            self._beside[name] = np.array([0.0, 0.0, 0.04 * size * side])
            self._handles[f"{name} label"] = scene.add_label(
                f"/{name}_label", "", anchor="center-right", font_screen_scale=0.9, visible=False
            )
        self._middle, self._away = middle, 0.9 * size * _FAR
        camera = self._server.initial_camera
        camera.look_at, camera.position = middle, middle + self._away
        for client in self._server.get_clients().values():
            self._aim_camera(client)

    def _aim_camera(self, client: viser.ClientHandle) -> None:
        """Point the camera of a browser at the arm, from further away where it is narrow."""
        if self._handles:
            away = self._away * max(1.0, 1.0 / client.camera.aspect)
            client.camera.position, client.camera.look_at = self._middle + away, self._middle

    def _draw_line(self, name: str, points: np.ndarray, colour: tuple[int, int, int]) -> None:
        handle = self._handles[name]
        handle.points = np.stack([points[:-1], points[1:]], axis=1)
        handle.colors = np.array(colour, np.uint8)

    def _draw_arrow(
        self, name: str, start: np.ndarray | None, error: np.ndarray | str, factor: float
    ) -> np.ndarray | None:
        """Draw an error (3,), m, from `start`; return the end of its arrow (3,), None if none."""
        handle = self._handles[name]
        handle.visible = start is not None and not isinstance(error, str)
        if start is None or isinstance(error, str):
            return None
        end = exaggerate_sag(start + error, start, factor)
        handle.points = np.stack([start, end])[None]
        return end

    def _show_label(self, name: str, at: np.ndarray | None, text: str) -> None:
        handle = self._handles[f"{name} label"]
        handle.visible = at is not None
        if at is not None:
            handle.text, handle.position = text, at + self._beside[name]
