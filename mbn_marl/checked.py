"""Models whose errors list all problems, and numbers that an episode draws."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from mbn_marl.errors import ConfigError, unknown

_SHORT = reprlib.Repr()
"""Shows values in messages: long ones without their middle."""
_SHORT.maxstring = _SHORT.maxother = 80


def _number(value: object) -> object:
    if isinstance(value, bool | np.bool_ | str | bytes):
        raise ValueError("Input should be a number")
    return value


def _flag(value: object) -> object:
    if not isinstance(value, bool | np.bool_):
        raise ValueError("Input should be True or False")
    return value


NOT_A_WORD = BeforeValidator(_number)
RealNumber = Annotated[float, NOT_A_WORD]
WholeNumber = Annotated[int, NOT_A_WORD]
Flag = Annotated[bool, BeforeValidator(_flag)]
"""Types that a word, or a truth value in place of a number, is not converted to."""
_ONE, _EACH, _DRAWN = "for all", "for each", "(drawn)"
"""Marks of a setting's forms: one value, one for each robot, a range; not in messages."""


class Checked(BaseModel):
    """A model whose constructor lists all problems of its arguments as one error.

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    if not TYPE_CHECKING:  # type checkers know the arguments from the fields

        def __init__(self, **values: Any) -> None:
            try:
                super().__init__(**values)
            except ValidationError as error:
                raise ConfigError(self._source(), describe(error, type(self))) from None

    @classmethod
    def _source(cls) -> str:
        return cls.__name__


class Uniform(Checked):
    """A range from which each episode draws a number (mdp.md, "Drawn numbers").

    Attributes:
        low: the lower end, in the unit of the setting.
        high: the upper end, in the unit of the setting, at least ``low``.

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.
    """

    low: Annotated[RealNumber, Field(allow_inf_nan=False)]
    high: Annotated[RealNumber, Field(allow_inf_nan=False)]

    def __init__(self, low: Any = None, high: Any = None, **others: Any) -> None:
        super().__init__(**{"low": low, "high": high, **others})

    @field_validator("high")
    @classmethod
    def _in_order(cls, high: float, info: ValidationInfo) -> float:
        if high < info.data.get("low", high):
            raise ValueError(f"Input should be greater than or equal to low, {info.data['low']}")
        return high


def _number_form(value: object) -> str:
    return _DRAWN if isinstance(value, Uniform | Mapping) else _ONE


def _team_form(value: object) -> str:
    return _EACH if isinstance(value, tuple | list) else _ONE


def or_drawn(kind: Any) -> Any:
    """The type of a number of a ``kind``, or of a :class:`Uniform` whose two ends are."""
    ends = TypeAdapter(kind)

    def check_ends(drawn: Uniform) -> Uniform:
        for name in ("low", "high"):
            try:
                ends.validate_python(getattr(drawn, name))
            except ValidationError as error:
                raise ValueError(f"{name}: {error.errors()[0]['msg']}") from None
        return drawn

    drawn = Annotated[Uniform, AfterValidator(check_ends), Tag(_DRAWN)]
    return Annotated[Annotated[kind, Tag(_ONE)] | drawn, Discriminator(_number_form)]


def or_each(kind: Any, most: int, one: Any = None) -> Any:
    """The type of one value of a ``kind`` for all robots, or a tuple with one for each.

    ``most`` is the highest number of robots, ``one`` the type of the value for all if it differs.
    """
    several = Annotated[tuple[kind, ...], Field(min_length=1, max_length=most), Tag(_EACH)]
    return Annotated[Annotated[one or kind, Tag(_ONE)] | several, Discriminator(_team_form)]


def describe(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """One line for each problem that pydantic found: the place, what is wrong, what is allowed.

    Args:
        error: raised by pydantic.
        model: the model to be made; its fields, and those of the models in it, are the known names.
    """
    lines = []
    for problem in error.errors():
        path = [part for part in problem["loc"] if part not in (_ONE, _EACH, _DRAWN)]
        place = ".".join(map(str, path)) or model.__name__
        cause = problem.get("ctx", {}).get("error")
        if isinstance(cause, ConfigError):  # of a part that is a model
            lines += [f"{place}.{line}" for line in cause.problems]
            continue
        if (
            problem["type"] == "too_short"
            and len(problem["input"]) > problem["ctx"]["actual_length"]
        ):
            continue  # an entry has a line of its own
        if problem["type"] == "extra_forbidden":
            *path, name = problem["loc"]
            known = _level(model, path).model_fields.items()  # without repr: not to be set by hand
            message = unknown("name", str(name), [name for name, field in known if field.repr])
        elif problem["type"] == "literal_error":
            choices = re.findall(r"'(.*?)'", problem["ctx"]["expected"])
            shown = _shown(problem["input"])
            message = f"{shown}: " + unknown("choice", shown.strip("'"), choices)
        else:
            message = problem["msg"].removeprefix("Value error, ")
            if problem["type"] != "missing":  # else the input is all that is around it
                message += f" (got {_shown(problem['input'])})"
        lines.append(f"{place}: {message}")
    return lines


def _shown(value: object) -> str:
    try:
        return _SHORT.repr(value)
    except ValueError:  # a whole number of more digits than Python shows
        return type(value).__name__


def _level(model: type[BaseModel], path: Sequence[int | str]) -> type[BaseModel]:
    """Return the model that the value at ``path`` inside ``model`` is validated as."""
    for name in path:
        field = model.model_fields.get(str(name))
        if field is not None and isinstance(field.annotation, type):
            model = field.annotation if issubclass(field.annotation, BaseModel) else model
    return model
