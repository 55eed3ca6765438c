"""The check of the docstrings: a public name says its shapes, units, errors and source.

The rules are those of CONTRIBUTING.md, "Docstrings". A name is public if a module of
:data:`MODULES` offers it, and a method or property if its class defines it without an underscore.
Building the site reports each problem as a warning, which ``make docs`` turns into an error.
"""

from __future__ import annotations

import builtins
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from docstring_parser import Docstring, parse
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util import logging

from docs.extensions.raised import is_subclass, raised_by
from mbn_marl import errors

MODULES = (
    "baselines",
    "mbn_marl",
    "mbn_marl.adapters.gymnasium",
    "mbn_marl.adapters.infos",
    "mbn_marl.adapters.pettingzoo",
    "mbn_marl.adapters.sb3",
    "mbn_marl.adapters.torchrl",
    "mbn_marl.config",
    "mbn_marl.engine",
    "mbn_marl.episode",
    "mbn_marl.errors",
    "mbn_marl.field",
    "mbn_marl.optimum",
    "mbn_marl.planning",
    "mbn_marl.registration",
    "mbn_marl.sim3d",
)
"""The modules that users import from."""

SHAPE = re.compile(r"\([\w.*+ -]{1,25},(?:[\w.*+ -]{1,25},?)*\)")
"""Such as ``(W, n, 2)``, ``(4n + 1,)``, ``(num_envs, *action_space.shape)``."""

UNIT = re.compile(
    r"\b(units?|steps?|degrees|radians|seconds|mass|rewards?|flags?|bool|uint8)\b"
    r"|\[-?[\d.]+, [\w^. -]+[\])]|[<>]=? ?\d"
)
"""A unit, or a range such as ``[-1, 1]`` or ``> 0``."""

PAPER = re.compile(r"\bpaper\b|\b(?:r_\w+|T_max|v_a|beta_a|M_i|v_clip|rho)\b")
"""A docstring that speaks of the paper, or of one of its symbols."""

TYPE_LIKE = re.compile(r"Returns:\n.*:( |$)", re.MULTILINE)
"""A first line of ``Returns:`` with a colon, before which Sphinx expects a type."""

SAME_AS = re.compile(r"arguments(?: and errors)? (?:as|of) :class:`([\w.~]+)`")
"""A docstring that leaves its arguments to that of a class."""
ARRAY = re.compile(r"ndarray|\bTensor\b|\bArrayLike\b|\bNDArray\b")
MEASURED = re.compile(rf"{ARRAY.pattern}|\bfloat\b")

STARS: Mapping[Any, str] = {
    inspect.Parameter.VAR_POSITIONAL: "*",
    inspect.Parameter.VAR_KEYWORD: "**",
}

RULED_OUT: Mapping[str, set[str]] = {
    "mbn_marl.episode.play": {"FieldError"},
    "mbn_marl.episode.check_episode": {"FieldError"},
    "mbn_marl.episode.EpisodeRecorder.episodes": {"FieldError", "ConfigError"},
    "mbn_marl.sim3d.deploy": {"FieldError"},
}
"""Errors of functions that these call, but not with what these hand them: a ``Field`` is valid."""

Function = Callable[..., Any]


@dataclass(frozen=True)
class Public:
    """A public name.

    Attributes:
        name: with its module and class.
        value: what it stands for: a class, a function, or the function of a property.
        owner: the class that it is a method or property of, if any.
    """

    name: str
    value: Any
    owner: type | None = None

    @property
    def text(self) -> str:
        """The docstring."""
        return inspect.getdoc(self.value) or ""

    @property
    def function(self) -> Function:
        """The callable: the function, or the class's ``__init__``."""
        return self.value.__init__ if inspect.isclass(self.value) else self.value


def public_names() -> list[Public]:
    """Every public class, function, method and property, each once."""
    found: dict[int, Public] = {}
    for module_name in MODULES:
        module = import_module(module_name)
        for name in getattr(module, "__all__", None) or _own_names(module):
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                found.setdefault(id(value), Public(f"{module_name}.{name}", value))
    members = [member for public in found.values() for member in _members(public)]
    return [*found.values(), *members]


def _own_names(module: Any) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__
    ]


def _members(public: Public) -> Iterator[Public]:
    if not inspect.isclass(public.value):
        return
    for name, value in vars(public.value).items():
        function = value.fget if isinstance(value, property) else value
        if not name.startswith("_") and inspect.isfunction(function):
            yield Public(f"{public.name}.{name}", function, public.value)


def find_problems(public: Public) -> list[str]:
    """Return what the docstring of a public name lacks, one line each."""
    if not public.text:
        return ["has no docstring"]
    document = parse(public.text)
    return [
        *_argument_problems(public, document),
        *_return_problems(public, document),
        *_error_problems(public, document),
        *_source_problems(public),
    ]


def _argument_problems(public: Public, document: Docstring) -> Iterator[str]:
    """Every argument is described, no other is; arrays with shape and unit, numbers with unit."""
    if _refers_to_another(public):
        return
    wanted = _arguments(public)
    described = {name: public.text for name in wanted if f"``{name}``" in public.text}
    for one in reversed(document.params):  # arguments come before attributes of the same name
        described[one.arg_name] = one.description or ""
    for name, annotation in wanted.items():
        if name not in described:
            yield f"argument {name}: not described"
        elif _is(ARRAY, annotation, public) and not SHAPE.search(described[name]):
            yield f"argument {name}: an array without a shape"
        elif _is(MEASURED, annotation, public) and not UNIT.search(described[name]):
            yield f"argument {name}: without unit or range"
    arguments = {one.arg_name for one in document.params if one.args[0] == "param"}
    for name in sorted(arguments - set(wanted)):
        yield f"argument {name}: there is none of this name"


def _arguments(public: Public) -> dict[str, str]:
    """The arguments by name, with their annotations as they are written."""
    if is_subclass(public.value, BaseModel):
        return {name: str(field.annotation) for name, field in public.value.model_fields.items()}
    if inspect.isclass(public.value) and "__init__" not in vars(public.value):
        annotations = vars(public.value).get("__annotations__", {})
        return {
            name: str(getattr(one, "__forward_arg__", one)) for name, one in annotations.items()
        }
    parameters = list(inspect.signature(public.function).parameters.values())
    if inspect.isclass(public.value) or public.owner is not None:
        parameters = parameters[1:]
    return {STARS.get(one.kind, "") + one.name: str(one.annotation) for one in parameters}


def _return_problems(public: Public, document: Docstring) -> Iterator[str]:
    """Check that returned values are described; arrays with shape and unit."""
    if inspect.isclass(public.value) or _refers_to_another(public):
        return
    if TYPE_LIKE.search(public.text):
        yield "returns: what precedes a colon on the first line reads as a type"
    annotation = str(inspect.signature(public.value).return_annotation)
    if _is(ARRAY, annotation, public):
        place = document.returns.description if document.returns else public.text
        if not SHAPE.search(place or ""):
            yield "returns: an array without a shape"
        if not UNIT.search(public.text):
            yield "returns: an array without unit or range"


def _is(kind: re.Pattern[str], annotation: str, public: Public) -> bool:
    """Return whether the annotation, or an alias that it uses, is of a kind."""
    names = re.findall(r"\w+", annotation)
    known = vars(inspect.getmodule(public.value))
    used = [known[name] for name in names if name in known]
    aliases = [repr(value) for value in used if not inspect.isclass(value)]
    return any(kind.search(text) for text in [annotation, *aliases])


def _error_problems(public: Public, document: Docstring) -> Iterator[str]:
    """Every error of the suite that the code is seen to raise is listed; what is listed exists."""
    listed = {name.strip() for one in document.raises for name in (one.type_name or "").split(",")}
    known = {**vars(builtins), **vars(errors), **vars(inspect.getmodule(public.value))}
    for name in sorted(listed):
        if not is_subclass(known.get(name), Exception):
            yield f"raises {name}: there is no such error"
    if _refers_to_another(public):
        return
    raised = {error.__name__ for error in raised_by(public.function, public.owner or public.value)}
    for name in sorted(raised - RULED_OUT.get(public.name, set())):
        if name not in listed:
            yield f"raises {name}: not listed"


def _refers_to_another(public: Public) -> bool:
    return SAME_AS.search(public.text) is not None


def _source_problems(public: Public) -> Iterator[str]:
    """Check that text about the paper says where in it, here or in the class's docstring."""
    texts = [public.text, inspect.getdoc(public.owner) or ""]
    if PAPER.search(public.text) and not any("\nSource:" in text for text in texts):
        yield "source: speaks of the paper without a section 'Source:'"


def all_problems() -> Mapping[str, list[str]]:
    """The problems of every public name that has some."""
    found = {public.name: find_problems(public) for public in public_names()}
    return {name: problems for name, problems in found.items() if problems}


def _report(app: Sphinx) -> None:
    logger = logging.getLogger(__name__)
    for name, problems in all_problems().items():
        for problem in problems:
            logger.warning("docstring of %s: %s", name, problem)


def setup(app: Sphinx) -> dict[str, bool]:
    """Check the docstrings when the build begins."""
    app.connect("builder-inited", _report)
    return {"parallel_read_safe": True}
