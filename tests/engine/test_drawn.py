"""Numbers that episodes draw, and named conditions; ``test_forms`` has the oracle draw too."""

import re
from contextlib import nullcontext

import gymnasium
import pytest

from mbn_marl import BatchEngine, Failures, Field, Uniform
from mbn_marl.config import CONDITIONS, NavigationConfig, make_config
from mbn_marl.errors import ConfigError
from mbn_marl.registration import environment_id
from tests.support.configurations import EVERYTHING
from tests.support.disturbances import key_of
from tests.support.draws import NUMBERS as PURPOSE
from tests.support.draws import drawn_settings
from tests.support.pages import ROOT
from tests.support.problems import places_of

pytestmark = pytest.mark.slow
DRAWN = {
    **{name: Uniform(1e-9, 2e-9) for name in ("gust", "action_loss", "dropout")},
    "wind": (0.2, Uniform(30.0, 400.0)),
    "mass": (1.0, Uniform(1.0, 2.0), Uniform(3.0, 4.0)),
    "v_clip": Uniform(4.0, 6.0),
    "roi_radius": Uniform(5.0, 15.0),
    "gust_time": Uniform(2.0, 4.0),
    "failures": Failures(between=(1, 3), kind="vanish"),
}
NAMES = [
    *("wind_angle", "gust", "gust_time", "action_loss", "dropout", "roi_radius"),
    *("mass_1", "mass_2", "v_clip"),
]
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def test_episode_draws_the_numbers_of_the_page():
    engine = BatchEngine("field_03", 200, threads=1, **{**EVERYTHING, **DRAWN})
    engine.reset(seed=5)
    for episode in range(2):
        drawn = engine.drawn()
        assert [*drawn] == [*engine.config.drawn] == NAMES
        for world in (0, 7, 199):
            expected = drawn_settings(DRAWN, 3, key_of(5, world, episode, PURPOSE))
            known = dict(make_config({k: expected[k] for k in DRAWN}).numbers())
            assert [drawn[name][world] for name in NAMES] == [known[name] for name in NAMES]
            assert engine.config_in(world).with_drawn({}) == engine.config_in(world)
            assert engine.config_in(world).mass == expected["mass"]
            assert engine.snapshot(world).roi_radius == expected["roi_radius"]
            assert engine.snapshot(world).wind == pytest.approx(expected["wind_vector"], abs=1e-8)
        engine.reset()


def test_given_starts_are_checked_for_the_lowest_drawn_distance():
    near = [(200.0, 200.0), (200.0, 206.0)]
    field = Field([(0, 0), (400, 0), (400, 400), (0, 400)], [(300, 300)], [(50, 50), (90, 90)])
    given = near, [near[0], (200.0, 204.0)], None
    for starts, high, fits in zip(given, (20.0, 20.0, 70.0), (True, False, False), strict=True):
        drawn = {"safety_distance": Uniform(5.0, high), "n_robots": 2, "starts": starts}
        with nullcontext() if fits else pytest.raises(ConfigError, match="safety_distance"):
            BatchEngine(field, 1, **drawn)


def test_conditions_have_the_numbers_of_the_page():
    page = (ROOT / "docs" / "conditions.md").read_text(encoding="utf-8")
    for name, settings in CONDITIONS.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
        own = row.split("; and all of")[0]
        others = [other for other in re.findall(r"`(\w+)`", row[len(own) :]) if other in CONDITIONS]
        parts = {key: value for other in others for key, value in CONDITIONS[other].items()}
        assert parts.items() <= settings.items()
        for setting in settings.keys() - parts.keys():
            assert f"`{setting}`" in own
            numbers = set(map(float, NUMBER.findall(str(settings[setting])))) - {0.0, 360.0}
            assert numbers <= set(map(float, NUMBER.findall(own)))
        assert make_config({"condition": name}) == NavigationConfig(**settings)
    assert make_config({"condition": "calm"}) == NavigationConfig()
    wrong = {"condition": "windy", "wind": (0.1, 0.0), "gust": -1.0}
    assert places_of(ConfigError, make_config, wrong) == ["wind", "gust"]
    for unknown in (["windy"], "gustly"):
        with pytest.raises(ConfigError, match="condition"):
            make_config({"condition": unknown})


def test_every_condition_has_an_id():
    for name in CONDITIONS:
        settings = dict(gymnasium.spec(environment_id("field_03", name)).kwargs)
        assert settings.pop("field") == "field_03"
        assert make_config(settings) == make_config({"condition": name})
