"""Draw a snapshot on a pygame surface, without a display."""

# Its pieces are drawn several times too large and scaled down, which smooths every edge. They are
# premultiplied by their alpha, so that their edges stay clean: blit with BLEND_PREMULTIPLIED.

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pygame
from numpy.typing import ArrayLike, NDArray

from mbn_marl.field import Field
from mbn_marl.render import style

if TYPE_CHECKING:
    from mbn_marl.engine.snapshot import Snapshot

_MINUS = "\N{MINUS SIGN}"
_NOMINAL = 400.0  # the smaller side, in pixels, at which the sizes below hold; they grow with it
_SMALLEST_SCALE = 0.7  # what they shrink to at most: smaller text cannot be read
_MARGIN, _HEADER, _FOOTER = 16.0, 46.0, 20.0
_ROBOT, _ROI, _TRAIL, _COMPASS = 8.0, 6.0, 2.0, 19.0
_FONT, _SMALL_FONT = 18.0, 13.0
_FINE = 4  # how many times larger than shown a piece is drawn
_LARGE = 1200  # a sprite of so many pixels is drawn as large as it is shown
_VISITED_TINT, _SAFETY_TINT = 70, 60  # opacity, 0 to 255, of the circles drawn to scale
_ROOM = 1.2  # a circle to scale is drawn where it is so many times larger than the marker inside
_OWN = 1.65  # radius of the ring round the user's robot, as a share of the robot's disc

# Paints a square surface, given its centre coordinate and the size of a shown pixel.
Painter = Callable[[pygame.Surface, float, float], None]


class Scene:
    # Markers are of a size that can be read, and have circles to scale round them.
    def __init__(self, size: tuple[int, int], own: int | None = None, keys: str = "") -> None:
        pygame.font.init()
        self.size, self._own, self._keys = size, own, keys
        self._ui = max(min(size) / _NOMINAL, _SMALLEST_SCALE)
        self._font = pygame.font.Font(None, round(_FONT * self._ui))
        self._frame = _blank(size)
        self._look: tuple[object, ...] = ()

    def pixels(self, snapshot: Snapshot) -> NDArray[np.uint8]:
        picture = pygame.surfarray.array3d(self.draw(snapshot))
        return np.ascontiguousarray(picture.swapaxes(0, 1))

    def draw(self, snapshot: Snapshot) -> pygame.Surface:
        """Draw ``snapshot``; the surface is drawn over by the next call."""
        self._prepare(snapshot)
        self._extend_trails(snapshot)
        self._frame.blit(self._canvas, (0, 0))
        if math.hypot(*snapshot.wind) > style.CALM:
            self._draw_wind(snapshot.wind)
        for centre, visited in zip(self._roi_pixels, snapshot.visited, strict=True):
            _stamp(self._frame, self._rois[bool(visited)], centre)
        centres = self._view.to_pixels(snapshot.positions)
        for i, k in np.argwhere(snapshot.heard):  # the half at robot i: it hears robot k
            ends = centres[i].tolist(), ((centres[i] + centres[k]) / 2).tolist()
            pygame.draw.aaline(self._frame, style.rgb(style.FAINT_INK), *ends)
        for index, heading in enumerate(snapshot.headings.tolist()):
            if not math.isnan(heading):
                self._draw_nose(index, centres[index], heading)
        for sprite, centre in zip(self._robots, centres, strict=True):
            _stamp(self._frame, sprite, centre)
        for centre in centres[snapshot.failed]:
            for way in ((1.0, 1.0), (1.0, -1.0)):
                arm = np.array(way) * _ROBOT * self._ui
                ends = (centre - arm).tolist(), (centre + arm).tolist()
                pygame.draw.line(self._frame, style.rgb(style.INK), *ends, round(2 * self._ui))
        self._write_header(snapshot)
        return self._frame

    def _prepare(self, snapshot: Snapshot) -> None:
        """Redraw what stays from frame to frame, if any of it differs from the last frame's."""
        field, robots = snapshot.field, len(snapshot.positions)
        look = (field, snapshot.roi_radius, snapshot.safety_distance, robots)
        if look == self._look:
            return
        self._look = look
        width, height = self.size
        margin, header = _MARGIN * self._ui, _HEADER * self._ui
        footer = _FOOTER * self._ui if self._keys else margin
        area = (margin, header, width - 2 * margin, height - header - footer)
        self._view = Viewport.fit(field.vertices, area)
        self._background = _terrain(field, self._view, self.size, 2.0 * self._ui)
        if self._keys:
            font = pygame.font.Font(None, round(_SMALL_FONT * self._ui))
            keys = font.render(self._keys, True, style.rgb(style.INK))
            self._background.blit(keys, keys.get_rect(midbottom=(width / 2, height - self._ui * 4)))
        self._canvas = self._background.copy()
        self._drawn = np.empty((0, robots, 2))
        self._roi_pixels = self._view.to_pixels(field.rois)
        whole = math.hypot(width, height)  # a larger circle looks the same
        reach = min(snapshot.roi_radius * self._view.scale, whole)
        self._rois = [_roi(visited, _ROI * self._ui, reach) for visited in (False, True)]
        safety = min(snapshot.safety_distance / 2.0 * self._view.scale, whole)
        self._robots = [
            _robot(index, _ROBOT * self._ui, safety, own=index == self._own)
            for index in range(robots)
        ]

    def _draw_wind(self, wind: tuple[float, float]) -> None:
        radius, gap = _COMPASS * self._ui, 4 * self._ui
        centre = (self.size[0] - radius - gap, radius + gap)
        _stamp(self._frame, _wind_arrow(wind, radius), centre)
        label = self._font.render(f"wind {math.hypot(*wind):.3g}", True, style.rgb(style.WIND))
        end = (round(centre[0] - radius - gap), round(centre[1]))
        self._frame.blit(label, label.get_rect(midright=end))

    def _extend_trails(self, snapshot: Snapshot) -> None:
        trail = np.array(snapshot.trail, np.float64)
        known = len(self._drawn)
        if not np.array_equal(trail[:known], self._drawn):
            self._canvas.blit(self._background, (0, 0))
            known = 0
        pixels = self._view.to_pixels(trail[max(known - 1, 0) :])
        width = max(round(_TRAIL * self._ui), 1)
        colours = [style.rgb(style.robot_colour(index)) for index in range(trail.shape[1])]
        if known == 0:
            for colour, start in zip(colours, pixels[0].tolist(), strict=True):
                pygame.draw.aacircle(self._canvas, colour, start, 2 * width)
        for before, after in pairwise(pixels.tolist()):
            for colour, start, end in zip(colours, before, after, strict=True):
                pygame.draw.aaline(self._canvas, colour, start, end, width)
        self._drawn = trail

    def _draw_nose(self, index: int, centre: NDArray[np.float64], heading: float) -> None:
        ahead = np.array([math.cos(heading), -math.sin(heading)]) * _ROBOT * self._ui
        side = ahead[::-1] * (0.75, -0.75)
        corners = [centre + 2.0 * ahead, centre + 0.6 * ahead + side, centre + 0.6 * ahead - side]
        colour = style.rgb(style.robot_colour(index))
        pygame.draw.polygon(self._frame, colour, [corner.tolist() for corner in corners])
        pygame.draw.aalines(self._frame, colour, True, [corner.tolist() for corner in corners])

    def _write_header(self, snapshot: Snapshot) -> None:
        left, column = round(_MARGIN * self._ui), round(96 * self._ui)
        rows = (round(9 * self._ui), round(25 * self._ui))
        reward = snapshot.team_return
        shown = f"{reward:,.0f}" if abs(reward) >= 1000.0 else f"{reward:.4g}"
        visited = int(np.count_nonzero(snapshot.visited))
        self._write(f"step {snapshot.step}", style.INK, (left, rows[0]))
        self._write(f"return {shown.replace('-', _MINUS)}", style.INK, (column, rows[0]))
        count = len(snapshot.visited) - np.count_nonzero(snapshot.empty)
        self._write(f"ROIs {visited}/{count}", style.INK, (left, rows[1]))
        if snapshot.collision:
            self._write("collision", style.WHITE, (column, rows[1]), style.COLLISION)
        elif snapshot.success:
            self._write("success", style.WHITE, (column, rows[1]), style.SUCCESS)

    def _write(self, text: str, colour: str, place: tuple[int, int], badge: str = "") -> None:
        picture = self._font.render(text, True, style.rgb(colour))
        box = picture.get_rect(topleft=place)
        if badge:
            pad = round(4 * self._ui)
            around = box.inflate(2 * pad, pad)
            pygame.draw.rect(self._frame, style.rgb(badge), around, border_radius=pad)
        self._frame.blit(picture, box)


def _stamp(target: pygame.Surface, sprite: pygame.Surface, centre: Sequence[float]) -> None:
    place = [round(at - side / 2) for at, side in zip(centre, sprite.get_size(), strict=True)]
    target.blit(sprite, place, special_flags=pygame.BLEND_PREMULTIPLIED)


@dataclass(frozen=True)
class Viewport:
    """The map from field units to pixels, ``origin + scale * (x, -y)`` from the top left."""

    scale: float
    origin: tuple[float, float]

    @classmethod
    def fit(cls, points: NDArray[Any], area: tuple[float, float, float, float]) -> Viewport:
        """Fit the box of ``points`` (k, 2) to ``area``: left, top, width, height in pixels."""
        left, top, width, height = area
        low, high = points.min(axis=0), points.max(axis=0)
        extent = np.maximum(high - low, 1e-9)
        scale = float(min(width / extent[0], height / extent[1]))
        x, y = (scale * (low + high) / 2.0).tolist()
        return cls(scale, (left + width / 2.0 - x, top + height / 2.0 + y))

    def to_pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(self.origin) + np.asarray(points, np.float64) * (self.scale, -self.scale)


def _blank(size: tuple[int, int]) -> pygame.Surface:
    return pygame.Surface(size, 0, 32)  # opaque; its format does not depend on a display


def _terrain(
    field: Field, view: Viewport, size: tuple[int, int], line_width: float
) -> pygame.Surface:
    fine = _blank((size[0] * _FINE, size[1] * _FINE))
    fine.fill(style.rgb(style.OBSTACLE))
    width, outline = max(round(line_width * _FINE), 1), style.rgb(style.OUTLINE)
    for index, ring in enumerate((field.vertices, *field.holes)):
        points = (view.to_pixels(ring) * _FINE).tolist()
        fill = style.OBSTACLE if index else style.GROUND
        pygame.draw.polygon(fine, style.rgb(fill), points)
        for start, end in zip(points, points[1:] + points[:1], strict=True):
            pygame.draw.line(fine, outline, start, end, width)
            pygame.draw.circle(fine, outline, start, width / 2)
    return pygame.transform.smoothscale(fine, size)


def _roi(visited: bool, marker: float, reach: float) -> pygame.Surface:
    colour = style.rgb(style.ROI_VISITED if visited else style.ROI_OPEN)
    white = style.rgb(style.WHITE)

    def paint(surface: pygame.Surface, centre: float, pixel: float) -> None:
        middle, size = (centre, centre), marker * pixel
        if reach > _ROOM * marker:
            if visited:
                pygame.draw.circle(surface, (*colour, _VISITED_TINT), middle, reach * pixel)
            pygame.draw.circle(surface, colour, middle, reach * pixel, round(0.8 * pixel))
        pygame.draw.circle(surface, colour if visited else white, middle, size)
        if not visited:
            pygame.draw.circle(surface, colour, middle, size, round(1.6 * pixel))
            return
        shape = ((-0.45, 0.02), (-0.12, 0.36), (0.48, -0.34))
        tick = [(centre + size * x, centre + size * y) for x, y in shape]
        width = max(round(0.22 * size), 1)
        pygame.draw.lines(surface, white, False, tick, width)
        for point in tick:
            pygame.draw.circle(surface, white, point, width / 2)

    return _sprite(max(marker, reach), paint)


def _robot(index: int, radius: float, safety: float, *, own: bool = False) -> pygame.Surface:
    """Draw a numbered disc in a circle of ``safety`` pixels; a dark ring marks the user's own."""
    colour = style.robot_colour(index)
    mark = _OWN * radius if own else 0.0

    def paint(surface: pygame.Surface, centre: float, pixel: float) -> None:
        middle = (centre, centre)
        if safety > _ROOM * radius:
            pygame.draw.circle(surface, (*style.rgb(colour), _SAFETY_TINT), middle, safety * pixel)
            line = round(1.2 * pixel)
            pygame.draw.circle(surface, style.rgb(colour), middle, safety * pixel, line)
        if own:
            ink = style.rgb(style.INK)
            pygame.draw.circle(surface, ink, middle, mark * pixel, round(0.3 * radius * pixel))
        pygame.draw.circle(surface, style.rgb(style.WHITE), middle, radius * pixel)
        pygame.draw.circle(surface, style.rgb(colour), middle, (radius - 1) * pixel)
        font = pygame.font.Font(None, round((1.75 if index < 10 else 1.4) * radius * pixel))
        number = font.render(str(index), True, style.rgb(style.ink_on(colour)))
        surface.blit(number, number.get_rect(center=(round(centre), round(centre + 0.4 * pixel))))

    return _sprite(max(radius, safety, mark), paint)


def _wind_arrow(wind: tuple[float, float], radius: float) -> pygame.Surface:
    angle = math.atan2(-wind[1], wind[0])
    cos, sin = math.cos(angle), math.sin(angle)

    def paint(surface: pygame.Surface, centre: float, pixel: float) -> None:
        def place(along: float, across: float) -> tuple[float, float]:
            x, y = along * radius * pixel, across * radius * pixel
            return centre + cos * x - sin * y, centre + sin * x + cos * y

        ink = style.rgb(style.WIND)
        pygame.draw.circle(surface, style.rgb(style.WHITE), (centre, centre), radius * pixel)
        pygame.draw.circle(surface, ink, (centre, centre), radius * pixel, round(pixel))
        shaft = [place(-0.7, -0.08), place(0.2, -0.08), place(0.2, 0.08), place(-0.7, 0.08)]
        pygame.draw.polygon(surface, ink, shaft)
        pygame.draw.polygon(surface, ink, [place(0.8, 0), place(0.05, -0.38), place(0.05, 0.38)])

    return _sprite(radius, paint)


def _sprite(radius: float, paint: Painter) -> pygame.Surface:
    side = 2 * math.ceil(radius + 1)
    times = _FINE if side < _LARGE else 1
    fine = pygame.Surface((side * times, side * times), pygame.SRCALPHA, 32)
    paint(fine, side * times / 2, float(times))
    return pygame.transform.smoothscale(fine.premul_alpha(), (side, side))
