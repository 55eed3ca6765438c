"""Watching and driving in a window that nobody sees."""

from typing import Any

import numpy as np
import pygame
import pytest

from baselines.cli import main
from baselines.evaluation.window import watch
from baselines.policies.load import of_zoo
from baselines.policies.loaded import LoadedPolicy
from baselines.policies.policy import RandomPolicy
from mbn_marl import load_field
from mbn_marl.episode import load_episode
from mbn_marl.render import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.all]

FAST = {"speed": 5000.0, "episodes": 1, "rest": 0.0}


@pytest.fixture(autouse=True)
def closed_display():
    yield
    pygame.display.quit()


def at_frames(monkeypatch: pytest.MonkeyPatch, events: dict[int, tuple[int, int]]) -> None:
    draw = Viewer.draw
    frames = iter(range(100_000))

    def drawing(viewer: Viewer, snapshot: Any) -> Any:
        if (frame := next(frames)) in events:
            kind, key = events[frame]
            pygame.event.post(pygame.event.Event(kind, key=key))
        return draw(viewer, snapshot)

    monkeypatch.setattr(Viewer, "draw", drawing)


def still(max_steps: int = 6) -> LoadedPolicy:
    class Still(RandomPolicy):
        def act(self, seen: Any, *, deterministic: bool) -> Any:
            return np.zeros((*seen.shape[:2], 2), np.float32)

    return LoadedPolicy("still", Still(), {"max_steps": max_steps}, load_field("field_03"))


def test_a_person_drives_one_robot(monkeypatch):
    right = pygame.K_RIGHT
    at_frames(monkeypatch, {1: (pygame.KEYDOWN, right), 3: (pygame.KEYUP, right)})
    (episode,) = watch(still(), **FAST, driven=1)
    assert episode.actions[:, 1, 0].tolist() == [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert not episode.actions[:, [0, 2]].any() and not episode.actions[:, 1, 1].any()
    assert episode.source == "a person as robot 1, with still"


def test_space_pauses_r_begins_anew_and_escape_leaves(monkeypatch):
    down = pygame.KEYDOWN
    keys = {2: pygame.K_SPACE, 8: pygame.K_SPACE, 10: pygame.K_r, 14: pygame.K_ESCAPE}
    at_frames(monkeypatch, {frame: (down, key) for frame, key in keys.items()})
    first, second = watch(still(100), speed=5000.0, rest=0.0)
    assert first.steps == 4, "two before the pause and two after it"
    assert second.steps == 3 and second.outcome == "unfinished"


def test_the_commands_save_what_was_shown(tmp_path, refusal):
    out = tmp_path / "watched.json"
    quick = ("--episodes", "1", "--speed", "5000")
    wind = ("--wind", "0.1", "30")
    assert main(["watch", "field_03", *quick, *wind, "-o", str(out)]) == 0
    episode = load_episode(out)
    assert episode.source == "zoo:field_03 in field_03" and episode.config.wind == (0.1, 30.0)
    assert "watched.json" in refusal(["play", "field_03", "--robot", "2", *quick, "-o", str(out)])
    assert of_zoo("nowhere") == "random"


def test_a_show_that_cannot_be_is_refused(tmp_path, monkeypatch, refusal):
    (tmp_path / "recording.json").write_text('{"format": "mbn-episode/1"')
    for words, place in (
        ("watch recording.json", "mbn replay"),
        ("play field_03 --robot 3", "robot: "),
        ("watch field_03 --speed inf", "inf"),
        ("watch field_03 -o a.txt", ".json"),
    ):
        assert place in refusal(words.split()), words
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "display" in refusal(["watch", "field_03"])
