"""Draw a snapshot on a pygame surface, without a display."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pygame
from numpy.typing import NDArray

from mbn_marl.render import sprites, style

if TYPE_CHECKING:
    from mbn_marl.engine.snapshot import Snapshot

_MINUS = "\N{MINUS SIGN}"
_NOMINAL = 400.0  # the smaller side, in pixels, at which the sizes below hold; they grow with it
_SMALLEST_SCALE = 0.7  # what they shrink to at most: smaller text cannot be read
_MARGIN, _HEADER, _FOOTER = 16.0, 46.0, 20.0
_ROBOT, _ROI, _TRAIL, _COMPASS = 8.0, 6.0, 2.0, 19.0
_FONT, _SMALL_FONT = 18.0, 13.0


class Scene:
    # Markers are of a size that can be read, and have circles to scale round them.
    def __init__(self, size: tuple[int, int], own: int | None = None, keys: str = "") -> None:
        pygame.font.init()
        self.size, self._own, self._keys = size, own, keys
        self._ui = max(min(size) / _NOMINAL, _SMALLEST_SCALE)
        self._font = pygame.font.Font(None, round(_FONT * self._ui))
        self._frame = sprites.blank(size)
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
        self._view = sprites.Viewport.fit(field.vertices, area)
        self._background = sprites.terrain(field, self._view, self.size, 2.0 * self._ui)
        if self._keys:
            font = pygame.font.Font(None, round(_SMALL_FONT * self._ui))
            keys = font.render(self._keys, True, style.rgb(style.INK))
            self._background.blit(keys, keys.get_rect(midbottom=(width / 2, height - self._ui * 4)))
        self._canvas = self._background.copy()
        self._drawn = np.empty((0, robots, 2))
        self._roi_pixels = self._view.to_pixels(field.rois)
        reach = snapshot.roi_radius * self._view.scale
        self._rois = [sprites.roi(visited, _ROI * self._ui, reach) for visited in (False, True)]
        safety = snapshot.safety_distance / 2.0 * self._view.scale
        self._robots = [
            sprites.robot(index, _ROBOT * self._ui, safety, own=index == self._own)
            for index in range(robots)
        ]

    def _draw_wind(self, wind: tuple[float, float]) -> None:
        radius, gap = _COMPASS * self._ui, 4 * self._ui
        centre = (self.size[0] - radius - gap, radius + gap)
        _stamp(self._frame, sprites.wind_arrow(wind, radius), centre)
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
        self._write(f"ROIs {visited}/{len(snapshot.visited)}", style.INK, (left, rows[1]))
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
