"""Wind speeds, as the command line has them."""

import itertools

from mbn_marl.errors import ConfigError

MOST_SPEEDS = 100
ALLOWED = (
    f"allowed: up to {MOST_SPEEDS} speeds of 0 and above between commas, and '..' for even steps "
    "from two of them to the next; for example 0,0.1,..,0.5"
)


def parse_speeds(text: str) -> list[float]:
    """Read wind speeds: ``0,0.1,..,0.5`` is ``0,0.1,0.2,0.3,0.4,0.5``."""
    speeds: list[float] = []
    words = [word.strip() for word in text.split(",")]
    for before, word in itertools.pairwise(["", *words]):
        if word == ".." and word is not words[-1]:
            continue
        try:
            end = float(word)
            if before == "..":
                start, step = speeds[-1], speeds[-1] - speeds[-2]
                count = round((end - start) / step)
                if not 1 <= count <= MOST_SPEEDS or abs(start + count * step - end) > 1e-9:
                    raise ValueError
                speeds += [round(start + number * step, 12) for number in range(1, count)]
            if not 0.0 <= end < float("inf") or len(speeds) >= MOST_SPEEDS:
                raise ValueError
        except (ValueError, IndexError, ZeroDivisionError, OverflowError):
            place = f"{before},{word}" if before == ".." else repr(word)
            raise ConfigError("wind", [f"wind_speeds {text!r}: {place}; {ALLOWED}"]) from None
        speeds.append(end)
    return speeds
