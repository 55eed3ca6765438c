"""Wind speeds of the command line."""

from __future__ import annotations

import pytest

from baselines.evaluation.wind import parse_speeds
from mbn_marl.errors import ConfigError


def test_speeds() -> None:
    for text, speeds in (
        ("0", [0.0]),
        ("0, 0.25,1", [0.0, 0.25, 1.0]),
        ("0,0.1,..,0.5", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]),
        ("0.4,0.3,..,0.1,0", [0.4, 0.3, 0.2, 0.1, 0.0]),
        ("0,0.1,..,0.2", [0.0, 0.1, 0.2]),
        (",".join(["0"] * 100), [0.0] * 100),
    ):
        assert parse_speeds(text) == speeds
    for text, place in (
        *(("", "''"), ("0,fast", "'fast'"), ("-0.1", "'-0.1'"), ("0,inf", "'inf'")),
        *(("nan", "'nan'"), ("0,..,0.5", "..,0.5;"), ("0,0.1,..", "'..'")),
        *(("0,0.2,..,0.5", "..,0.5;"), ("0,0,..,0.5", "..,0.5;"), ("0,0.1,..,0", "..,0;")),
        *(("0,1,..,5000", "..,5000;"), ("0,0.1,..,inf", "..,inf;")),
        *((",".join(["0"] * 101), "100 speeds"), ("0,1,..,100", "..,100;")),
    ):
        with pytest.raises(ConfigError) as caught:
            parse_speeds(text)
        assert place in str(caught.value), text
