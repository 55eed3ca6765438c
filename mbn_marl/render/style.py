"""The one look of everything drawn, on screen and on paper; every colour is named here only.

The hues are the colour-blind safe set of Okabe and Ito, "Color Universal Design" (2008), and four
more that stay apart from them and from each other for every kind of colour blindness. Colour never
carries a meaning alone: robots and curves also have numbers, dashes or markers, and a visited ROI
is filled and ticked where an unvisited one is hollow.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

BLACK: Final = "#000000"
ORANGE: Final = "#E69F00"
SKY_BLUE: Final = "#56B4E9"
BLUISH_GREEN: Final = "#009E73"
BLUE: Final = "#0072B2"
VERMILLION: Final = "#D55E00"
REDDISH_PURPLE: Final = "#CC79A7"
PLUM: Final = "#A81E7E"
BROWN: Final = "#66503F"
LAVENDER: Final = "#9977FF"
INDIGO: Final = "#4F22E8"
WHITE: Final = "#FFFFFF"

GROUND: Final = WHITE
"""Inside the field."""
OBSTACLE: Final = "#DDE2E8"
"""Outside the field, and in its holes."""
OUTLINE: Final = "#3C4650"
INK: Final = "#1B232B"
FAINT_INK: Final = "#6B7681"
ROI_OPEN: Final = INK
ROI_VISITED: Final = BLUISH_GREEN
SUCCESS: Final = BLUISH_GREEN
COLLISION: Final = VERMILLION
WIND: Final = BLUE
CALM: Final = 1e-9
"""Wind weaker than this, in units/step per step, is none (cos 90 degrees is not quite 0)."""

ROBOTS: Final = (
    *(BLUE, VERMILLION, REDDISH_PURPLE, ORANGE, SKY_BLUE, BLACK),
    *(PLUM, BROWN, LAVENDER, INDIGO),
)
"""The colours of robots 0 to 9; green is left to visited ROIs."""
_DASHES: Final = ("-", "--", "-.", ":")
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")

MATPLOTLIB: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": OUTLINE,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": OBSTACLE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": OUTLINE,
    "ytick.color": OUTLINE,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "lines.solid_capstyle": "round",
    "savefig.dpi": 200,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.06,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
}
"""Matplotlib settings of every figure, for ``matplotlib.rc_context``, which types its own keys."""


class PagePalette(NamedTuple):
    """The colours of a page in a browser; robots have theirs in the order of their numbers."""

    page: str
    ground: str
    obstacle: str
    outline: str
    line: str
    ink: str
    faint_ink: str
    accent: str
    visited: str
    success: str
    collision: str
    wind: str
    robots: tuple[str, ...]


LIGHT_PAGE: Final = PagePalette(
    page="#F7F9FB",
    ground=GROUND,
    obstacle=OBSTACLE,
    outline=OUTLINE,
    line="#C3CBD3",
    ink=INK,
    faint_ink="#55606B",
    accent=BLUE,
    visited=ROI_VISITED,
    success="#00704F",
    collision="#A84600",
    wind=WIND,
    robots=ROBOTS,
)
DARK_PAGE: Final = PagePalette(
    page="#12171C",
    ground="#0B0F13",
    obstacle="#232B33",
    outline="#9AA5B0",
    line="#3A454F",
    ink="#E8EDF2",
    faint_ink="#A3AEB9",
    accent=SKY_BLUE,
    visited=BLUISH_GREEN,
    success="#3CC79C",
    collision="#F08A4B",
    wind=SKY_BLUE,
    robots=tuple(WHITE if colour == BLACK else colour for colour in ROBOTS),
)
"""On dark ground the hues stay; black turns white, and text is lighter."""


THEMED: Final = {
    BLACK: (BLACK, WHITE),
    **{
        getattr(LIGHT_PAGE, name): (getattr(LIGHT_PAGE, name), getattr(DARK_PAGE, name))
        for name in ("ground", "obstacle", "outline", "ink")
    },
    FAINT_INK: (LIGHT_PAGE.faint_ink, DARK_PAGE.faint_ink),
    BROWN: (BROWN, "#A68A73"),
    PLUM: (PLUM, "#D45AAE"),
    INDIGO: (INDIGO, "#6A4DFF"),
}
"""Colours of figures that differ on a light and on a dark page."""


class SeriesStyle(NamedTuple):
    """How one of several curves is drawn: colour, dash pattern and marker all tell it apart."""

    colour: str
    dash: str
    marker: str


def series(index: int) -> SeriesStyle:
    """Return the style of curve ``index``; any three in a row differ in all three ways."""
    return SeriesStyle(
        ROBOTS[index % len(ROBOTS)],
        _DASHES[index % len(_DASHES)],
        _MARKERS[index % len(_MARKERS)],
    )


def robot_colour(index: int) -> str:
    """Return the colour of robot ``index`` (0, 1, ...); the eleventh has that of the first."""
    return ROBOTS[index % len(ROBOTS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return ``"#RRGGBB"`` as three numbers, 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def ink_on(colour: str) -> str:
    """Return black or white, whichever contrasts more with ``colour``.

    Black wins above a relative luminance of 0.179 (WCAG 2.1, "contrast ratio"), where both
    contrasts are equal.
    """
    linear = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
        for c in (channel / 255.0 for channel in rgb(colour))
    ]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return BLACK if luminance > 0.179 else WHITE
