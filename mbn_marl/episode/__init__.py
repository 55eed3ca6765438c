"""Episodes as values: recorded from any environment, saved as JSON, replayed exactly."""

from mbn_marl.episode.episode import Episode, Knowledge, Outcome
from mbn_marl.episode.files import is_episode_file, load_episode, save_episode
from mbn_marl.episode.play import check_episode, play
from mbn_marl.episode.recorder import EpisodeRecorder

__all__ = [
    "Episode",
    "EpisodeRecorder",
    "Knowledge",
    "Outcome",
    "check_episode",
    "is_episode_file",
    "load_episode",
    "play",
    "save_episode",
]
