"""The one look of everything drawn, on screen and on paper; every colour is named here only."""

# The hues are the colour-blind safe set of Okabe and Ito, "Color Universal Design" (2008), and four
# more that stay apart for every kind of colour blindness. Colour never carries a meaning alone.

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

GROUND: Final = WHITE  # inside the field
OBSTACLE: Final = "#DDE2E8"  # outside the field, and in its holes
OUTLINE: Final = "#3C4650"
INK: Final = "#1B232B"
FAINT_INK: Final = "#6B7681"
ROI_OPEN: Final = INK
ROI_VISITED: Final = BLUISH_GREEN
SUCCESS: Final = BLUISH_GREEN
COLLISION: Final = VERMILLION
WIND: Final = BLUE
CALM: Final = 1e-9  # weaker wind, units/step per step, is none: cos 90 degrees is not quite 0

# Robots 0 to 9; green is left to visited ROIs.
ROBOTS: Final = (
    *(BLUE, VERMILLION, REDDISH_PURPLE, ORANGE, SKY_BLUE, BLACK),
    *(PLUM, BROWN, LAVENDER, INDIGO),
)
_DASHES: Final = ("-", "--", "-.", ":")
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*", ">")

# Matplotlib settings of every figure, for ``matplotlib.rc_context``, which types its own keys.
MATPLOTLIB: Final[dict[Any, Any]] = {
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
    "svg.hashsalt": "mbn_marl",  # so that the same figure is the same file
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.06,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
}

# The colours of a page in a browser, light and dark: hues stay, text is lighter on dark.
PAGE: Final[dict[str, tuple[str, str]]] = {
    "page": ("#F7F9FB", "#12171C"),
    "ground": (GROUND, "#0B0F13"),
    "obstacle": (OBSTACLE, "#232B33"),
    "outline": (OUTLINE, "#9AA5B0"),
    "line": ("#C3CBD3", "#3A454F"),
    "ink": (INK, "#E8EDF2"),
    "faint-ink": ("#55606B", "#A3AEB9"),
    "accent": (BLUE, SKY_BLUE),
    "visited": (ROI_VISITED, BLUISH_GREEN),
    "success": ("#00704F", "#3CC79C"),
    "collision": ("#A84600", "#F08A4B"),
    "wind": (WIND, SKY_BLUE),
    **{f"robot-{k}": (c, WHITE if c == BLACK else c) for k, c in enumerate(ROBOTS)},
}


class SeriesStyle(NamedTuple):
    colour: str
    dash: str
    marker: str


def series(index: int) -> SeriesStyle:
    """Return the look of a curve; any three in a row differ in colour, dash and marker."""
    # As 4 and 9 have no common divisor, 36 curves differ without their colour too.
    colour, dash, marker = (kind[index % len(kind)] for kind in (ROBOTS, _DASHES, _MARKERS))
    return SeriesStyle(colour, dash, marker)


def robot_colour(index: int) -> str:
    return ROBOTS[index % len(ROBOTS)]


def rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def ink_on(colour: str) -> str:
    # Both are equal at a relative luminance of 0.179 (WCAG 2.1, "contrast ratio").
    linear = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
        for c in (channel / 255.0 for channel in rgb(colour))
    ]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return BLACK if luminance > 0.179 else WHITE
