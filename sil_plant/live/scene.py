"""The arm in three dimensions, drawn by viser; its parts are made once and then only moved.

Solid: the arm as its sensors tell. Pale blue: the reference. Green lines: the truth, where a plant tells it. The load
is a steel ball of the estimated mass, its shell two standard deviations larger, the green net the true one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import viser

from sil_plant.plant.geometry import Geometry, ball_radius_m

STEEL, LINK, DARK, ROD = (120, 126, 134), (232, 154, 44), (58, 63, 70), (205, 210, 216)
GHOST, TRUTH, LOAD, SHELL = (70, 130, 220), (20, 150, 70), (196, 54, 54), (240, 150, 150)
_GHOST_OPACITY, _SHELL_OPACITY = 0.28, 0.22
_TURN_TO_X = (math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0)  # a cylinder's axis is z; this lays it along x
_SMALLEST_MOVE = 2e-5  # rad or m: less is not worth a message
_BALL_SEGMENTS = 24


def _about_z(angle_rad: float) -> tuple[float, float, float, float]:
    return math.cos(angle_rad / 2), 0.0, 0.0, math.sin(angle_rad / 2)


def _upwards(angle_rad: float) -> tuple[float, float, float, float]:
    """Turn the x axis towards z."""
    return math.cos(angle_rad / 2), 0.0, -math.sin(angle_rad / 2), 0.0


class Skeleton:
    """Two nodes that turn and what hangs on them: an arm, its ghost or its truth."""

    def __init__(self, server: viser.ViserServer, root: str, shape: Geometry) -> None:
        scene = server.scene
        self.root, self.shape = root, shape
        self._base = scene.add_frame(root, show_axes=False, position=(0.0, 0.0, shape.base_m))
        self._swing = scene.add_frame(f"{root}/swing", show_axes=False)
        self._wrist = scene.add_frame(f"{root}/swing/wrist", show_axes=False, position=(shape.links_m[0], 0.0, 0.0))
        self._told: list[float] = [math.inf, math.inf]
        self._visible = True

    def show(self, angles_rad: tuple[float | None, float | None] | None) -> bool:
        """Turn the joints; None hides them. True when something has moved."""
        visible = angles_rad is not None and None not in angles_rad
        if visible != self._visible:
            self._base.visible = self._visible = visible
        if not visible or all(
            abs(a - b) < _SMALLEST_MOVE
            for a, b in zip(angles_rad, self._told, strict=True)  # type: ignore[operator]
        ):
            return False
        self._told = list(angles_rad)  # type: ignore[arg-type]
        self._swing.wxyz = _about_z(self._told[0])
        self._wrist.wxyz = _upwards(self._told[1])
        return True


class Ball:
    """A ball whose mass changes."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self._radius_m = -1.0

    def show(self, mass_kg: float | None) -> None:
        """Give it the size of a steel ball of this mass; None hides it."""
        radius = 0.0 if mass_kg is None else ball_radius_m(mass_kg)
        if abs(radius - self._radius_m) < _SMALLEST_MOVE:
            return
        if (radius > 0.0) != (self._radius_m > 0.0):
            self._handle.visible = radius > 0.0
        if radius > 0.0:
            self._handle.scale = radius  # of a ball of radius 1: the mesh itself stays
        self._radius_m = radius


class Scene:
    """The arm on its base.

    Parameters
    ----------
    server : viser.ViserServer
        Draws it.
    shape : Geometry
        The arm.
    """

    def __init__(self, server: viser.ViserServer, shape: Geometry) -> None:
        self.shape = shape
        self._server = server
        scene = server.scene
        reach = sum(shape.links_m)
        scene.set_up_direction("+z")
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/light/ambient", intensity=0.9)
        scene.add_grid(
            "/ground", width=2.4 * reach, height=2.4 * reach, cell_size=0.1, section_size=0.5,
            cell_color=(226, 228, 231), section_color=(196, 199, 204),
        )  # fmt: skip
        server.initial_camera.position = (1.62 * reach, -1.18 * reach, 1.12 * reach)
        server.initial_camera.look_at = (0.36 * reach, 0.14 * reach, 0.26 * reach)
        width = shape.width_m
        scene.add_cylinder(
            "/base/column", radius=0.8 * width, height=shape.base_m - 0.5 * width, color=DARK,
            position=(0.0, 0.0, 0.5 * (shape.base_m - 0.5 * width)),
        )  # fmt: skip
        scene.add_cylinder(
            "/base/foot", radius=2.6 * width, height=0.3 * width, color=DARK, position=(0.0, 0.0, 0.15 * width)
        )
        self.arm = Skeleton(server, "/arm", shape)
        self._links("/arm", LINK, None)
        self.reference = Skeleton(server, "/reference", shape)
        self._links("/reference", GHOST, _GHOST_OPACITY)
        self.truth = Skeleton(server, "/truth", shape)
        self._lines("/truth")
        self._cylinders = [self._add_cylinder(n) for n in range(2)]
        tip = "/arm/swing/wrist/tip"
        scene.add_frame(tip, show_axes=False, position=(shape.links_m[1], 0.0, 0.0))
        self.load = Ball(scene.add_icosphere(f"{tip}/load", 1.0, LOAD, subdivisions=4, visible=False))
        self.shell = Ball(
            scene.add_icosphere(
                f"{tip}/shell", 1.0, SHELL, subdivisions=3, opacity=_SHELL_OPACITY, visible=False, cast_shadow=False
            )
        )
        self.true_load = Ball(
            scene.add_line_segments(
                f"{tip}/true", _net(), TRUTH, thickness=1.6, thickness_units="screen", visible=False
            )
        )
        self._label = scene.add_label("/load_label", "", anchor="bottom-right", font_screen_scale=1.2, visible=False)

    def _links(self, root: str, color: tuple[int, int, int], opacity: float | None) -> None:
        scene, width, (first, second) = self._server.scene, self.shape.width_m, self.shape.links_m
        options = {"color": color, "opacity": opacity, "cast_shadow": opacity is None}
        scene.add_box(
            f"{root}/swing/link", dimensions=(first, width, 0.8 * width), position=(0.5 * first, 0.0, 0.0), **options
        )
        scene.add_box(
            f"{root}/swing/wrist/link", dimensions=(second, 0.7 * width, 0.6 * width),
            position=(0.5 * second, 0.0, 0.0), **options,
        )  # fmt: skip
        if opacity is None:
            options["color"] = DARK
        scene.add_cylinder(f"{root}/swing/hub", radius=0.75 * width, height=1.1 * width, **options)
        across = (math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0)
        scene.add_cylinder(f"{root}/swing/wrist/hub", radius=0.55 * width, height=1.15 * width, wxyz=across, **options)

    def _lines(self, root: str) -> None:
        first, second = self.shape.links_m
        for node, length in ((f"{root}/swing/line", first), (f"{root}/swing/wrist/line", second)):
            points = np.array([[[0.0, 0.0, 0.0], [length, 0.0, 0.0]]])
            # beside the link, where it can be seen
            points[:, :, 1] = -0.62 * self.shape.width_m
            self._server.scene.add_line_segments(node, points, TRUTH, thickness=3.0, thickness_units="screen")

    def _add_cylinder(self, joint: int) -> tuple[Any, Any]:
        """Barrel and rod, and what holds them; a frame each, turned by `show`."""
        scene, width, part = self._server.scene, self.shape.width_m, self.shape.cylinders[joint]
        below = -0.75 * width  # of the swing: beneath its link
        if joint == 0:
            held = "/swing_cylinder"
            scene.add_frame(held, show_axes=False, position=(0.0, 0.0, self.shape.base_m + below))
            horn = "/arm/swing/horn"
            turned, lift = _about_z, below
        else:
            held = "/arm/swing/wrist_cylinder"
            scene.add_frame(held, show_axes=False, position=(self.shape.links_m[0], 0.0, 0.0))
            horn = "/arm/swing/wrist/horn"
            turned, lift = _upwards, 0.0
        thin = 0.3 * width
        anchor = self._in_plane(joint, part.anchor)
        toward = math.atan2(part.anchor[1], part.anchor[0])
        if joint == 0:
            reach = float(np.linalg.norm(part.anchor))
            scene.add_box(
                f"{held}/bracket", color=DARK, dimensions=(reach, 1.2 * thin, 1.2 * thin), wxyz=_about_z(toward),
                position=tuple(0.5 * np.array(anchor) + np.array([0.0, 0.0, -0.5 * width])),
            )  # fmt: skip
            scene.add_cylinder(
                f"{held}/pin", radius=thin, height=1.2 * width, color=DARK,
                position=(anchor[0], anchor[1], -0.2 * width),
            )  # fmt: skip
        else:
            drop = abs(anchor[2])
            scene.add_box(
                f"{held}/bracket", color=DARK, dimensions=(2.0 * thin, thin, drop),
                position=(anchor[0], 0.0, 0.5 * anchor[2]),
            )  # fmt: skip
        scene.add_frame(horn, show_axes=False, wxyz=turned(part.horn_rad), position=(0.0, 0.0, lift))
        scene.add_box(
            f"{horn}/crank", color=DARK, dimensions=(part.crank_m, thin, thin), position=(0.5 * part.crank_m, 0.0, 0.0)
        )
        barrel = scene.add_frame(f"{held}/barrel", show_axes=False, position=anchor)
        scene.add_cylinder(
            f"{held}/barrel/body", radius=part.barrel_radius_m, height=part.barrel_m, color=STEEL,
            wxyz=_TURN_TO_X, position=(0.5 * part.barrel_m, 0.0, 0.0),
        )  # fmt: skip
        rod = scene.add_frame(f"{held}/barrel/rod", show_axes=False)
        scene.add_cylinder(
            f"{held}/barrel/rod/body", radius=part.rod_radius_m, height=part.rod_m, color=ROD,
            wxyz=_TURN_TO_X, position=(-0.5 * part.rod_m, 0.0, 0.0),
        )  # fmt: skip
        return barrel, rod

    def _in_plane(self, joint: int, point: np.ndarray) -> tuple[float, float, float]:
        """A point of a crank triangle's plane, in the frame that holds the cylinder."""
        x, y = float(point[0]), float(point[1])
        return (x, y, 0.0) if joint == 0 else (x, 0.0, y)

    def show_arm(self, angles_rad: tuple[float | None, float | None] | None) -> None:
        """Turn the arm and let its cylinders follow."""
        if not self.arm.show(angles_rad):
            return
        for joint, turned in enumerate((_about_z, _upwards)):
            part, (barrel, rod) = self.shape.cylinders[joint], self._cylinders[joint]
            angle = angles_rad[joint]  # type: ignore[index]
            barrel.wxyz = turned(part.direction_rad(angle))
            rod.position = (part.length_m(angle), 0.0, 0.0)
        self._label.position = self.shape.tip(angles_rad) + np.array([0.0, 0.0, 3.4 * self.shape.width_m])  # type: ignore[arg-type]

    def show_load(self, kg: float | None, sd_kg: float | None, true_kg: float | None) -> None:
        """Give the balls their sizes."""
        self.load.show(kg)
        self.shell.show(None if kg is None or sd_kg is None else kg + 2.0 * sd_kg)
        self.true_load.show(true_kg)

    def show_label(self, text: str) -> None:
        """Write beside the load."""
        if self._label.text != text:
            self._label.visible = bool(text)
            self._label.text = text


def _net() -> np.ndarray:
    """Three great circles and two parallels of a ball of radius 1, as segments; shape (N, 2, 3)."""
    turn = np.linspace(0.0, 2.0 * np.pi, _BALL_SEGMENTS * 2 + 1)
    c, s, z = np.cos(turn), np.sin(turn), np.zeros_like(turn)
    rings = [np.stack(axes, axis=1) for axes in ((c, s, z), (c, z, s), (z, c, s))]
    for height in (-0.6, 0.6):
        radius = math.sqrt(1.0 - height**2)
        rings.append(np.stack((radius * c, radius * s, np.full_like(turn, height)), axis=1))
    return np.concatenate([np.stack((ring[:-1], ring[1:]), axis=1) for ring in rings])
