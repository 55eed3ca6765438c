"""The pieces of the picture as smooth pygame surfaces: terrain, ROIs, robots, the wind arrow."""

# Each is drawn several times too large and scaled down, which smooths every edge. Sprites are
# premultiplied by their alpha, so that their edges stay clean: blit them with BLEND_PREMULTIPLIED.

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pygame
from numpy.typing import ArrayLike, NDArray

from mbn_marl.field import Field
from mbn_marl.render import style

_FINE = 4  # how many times larger than shown a piece is drawn
_VISITED_TINT, _SAFETY_TINT = 70, 60  # opacity, 0 to 255, of the circles drawn to scale
_ROOM = 1.2  # a circle to scale is drawn where it is so many times larger than the marker inside
_OWN = 1.65  # radius of the ring round the user's robot, as a share of the robot's disc

# Paints a square surface, given its centre coordinate and the size of a shown pixel.
Painter = Callable[[pygame.Surface, float, float], None]


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


def blank(size: tuple[int, int]) -> pygame.Surface:
    return pygame.Surface(size, 0, 32)  # opaque; its format does not depend on a display


def terrain(
    field: Field, view: Viewport, size: tuple[int, int], line_width: float
) -> pygame.Surface:
    fine = blank((size[0] * _FINE, size[1] * _FINE))
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


def roi(visited: bool, marker: float, reach: float) -> pygame.Surface:
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


def robot(index: int, radius: float, safety: float, *, own: bool = False) -> pygame.Surface:
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


def wind_arrow(wind: tuple[float, float], radius: float) -> pygame.Surface:
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
    fine = pygame.Surface((side * _FINE, side * _FINE), pygame.SRCALPHA, 32)
    paint(fine, side * _FINE / 2, float(_FINE))
    return pygame.transform.smoothscale(fine.premul_alpha(), (side, side))
