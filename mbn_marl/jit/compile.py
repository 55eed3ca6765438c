"""Compile functions, and keep their machine code on disk."""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler import Compiler, CompilerBase
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import ConfigStack

from mbn_marl.errors import MbnError

if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
    raise MbnError("NUMBA_DISABLE_JIT: set; allowed: unset, since the engine runs only compiled")

LOG = logging.getLogger("mbn_marl")
# Compiled code runs without the GIL, divides as NumPy does, and is not for C to call.
COMMON: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

ANNOUNCEMENT = (
    "mbn_marl: compiling %s for these settings, once per machine: about 5 to 30 seconds of CPU. "
    "Other observations and conditions compile once each; `mbn warmup` does it ahead"
)
DAMAGED = "mbn_marl: %s is damaged, so its code is compiled again: %s"
NOT_USED = "mbn_marl: NUMBA_CACHE_DIR=%s cannot be written, so compiled code in it is not used"
NOT_KEPT = "mbn_marl: %s cannot be written, so compiled code is not kept: %s"
# The environment variable that turns ``PartCompiler`` off, if it is set.
PLAIN = "MBN_PLAIN_JIT"
# The versions of Numba that the engine was run with; others are tried first.
PROVEN = ("0.61.", "0.68.")
# The files, and the folders, that compiled functions and the numbers in them come from.
SOURCES_OF = ("config.py", "jit", "engine", "field")


def digest_of_sources(package: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        place = path.relative_to(package)
        if place.parts[0] in SOURCES_OF:
            digest.update(place.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


SOURCES = digest_of_sources(Path(__file__).parents[1])


class _Announcer(event.Listener):
    # It warns once in a process. Meanwhile nothing collects garbage, which would take a tenth of
    # the time and find none.
    announced, depth, collects = False, 0, True

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        if _is_ours(function):
            if not self.announced:
                LOG.warning(ANNOUNCEMENT, function.__name__)
                self.announced = True
            if self.depth == 0:
                self.collects = gc.isenabled()
                gc.disable()
            self.depth += 1

    def on_end(self, event: Any) -> None:
        if _is_ours(event.data["dispatcher"].py_func):
            self.depth -= 1
            if self.depth == 0 and self.collects:
                gc.enable()


def _is_ours(function: Any) -> bool:
    return (function.__module__ or "").startswith("mbn_marl.")  # code of ``exec`` has none


event.register("numba:compile", _Announcer())  # type: ignore[no-untyped-call]


class Rule(CPUDispatcher):
    """A compiled function that becomes part of the compiled functions that call it."""

    # It has no machine code and no wrappers, which take Numba longer than all the rest. A call from
    # Python, by a test or a curious reader, compiles the function alone.
    returns_views = False

    def get_call_template(self, arguments: Any, keywords: Any) -> Any:
        """Refuse to give a caller that counts references arrays whose references do not count."""
        template = super().get_call_template(arguments, keywords)
        models = self.targetctx.data_model_manager
        caller: Any = ConfigStack.top_or_none()  # type: ignore[no-untyped-call]
        for result in self.overloads.values():
            kind = result.signature.return_type  # type: ignore[attr-defined]
            if caller.nrt and models[kind].contains_nrt_meminfo():
                problem = f"{self.py_func.__name__} returns {kind}"
                raise TypeError(f"{problem}; allowed where an entry point calls it: numbers")
        return template

    def __call__(self, *arguments: Any) -> Any:
        result = self.alone(*arguments)
        parts = result if isinstance(result, tuple) else (result,)
        if not self.returns_views and any(isinstance(part, np.ndarray) for part in parts):
            raise TypeError(f"{self.py_func.__name__} returns arrays; allowed: returning_views")
        return result

    @cached_property
    def alone(self) -> Any:
        return _cached(self.py_func, _nrt=self.returns_views)


def compiler_of_rules() -> type[CompilerBase]:
    """Return ``PartCompiler``, or Numba's own where that fails: slower, with the same bits."""
    if PLAIN in os.environ:
        return Compiler
    try:
        from mbn_marl.jit.inlining import PartCompiler

        if not numba.__version__.startswith(PROVEN):
            _prove(PartCompiler)
    except Exception as error:  # whatever has moved in Numba
        warning = "Numba %s: %s; rules are compiled by its usual compiler, which takes longer"
        LOG.warning(warning, numba.__version__, repr(error))
        return Compiler
    return PartCompiler


def _prove(compiler: type[CompilerBase]) -> None:
    rule = _rule(lambda pair, k: pair[0][k] + pair[1], compiler)
    result = numba.njit(lambda pair: rule(pair, 1))((np.arange(3.0), 2.0))
    if result != 3.0:
        raise ArithmeticError(f"1.0 + 2.0 is {result}")


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function as a part of its callers; it neither makes nor counts arrays."""
    return _rule(function, COMPILER)


def _rule(function: Callable[..., Any], compiler: type[CompilerBase]) -> Rule:
    inlined = {"nopython": True, "forceinline": True, "no_cpython_wrapper": True, "_nrt": False}
    return Rule(function, targetoptions={**COMMON, **inlined}, pipeline_class=compiler)


COMPILER = compiler_of_rules()


def returning_views(function: Callable[..., Any]) -> Any:
    """Compile a rule that returns arrays it was given, or parts of them, for other rules."""
    rule = compiled(function)
    rule.returns_views = True
    return rule


def generated(name: str, source: str, as_rule: Callable[..., Any] = compiled, **names: Any) -> Any:
    module = {"__name__": __name__, **names}
    exec(source, module)
    return as_rule(module[name])


def entry_point(function: Callable[..., Any]) -> Any:
    """Compile what Python calls: a function that only calls a rule, which compiles faster."""
    code, name = function.__code__, function.__name__
    names = ", ".join(code.co_varnames[: code.co_argcount])
    # The line is that of the rule: by file, name and line Numba finds machine code that it kept.
    source = "\n" * (code.co_firstlineno - 1) + f"def {name}({names}): return rule({names})"
    module = {"__name__": function.__module__, "rule": compiled(function)}
    exec(compile(source, code.co_filename, "exec"), module)
    return _cached(module[name], _nrt=False)


def entry_point_of_one_file(function: Callable[..., Any]) -> Any:
    """Compile what Python calls and what calls nothing of another file."""
    return _kept(numba.njit(function))


def parallel_entry_point(function: Callable[..., Any]) -> Any:
    """Compile what Python calls and what spreads its ``prange`` loops over Numba's threads."""
    return _cached(function, parallel=True)


def address_of(function: Any, *arguments: Any) -> int:
    kinds = tuple(map(numba.typeof, arguments))
    function.compile(kinds)
    result = function.overloads[kinds]
    address: int = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
    return address


class CodeFiles(IndexDataCacheFile):
    """Numba's files of a function's machine code, of which damaged ones count as missing."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]
        except Exception as error:  # whatever a pickle raises that was cut off
            _warn(DAMAGED, self._index_path, repr(error))
            return {}

    def _save_data(self, name: str, data: Any) -> None:
        code = self._dump(data)  # type: ignore[no-untyped-call]
        super()._save_data(name, (_digest(code), code))  # type: ignore[no-untyped-call]

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)  # type: ignore[no-untyped-call]
        try:
            digest, code = super()._load_data(name)  # type: ignore[no-untyped-call]
            if digest != _digest(code):  # nothing else would find a changed instruction
                raise ValueError("it has another checksum")
            return pickle.loads(code)
        except FileNotFoundError:
            raise
        except Exception as error:
            _warn(DAMAGED, path, repr(error))
            raise FileNotFoundError(path) from error


class CodeCache(FunctionCache):
    """Numba's cache of a function; a program runs without it where it cannot be written."""

    # Code is renewed when its ``stamp`` changes; without one, when the function's file does.
    def __init__(self, function: Callable[..., Any], stamp: Any = None) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        ours, theirs = stamp, self._cache_file._source_stamp
        self._cache_file = CodeFiles(self._cache_path, self._impl.filename_base, ours or theirs)  # type: ignore[no-untyped-call]

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            _warn(NOT_KEPT, self._cache_path, error.strerror)


@cache  # once about a file or a folder
def _warn(message: str, *parts: str | None) -> None:
    LOG.warning(message, *parts)


def _digest(code: bytes) -> bytes:
    return hashlib.sha256(code).digest()


def _kept(dispatcher: Any, stamp: Any = None) -> Any:
    """Let a dispatcher keep its code on disk, if a folder can be written."""
    asked, found = numba.config.CACHE_DIR, ""  # type: ignore[attr-defined]
    with suppress(RuntimeError):  # there is none
        dispatcher._cache = CodeCache(dispatcher.py_func, stamp)
        found = dispatcher._cache.cache_path
    if asked and not found.startswith(asked):
        _warn(NOT_USED, asked)
    return dispatcher


def _cached(function: Callable[..., Any], **options: Any) -> Any:
    # Numba renews a cached function when its own file changes. A rule is compiled into every
    # function that calls it, in any file, so the stamp is of all sources instead.
    dispatcher = numba.njit(**COMMON, **options)(function)
    return _kept(dispatcher, (SOURCES, COMPILER.__name__))
