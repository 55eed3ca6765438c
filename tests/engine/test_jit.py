"""Compiled code is reused between processes, and never after a rule has changed."""

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core import types
from numba.core.compiler import Compiler
from numba.core.registry import cpu_target

import mbn_marl
from mbn_marl.jit import compile, inlining
from mbn_marl.jit.compile import SOURCES, compiled, digest_of_sources, returning_views

pytestmark = pytest.mark.slow
PACKAGE = Path(mbn_marl.__file__).parents[1]
PROBE = """
from mbn_marl.engine.mdp.dynamics import next_velocity

print(next_velocity(1.0, 2.0, 1.0, 0.5, 5.0), sum(next_velocity.alone.stats.cache_hits.values()))
"""


def probe(folder: Path, cache: Path, warning: str = "", largest: int = -1) -> list[str]:
    """Return the result of a rule in a new process, and the number of hits in the cache."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", PROBE],
        **{"cwd": folder, "env": environment, "capture_output": True, "text": True, "check": True},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest, -1)),
    )
    assert not warning or sum(warning in line for line in done.stderr.splitlines()) == 1
    return done.stdout.split()


def test_cache_is_used_and_renewed(tmp_path):
    for name in ("mbn_marl", "envs_catalog"):
        shutil.copytree(PACKAGE / name, tmp_path / name)
    assert probe(tmp_path, tmp_path / "nb") == ["3.5", "0"]
    assert probe(tmp_path, tmp_path / "nb") == ["3.5", "1"]
    wind = tmp_path / "mbn_marl" / "engine" / "mdp" / "disturbances.py"  # of another rule
    source = wind.read_text(encoding="utf-8")
    assert "return velocity + wind" in source
    wind.write_text(source.replace("velocity + wind", "velocity - wind"), encoding="utf-8")
    assert probe(tmp_path, tmp_path / "nb") == ["2.5", "0"]


def test_engine_without_its_compiler_is_refused():
    command = [sys.executable, "-c", "from mbn_marl import parallel_env"]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode and "MbnError: NUMBA_DISABLE_JIT: " in done.stderr


def test_damaged_code_is_compiled_again(tmp_path):
    assert probe(PACKAGE, tmp_path) == ["3.5", "0"]
    for suffix, damage in ((".nbi", "cut"), (".nbc", "cut"), (".nbc", "one byte")):
        (place,) = tmp_path.rglob(f"*{suffix}")
        whole = place.read_bytes()
        half = len(whole) // 2
        changed = whole[:half] + bytes([whole[half] ^ 4]) + whole[half + 1 :]
        place.write_bytes(whole[:half] if damage == "cut" else changed)
        assert probe(PACKAGE, tmp_path, f"{place} is damaged") == ["3.5", "0"]
        assert probe(PACKAGE, tmp_path) == ["3.5", "1"]


def test_code_that_cannot_be_kept_is_used(tmp_path):
    for _ in range(2):
        assert probe(PACKAGE, tmp_path, f"{tmp_path}", largest=100) == ["3.5", "0"]
    (tmp_path / "file").touch()
    assert probe(PACKAGE, tmp_path / "file", f"NUMBA_CACHE_DIR={tmp_path}")[0] == "3.5"


def test_only_what_python_calls_becomes_machine_code():
    @compiled
    def twice(x):
        return 2 * x

    @numba.njit
    def four_times(x):
        return twice(twice(x))

    assert four_times(3) == 12
    in_memory = cpu_target.target_context.codegen()._engine.is_symbol_defined
    made = {f: [cr.fndesc.mangled_name for cr in f.overloads.values()] for f in (twice, four_times)}
    assert list(map(in_memory, made[twice])) == [False]
    assert list(map(in_memory, made[four_times])) == [True]


class Pair(NamedTuple):
    left: Any
    right: Any


def test_rule_takes_its_arguments_whole():
    def worth(pair, weight):
        left, best, where = pair.left, -1.0, -1
        twice = 2 * weight
        if left.size > 2:
            more = twice + 1
        for i in range(left.size):
            value = left[i] * twice
            if value > best:
                best = value
                where = i
            else:
                value = 0.0
            best += value / 8
        if left.size > 2:
            best += more
        return best + (pair.right[where] if where >= 0 else twice)

    rule = compiled(worth)
    caller = numba.njit(lambda pair, weight: rule(pair, weight))
    for left in ([1.0, 3.0, 2.0], [-4.0, -5.0], []):
        pair = Pair(np.array(left), np.array([5.0, 7.0, 9.0]))
        assert caller(pair, 1.5) == worth(pair, 1.5)
    (result,) = rule.overloads.values()
    function = result.library.get_function(result.fndesc.mangled_name)
    assert len(list(function.arguments)) == 2 + len(("result", "exception"))


def test_arrays_stay_among_rules_that_do_not_count_references():
    @returning_views
    def turned(pair):
        return pair[1][1:], pair[0]

    @compiled
    def total(pair):
        return turned(pair)[0].sum()

    pair = (np.ones(3), np.ones(2))
    assert numba.njit(lambda pair: total(pair))(pair) == total(pair) == 1
    assert [len(part) for part in turned(pair)] == [1, 3]
    with pytest.raises(TypeError, match="returning_views"):
        compiled(lambda pair: (pair[0], 2))(pair)
    with pytest.raises(TypeError, match="turned"):
        numba.njit(lambda pair: turned(pair)[0][1])(pair)
    with pytest.raises(numba.core.errors.NumbaError, match="NRT"):
        compiled(lambda pair: pair[0].copy().sum())(pair)


def test_every_source_and_its_place_count(tmp_path):
    package = tmp_path / "mbn_marl"
    shutil.copytree(Path(mbn_marl.__file__).parent, package)
    digests = [digest_of_sources(package)]
    assert digests == [SOURCES]
    for name in ("engine/step.py", "engine/mdp/rewards.py", "jit/functions.py", "config.py"):
        path = package / name
        path.write_text(path.read_text(encoding="utf-8") + "\n", encoding="utf-8")
        digests.append(digest_of_sources(package))
    (package / "engine/mdp/rewards.py").rename(package / "engine/rewards.py")
    digests.append(digest_of_sources(package))
    assert len(set(digests)) == 6


def test_code_without_a_module_is_compiled_beside_the_engine():
    names = {}
    exec("def double(x):\n    return 2 * x\n", names)
    assert numba.njit(names["double"])(2) == 4


class Settings(NamedTuple):
    """A constant whose value is part of its type, and one whose value is not."""

    kind: Any
    weight: Any


def test_branches_of_settled_constants_are_not_compiled():
    @compiled
    def twice(x):
        return 2 * x

    @compiled
    def worth(settings, x):
        if settings.kind == 1:
            return twice(x)
        return x + settings.weight

    values = types.NamedTuple([types.literal(0), types.float64], Settings)
    worth.compile((values, types.float64))
    assert not twice.overloads
    assert worth(Settings(1, 0.5), 2.0) == 4.0 and worth(Settings(0, 0.5), 2.0) == 2.5


def test_numbas_own_compiler_takes_over_where_ours_fails(monkeypatch, caplog):
    monkeypatch.delenv(compile.PLAIN, raising=False)
    monkeypatch.setattr(compile, "PROVEN", ())
    assert compile.compiler_of_rules() is inlining.PartCompiler
    monkeypatch.setattr(inlining, "PASSES", inlining.PASSES[:3])  # as if Numba had moved the others
    assert compile.compiler_of_rules() is Compiler
    assert f"Numba {numba.__version__}" in caplog.text
    compile._prove(Compiler)
    monkeypatch.setattr(compile, "PROVEN", (numba.__version__,))
    monkeypatch.setenv(compile.PLAIN, "1")
    assert compile.compiler_of_rules() is Compiler
