"""Readers of input get input that nobody meant.

Hypothesis edits valid files and makes up settings and command lines. Each input has to be
accepted, or refused with the suite's own error within a second of computing, and no file may be
written outside the folder that the process is in.
"""

from __future__ import annotations

import contextlib
import gc
import io
import itertools
import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from baselines.algorithms import ALGORITHMS
from baselines.cli import main as mbn
from baselines.compare.text_table import TextTable
from baselines.training.config import TrainConfig
from baselines.training.hyperparameters import read_block
from baselines.training.overrides import parse
from baselines.training.train import prepare
from mbn_marl.config import NavigationConfig, make_config
from mbn_marl.episode import check_episode, load_episode, play, save_episode
from mbn_marl.errors import ConfigError, EpisodeError, FieldError, MbnError, unknown
from mbn_marl.field import catalogue_names, load_field
from mbn_marl.field.catalogue import catalogue_file

LONGEST = 1.0  # seconds of computing that an input may take
MEMORY = 16 * 2**30  # bytes of address space: who asks for more gets an error, not the machine
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
WORDS = (
    *("", "0", "1", "-1", "3", "1e999", "nan", ".inf", "-0.0", "1_0", "0x1f", "1:30", "9" * 30),
    *("null", "true", "~", "text", "'", '"', "[", "]", "{", "}", ",", ":", "- ", "\n", "\t", "  "),
    *("&a", "*a", "<<: *a", "!!bool x", "!!python/object/apply:os.mkdir ['x']", "!!set {a}", "---"),
    *("..", "../x", "/tmp/x", "~/x", "a/../../x", "\x00", "\ud800", "\u202e", "%s", "#", "{0}"),
    *("vertices", "rois", "starts", "holes", "arena", "name", "format", "grid_size", "field"),
)
JUNK = st.one_of(st.sampled_from(WORDS), st.text(max_size=8), st.integers().map(str))
NAMED = st.sampled_from((*WORDS, "float32", "team", "formal", "lidar"))
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.integers(-2, 70), st.floats(), NAMED)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(JUNK, inner, max_size=3),
    max_leaves=5,
)
EDIT = st.tuples(st.integers(0, 1 << 20), st.integers(0, 9), JUNK)


def edits_of(*files: bytes) -> st.SearchStrategy[bytes]:
    """Return one of the files with pieces taken out and words put in."""

    def edited(data: bytes, edits: list[tuple[int, int, str]]) -> bytes:
        for place, length, word in edits:
            start = place % (len(data) + 1)
            data = data[:start] + word.encode("utf-8", "surrogatepass") + data[start + length :]
        return data

    return st.builds(edited, st.sampled_from(files), st.lists(EDIT, min_size=1, max_size=4))


@dataclass
class Count:
    """The inputs of a target."""

    inputs: int = 0
    taken: int = 0
    refused: int = 0
    longest: float = 0.0
    broken: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Target:
    """Something that reads input."""

    call: Callable[[Any], None]  # takes a drawn value, and raises what it raises
    strategy: st.SearchStrategy[Any]
    allowed: type[MbnError]  # the error that it may raise
    share: float  # of all inputs


class Guard:
    """Notes in ``outside`` what is written outside some folders, while it is ``watching``."""

    PATHS: ClassVar = {
        **dict.fromkeys(("open", "os.mkdir", "os.remove", "os.rmdir"), 1),
        **dict.fromkeys(("os.rename", "os.link", "os.symlink"), 2),
    }
    """Audited events, and how many of their arguments are paths."""

    def __init__(self, *folders: Path) -> None:
        self._folders = tuple(str(folder.resolve()) for folder in folders)
        self.watching = False
        self.outside: list[str] = []
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        reads = event == "open" and not (arguments[2] or 0) & WRITES
        if not self.watching or event not in self.PATHS or reads:
            return
        for path in arguments[: self.PATHS[event]]:
            if isinstance(path, str | bytes | os.PathLike):
                place = os.path.realpath(os.fsdecode(path))
                if place != os.devnull and not place.startswith(self._folders):
                    self.outside.append(f"{event} {place}")


def read_field(data: bytes) -> None:
    """Read a field."""
    Path("field.yaml").write_bytes(data)
    load_field("field.yaml")


def read_an_episode(data: bytes) -> None:
    """Read an episode, and check it in the engine."""
    Path("episode.json").write_bytes(data)
    check_episode(load_episode("episode.json"))


def read_settings(drawn: tuple[str, dict[str, Any], list[str], bytes]) -> None:
    """Read settings of environment and training, and a file of hyperparameters."""
    algorithm, values, words, block = drawn
    path = Path("block.yaml")
    path.write_bytes(block)

    def training() -> None:
        given = parse(words)
        environment = {**values, **given.pop("environment", {})}
        prepare(TrainConfig(algorithm, "field_03", environment=environment, hyperparameters=given))

    problem: ConfigError | None = None
    for read in (lambda: make_config(values), training, lambda: read_block(path, "N")):
        try:
            read()
        except ConfigError as error:
            problem = error
    if problem is not None:
        raise problem


def command_line(words: list[str]) -> None:
    """Run ``mbn``, up to where the hours of work would begin."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.redirect_stderr(heard):
        code = mbn(words)
    if code not in (0, 2):
        raise RuntimeError(f"exit code {code}")
    if "Traceback" in heard.getvalue():
        raise RuntimeError("a traceback was printed")
    if code:
        raise MbnError(heard.getvalue())


WORK = (
    "baselines.training.train.train",
    "baselines.compare.run.train_all_runs",
    "baselines.tuning.tune.tune",
    "baselines.evaluation.evaluate.evaluate_both",
    "baselines.evaluation.wind.evaluate_in_wind",
    "baselines.evaluation.rollout.record_episode",
    "baselines.demo.interactive.watch",
    "baselines.demo.interactive.play",
    "mbn_marl.planning.plan",
)
"""Functions that take long once their input is checked: they raise an error instead."""
NAMES = [*NavigationConfig.model_fields, "unknown"]
SETTINGS = st.dictionaries(st.sampled_from(NAMES), VALUES, max_size=4)
KNOWN = ("entropy", "hidden", "num_worlds", "model.gamma", "model.learning_rate", "num_envs")
OVERRIDES = st.lists(
    st.builds("{}={}".format, st.sampled_from((*KNOWN, "environment.tau", "a.b", "")), JUNK),
    max_size=3,
)
COMMANDS = (
    "fields field_03 --figure --force",
    "train ppo field_03 --setting --seed --steps --set --label --out --from --hyperparams",
    "transfer ppo --fields --source --steps --processes --out",
    "evaluate zoo:field_03 --episodes --field --json --record --seed",
    "compare --algos --fields --seeds --variants --out --steps",
    "tune a2c --field --trials --steps --out --processes",
    "report runs -o --paper --comparison --study --notes",
    "plan field_03 --time-limit --noise --episodes --export --out",
    "render zoo:field_03 -o --steps --seed --sampled --force",
    "replay episode.json -o --title --force",
    "watch field_03 --field --wind --speed --episodes --out",
    "zoo --add --out",
    "nonsense --help",
)
ENDINGS = ("a.json", "a.gif", "a.html", "a.md", "out", "field.yaml", "episode.json")
RIGHT = ("field_04", "mappo", "zoo:field_03", "2", "N")
ARGUMENT = JUNK | st.sampled_from(ENDINGS) | st.sampled_from(RIGHT)


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """Return a command with its arguments, some of them wrong."""
    command, *words = draw(st.sampled_from(COMMANDS)).split()
    needed = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
    options = words[len(needed) :]
    words = [draw(ARGUMENT) if draw(st.integers(0, 3)) == 0 else word for word in needed]
    for option in draw(st.lists(st.sampled_from(options), max_size=3)):
        words += [option, *draw(st.lists(ARGUMENT, max_size=2))]
    return [command, *(word.replace("\x00", "") for word in words)]


def targets() -> dict[str, Target]:
    """Return the targets by name."""
    fields = [catalogue_file(name) for name in catalogue_names()]
    own = {"format": "mbn-field/1", **load_field("field_03").to_dict()}
    theirs = b"field: [[0, 0], [50, 0], [50, 50]]\ninit_positions: [[5, 2]]\n"
    theirs += b"infected_locations: [[30, 10], [40, 20]]\ngrid_size: 60\n"
    several = b"a:\n  " + theirs.replace(b"\n", b"\n  ").rstrip() + b"\nb: {field: []}\n"
    tagged = theirs.replace(b"[[5, 2]]", b"!!python/tuple [!!python/tuple [5, 2]]")
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 3, 2)).astype(np.float32)
    episode = play(load_field("field_03"), make_config({}), actions, source="fuzz", seed=0)
    whole = save_episode(episode, "whole.json").read_bytes()
    block = b"N:\n  num_envs: 2\n  model: {gamma: 0.9}\n"
    drawn = st.tuples(st.sampled_from([*ALGORITHMS]), SETTINGS, OVERRIDES, edits_of(block))
    edited = edits_of(*fields, json.dumps(own).encode())
    return {
        "field reader": Target(read_field, edited, FieldError, 0.4),
        "authors' format": Target(read_field, edits_of(theirs, several, tagged), FieldError, 0.2),
        "episode reader": Target(read_an_episode, edits_of(whole), EpisodeError, 0.2),
        "settings": Target(read_settings, drawn, ConfigError, 0.19),
        "command line": Target(command_line, command_lines(), MbnError, 0.01),
    }


def fuzz(target: Target, inputs: int, guard: Guard, seed: int) -> Count:
    """Call with so many inputs; the first that breaks a promise is made small, and noted."""
    count = Count()

    @seeded(seed)
    @settings(
        max_examples=inputs,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(target.strategy)
    def one(drawn: Any) -> None:
        count.inputs += 1
        gc.disable()  # Hypothesis keeps so much that a collection takes longer than any call
        started, guard.watching = time.thread_time(), True
        try:
            target.call(drawn)
            count.taken += 1
        except target.allowed as error:
            assert str(error), "the error says nothing"
            count.refused += 1
        finally:
            guard.watching = False
            seconds = time.thread_time() - started
            gc.enable()
        count.longest = max(count.longest, seconds)
        assert seconds <= LONGEST, f"{seconds:.1f} s"
        assert not guard.outside, guard.outside[:3]

    try:
        one()
    except BaseException as error:  # Hypothesis groups several
        notes = "\n".join(getattr(error, "__notes__", []))
        count.broken.append(f"{type(error).__name__}: {error}\n{notes}")
        guard.outside.clear()
    return count


@dataclass(frozen=True)
class Fuzz:
    """Edit valid files, make up settings and command lines, and read them."""

    inputs: int = 200_000
    """In all."""
    only: tuple[str, ...] = ()
    """These targets; by default all."""
    seed: int = 0
    """Of the inputs."""

    def run(self, command: str) -> bool:
        """Return whether every input was read or refused as promised."""
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
        lines, broken = [], False
        with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
            stack.enter_context(contextlib.chdir(folder))
            known = targets()
            strange = [name for name in self.only if name not in known]
            if strange:
                problems = [f"only: {name}: {unknown('target', name, known)}" for name in strange]
                raise ConfigError("fuzz", problems)
            for name in WORK:
                stack.enter_context(patch(name, side_effect=MbnError("here the work would begin")))
            for algorithm in ALGORITHMS:
                prepare(TrainConfig(algorithm, "field_03"))  # loads the libraries
            guard = Guard(Path(folder), Path(os.environ.get("NUMBA_CACHE_DIR", folder)))
            for name in self.only or known:
                target = known[name]
                count = fuzz(target, round(self.inputs * target.share), guard, self.seed)
                print(*(f"{name}: {text}\n" for text in count.broken), file=sys.stderr, end="")
                broken |= bool(count.broken)
                numbers = count.inputs, count.taken, count.refused
                seconds, found = f"{count.longest:.2f} s", str(len(count.broken))
                lines.append((name, *(f"{n:,}" for n in numbers), seconds, found))
        headings = ("target", "inputs", "taken", "refused", "longest", "broken")
        TextTable("", headings, tuple(lines)).print("inputs that nobody meant")
        return not broken
