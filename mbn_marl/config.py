"""The settings of the MDP, validated: one table of every number and rule."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from inspect import signature
from itertools import cycle, islice
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetPydanticSchema,
    Tag,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic_core import core_schema

from mbn_marl.errors import ConfigError, unknown

MAX_ROBOTS = 64
MAX_ROIS = 24  # with more, the visit code would be inexact in float32
# The range of what must be above 0: in float32 squares and quotients are finite, above 0 too.
LEAST, MOST = 1e-12, 1e12
# Marks of a setting's forms: one value, one for each robot, a range; not in messages.
_ONE, _EACH, _DRAWN = "for all", "for each", "(drawn)"
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80


def _number(value: object) -> object:
    if isinstance(value, bool | np.bool_ | str | bytes):
        raise ValueError("Input should be a number")
    if isinstance(value, float | np.floating) and math.isnan(value):  # or a bound is named
        raise ValueError("Input should be a number, not NaN")
    return value


def _flag(value: object) -> object:
    if not isinstance(value, bool | np.bool_):
        raise ValueError("Input should be True or False")
    return value


class Checked(BaseModel):
    """A model whose constructor lists all problems of its arguments as one error.

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True
    )

    if not TYPE_CHECKING:  # type checkers know the arguments from the fields

        def __init__(self, /, **values: Any) -> None:
            try:
                super().__init__(**values)
            except ValidationError as error:
                raise ConfigError(self._source(), describe(error, type(self))) from None

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        # A constructor has no place for keys that are not words: Python's error would name none.
        return core_schema.no_info_before_validator_function(cls._check_keys, handler(source))

    @classmethod
    def _check_keys(cls, value: object) -> object:
        if isinstance(value, Mapping) and not all(isinstance(key, str) for key in value):
            raise ValueError(f"Input should have keys of {', '.join(cls.model_fields)}")
        return value

    @classmethod
    def _source(cls) -> str:
        return cls.__name__


# Words, and truth values in place of numbers, are not converted to these types.
NOT_A_WORD = BeforeValidator(_number)
RealNumber = Annotated[float, NOT_A_WORD]
WholeNumber = Annotated[int, NOT_A_WORD]
Flag = Annotated[bool, BeforeValidator(_flag)]
Finite = Annotated[RealNumber, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
Positive = Annotated[RealNumber, Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
NonNegative = Annotated[RealNumber, Field(ge=0.0, le=MOST, allow_inf_nan=False)]
Probability = Annotated[RealNumber, Field(ge=0.0, le=1.0)]
Turn = Annotated[RealNumber, Field(ge=LEAST, le=math.pi)]
Steering = Annotated[RealNumber, Field(ge=LEAST, le=1.5)]
RobotIndex = Annotated[int, Field(ge=0, lt=MAX_ROBOTS)]
StepNumber = Annotated[WholeNumber, Field(ge=1, le=1_000_000)]


class Uniform(Checked):
    """A range from which each episode draws a number (conditions.md, "Drawn numbers")."""

    low: Annotated[RealNumber, Field(allow_inf_nan=False)]
    """The lower end, in the unit of the setting."""
    high: Annotated[RealNumber, Field(allow_inf_nan=False)]
    """The upper end, in the unit of the setting, at least ``low``."""

    def __init__(self, /, low: Any = None, high: Any = None, **others: Any) -> None:
        super().__init__(**{"low": low, "high": high, **others})

    @field_validator("high")
    @classmethod
    def _in_order(cls, high: float, info: ValidationInfo) -> float:
        if high < info.data.get("low", high):
            raise ValueError(f"Input should be greater than or equal to low, {info.data['low']}")
        return high


def _in_order(parts: str) -> BeforeValidator:
    """Refuse what is no list, a set too, and say which ``parts`` it should have."""

    def check(value: object) -> object:
        if not isinstance(value, list | tuple):
            raise ValueError(f"Input should be {parts}")
        return value

    return BeforeValidator(check)


def _ordered(ends: tuple[int, int]) -> tuple[int, int]:
    if ends[0] > ends[1]:
        raise ValueError("the first must not be above the last")
    return ends


def _or_other(one: Any, other: Any, mark: str, kinds: tuple[type, ...]) -> GetPydanticSchema:
    """Have a value validated as ``other`` if it is of these kinds, else as ``one``."""
    form = Discriminator(lambda value: mark if isinstance(value, kinds) else _ONE)
    both = Annotated[Annotated[one, Tag(_ONE)] | Annotated[other, Tag(mark)], form]
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(both))


def or_drawn(kind: Any) -> GetPydanticSchema:
    """Allow a :class:`Uniform` with ends of a ``kind`` in place of a number of that kind.

    Type checkers see the number: an episode's configuration has what was drawn in its place.
    """
    ends = TypeAdapter(kind)

    def check_ends(drawn: Uniform) -> Uniform:
        for name in ("low", "high"):
            try:
                ends.validate_python(getattr(drawn, name))
            except ValidationError as error:
                raise ValueError(f"{name}: {error.errors()[0]['msg']}") from None
        return drawn

    drawn = Annotated[Uniform, AfterValidator(check_ends)]
    return _or_other(kind, drawn, _DRAWN, (Uniform, Mapping))


def or_each(kind: Any, one: Any = None) -> GetPydanticSchema:
    """Allow a tuple with one value of a ``kind`` per robot in place of one for all robots.

    ``one`` is the type of the value for all if it differs.
    """
    each = Annotated[tuple[kind, ...], Field(min_length=1, max_length=MAX_ROBOTS)]
    return _or_other(one or kind, each, _EACH, (tuple, list))


AnyNumber = Annotated[float, or_drawn(Finite)]
AnyPositive = Annotated[float, or_drawn(Positive)]
AnyNonNegative = Annotated[float, or_drawn(NonNegative)]
AnyProbability = Annotated[float, or_drawn(Probability)]
AnyTurn = Annotated[float, or_drawn(Turn)]
AnySteering = Annotated[float, or_drawn(Steering)]
PositiveOfEach = Annotated[float | tuple[float, ...], or_each(AnyPositive)]
# Infinity becomes a number that files of any kind can have.
Reach = Annotated[RealNumber, Field(ge=0.0), AfterValidator(lambda radius: min(radius, MOST))]
_Ends = _in_order("(first step, last step)"), AfterValidator(_ordered)
_Steps = Annotated[tuple[StepNumber, StepNumber], *_Ends]
_Few = Annotated[WholeNumber, Field(ge=0, lt=MAX_ROIS)]
_Range = Annotated[tuple[_Few, _Few], AfterValidator(_ordered)]
_None = AfterValidator(lambda count: 0 if count == (0, 0) else count)
FewOrRange = Annotated[int | tuple[int, int], _or_other(_Few, _Range, _DRAWN, (tuple, list)), _None]
# A number, or the range that each episode draws it from.
Number = float | Uniform

Dynamics = Literal["point_mass", "holonomic", "unicycle", "bicycle"]
TeamDynamics = Literal[Dynamics, "mixed"]
DynamicsOfEach = Annotated[TeamDynamics | tuple[Dynamics, ...], or_each(Dynamics, TeamDynamics)]
# The dynamics of a ``"mixed"`` team's robots, in turn.
MIXED: tuple[Dynamics, ...] = ("point_mass", "unicycle", "bicycle")
Observation = Literal["relative", "state", "local", "lidar", "lidar_local", "entities"]
# Observations that do not depend on the sensing radius.
WITHOUT_RADIUS = ("relative", "state")
# Observations that can show what a robot knows itself, and not only what the team knows.
OF_OWN = ("local", "lidar_local", "entities")
# Settings of what robots know, which change nothing in what they can do.
KNOWLEDGE = ("knowledge", "comm_radius", "look_radius", "hidden_rois", "comm_delay", "comm_loss")
DECOYS = ("decoys", "empty_rois")


class RewardProfile(Checked):
    """A named set of reward rules and weights, in reward units (mdp.md, "Reward profiles")."""

    name: str
    rules: Literal["released", "formal"] = "released"
    """``"released"`` (the authors' released code) or ``"formal"`` (the paper's section 3)."""
    small: NonNegative = 10.0
    """r_s, the charge of a step on new ground, >= 0."""
    medium: NonNegative = 100.0
    """r_m, the charge of a step on known ground, >= 0."""
    large: NonNegative = 10_000.0
    """r_l, for a visited ROI, and against leaving the field, >= 0."""
    infinite: NonNegative = 100_000.0
    """r_inf, finite in place of infinity: success and collision, >= 0."""


REWARD_PROFILES: Mapping[str, RewardProfile] = {
    "released": RewardProfile(name="released"),
    "formal": RewardProfile(name="formal", rules="formal"),
}


class Failures(Checked):
    """Failures of robots during an episode (failures.md)."""

    rate: AnyProbability = 0.0
    """The probability that a robot fails in a step, in [0, 1]."""
    at: dict[RobotIndex, StepNumber] = Field(default_factory=dict)
    """The step, from 1 on, in which a robot fails, by the robot's index, from 0 on."""
    between: _Steps | None = None
    """A first and a last step, between which one robot fails; each episode draws both."""
    kind: Literal["brake", "coast", "vanish"] = "brake"
    """The rule for a failed robot: ``"brake"``, ``"coast"`` or ``"vanish"``."""
    most: Annotated[WholeNumber, Field(ge=0, le=MAX_ROBOTS)] | None = None
    """The number of failed robots at which ``rate`` ends, 0 to n; ``None`` is n - 1."""


class NavigationConfig(Checked):
    """Everything about the MDP that is not the field. Symbols and numbers are the paper's."""

    n_robots: Annotated[WholeNumber, Field(ge=1, le=MAX_ROBOTS)] | None = None
    """Team size, 1 to 64; ``None`` takes as many as the field has starts."""
    reward: RewardProfile = REWARD_PROFILES["released"]
    """The name of a reward profile, or a :class:`RewardProfile`."""
    reward_sharing: Literal["individual", "team"] = "individual"
    """``"individual"``: each robot its own share of the team's reward; ``"team"``: all of it."""
    dynamics: DynamicsOfEach = "point_mass"
    """One name for all robots or one per robot (mdp.md, "Dynamics"): ``"point_mass"``,
    ``"holonomic"``, ``"unicycle"`` or ``"bicycle"``; ``"mixed"``: all but holonomic in turn."""
    observation: Observation = "relative"
    """``"relative"``, ``"state"``, ``"local"``, ``"lidar"``, ``"lidar_local"`` or ``"entities"``,
    see ``engine.mdp.observations``."""
    assignment: Literal[False, True, "fresh"] = False
    """Only with ``"entities"``: show who visits which ROI when; ``"fresh"``: as of now."""
    one_hot: Flag = False
    """Append the robot's index as a one-hot vector to its observation."""
    sensing_radius: Positive = 100.0
    """Range of ``"local"``, ``"lidar"``, ``"lidar_local"`` and the rays of ``"entities"``, units;
    with other observations nothing else than 100 is allowed."""
    knowledge: Literal["team", "own"] = "team"
    """``"team"``: robots share all they know; ``"own"``: each knows what it has seen and heard
    (mdp.md, "Knowledge"). The settings from here to ``empty_rois`` are for ``"own"`` only."""
    comm_radius: Reach = 100.0
    """Robots within this distance tell each other what they know, units, 0 to infinity."""
    look_radius: NonNegative | None = None
    """A robot sees within this distance whether an ROI is left, units; ``None`` is rho."""
    hidden_rois: Flag = False
    """An ROI is unknown until a robot is within the sensing radius."""
    comm_delay: Annotated[WholeNumber, Field(ge=0, le=100)] = 0
    """Delay of what robots tell each other, steps, 0 to 100."""
    comm_loss: Probability = 0.0
    """Probability that a robot does not hear another one in a step, in [0, 1]."""
    decoys: FewOrRange = 0
    """Number of ROIs of an episode that are empty, or the least and the most; each draws them."""
    empty_rois: tuple[_Few, ...] = ()
    """The ROIs that are empty in all episodes, from 0 on; in place of ``decoys``."""
    wind: Annotated[tuple[AnyNonNegative, AnyNumber], _in_order("(speed, angle)")] = (0.0, 0.0)
    """``(v_a, beta_a)``: units/step per step, degrees from +x; both may be drawn."""
    gust: AnyNonNegative = 0.0
    """Standard deviation of gusts along each axis, units/step per step, >= 0."""
    gust_time: AnyPositive = 10.0
    """Correlation time of the gusts, steps, > 0."""
    action_noise: AnyNonNegative = 0.0
    """Standard deviation of each number of an action, >= 0."""
    action_loss: AnyProbability = 0.0
    """Probability that the action before is repeated, in [0, 1]."""
    action_delay: Annotated[WholeNumber, Field(ge=0, le=100)] = 0
    """Delay of actions, steps, 0 to 100."""
    position_noise: AnyNonNegative = 0.0
    """Standard deviation of observed positions, units, >= 0."""
    velocity_noise: AnyNonNegative = 0.0
    """Standard deviation of observed velocities, units/step, >= 0."""
    dropout: AnyProbability = 0.0
    """Probability that a robot or ROI is not observed, in [0, 1]."""
    max_steps: StepNumber = 1000
    """T_max; reaching it truncates the episode."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the simulation, ``"float32"`` or ``"float64"``."""
    f_max: PositiveOfEach = 0.5
    """Force of a full-scale action, mass x units/step^2, > 0; one number, or one per robot."""
    v_clip: PositiveOfEach = 5.0
    """Speed limit, units/step, > 0, per axis, or along the heading of a robot that has one; one
    number, or one per robot."""
    tau: AnyPositive = 1.0
    """Time of one step, > 0."""
    mass: PositiveOfEach = 1.0
    """M_i, > 0; one number, or one per robot."""
    turn_max: AnyTurn = 0.3
    """The most that a unicycle turns, rad/step, > 0 and at most pi."""
    wheelbase: AnyPositive = 4.0
    """Distance of a bicycle's axles, units, > 0."""
    steer_max: AnySteering = 0.5
    """The most that a bicycle steers, rad, > 0 and at most 1.5."""
    safety_distance: AnyNonNegative = 10.0
    """C; robots strictly closer than this have collided, units, >= 0."""
    roi_radius: AnyNonNegative = 10.0
    """rho; an ROI within this distance of a robot is visited, units, >= 0."""
    random_starts: Flag = False
    """Start at random points, at least C apart; at the starts if none are found."""
    failures: Failures | None = None
    """Failures of robots during an episode, :class:`Failures`; ``None``: none fails."""

    @classmethod
    def _source(cls) -> str:
        return "configuration"

    @field_validator("reward", mode="before")
    @classmethod
    def _profile_by_name(cls, value: object) -> object:
        if isinstance(value, str):
            if value not in REWARD_PROFILES:
                wrong = unknown("profile", value, REWARD_PROFILES)
                raise ValueError(f"{wrong}, or a RewardProfile")
            return REWARD_PROFILES[value]
        return value

    @field_validator("assignment")
    @classmethod
    def _seen(cls, value: bool | str, info: ValidationInfo) -> bool | str:
        if value and info.data.get("observation", "entities") != "entities":
            raise ValueError("allowed with observation='entities' only")
        return value

    @field_validator("knowledge")
    @classmethod
    def _own(cls, value: str, info: ValidationInfo) -> str:
        shown = info.data.get("observation", "entities") in OF_OWN
        if value == "own" and (not shown or info.data.get("assignment")):
            raise ValueError(f"'own' is allowed with observation {', '.join(OF_OWN)}, unassigned")
        return value

    @field_validator(*KNOWLEDGE[1:], *DECOYS)
    @classmethod
    def _of_own(cls, value: Any, info: ValidationInfo) -> Any:
        default = cls.model_fields[str(info.field_name)].default
        if value != default and info.data.get("knowledge", "own") != "own":
            raise ValueError("allowed with knowledge='own' only")
        return value

    @field_validator("empty_rois")
    @classmethod
    def _some(cls, value: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
        if value and info.data.get("decoys"):
            raise ValueError("allowed without decoys only")
        return tuple(sorted(set(value)))

    @field_validator("sensing_radius")
    @classmethod
    def _sensing(cls, value: float, info: ValidationInfo) -> float:
        default = cls.model_fields["sensing_radius"].default
        if value != default and info.data.get("observation") in WITHOUT_RADIUS:
            allowed = [one for one in get_args(Observation) if one not in WITHOUT_RADIUS]
            raise ValueError(f"allowed with observation {', '.join(allowed)} only")
        return value

    def of_each(self, name: str, n: int) -> tuple[Any, ...]:
        """Return the values of the setting ``name`` for the robots of a team of ``n``."""
        value = getattr(self, name)
        if value == "mixed":
            return tuple(islice(cycle(MIXED), n))
        return value if isinstance(value, tuple) else (value,) * n

    @property
    def is_random(self) -> bool:
        """``True`` if episodes or observations depend on random numbers."""
        failures = self.failures or Failures()
        return bool(
            any(getattr(self, name) for name in RANDOM)
            or self.drawn
            or failures.rate
            or failures.between
        )

    @property
    def drawn(self) -> dict[str, Uniform]:
        """The ranges of drawn numbers by name, such as ``wind_speed`` or ``mass_0``."""
        return {name: one for name, one in self.numbers() if isinstance(one, Uniform)}

    def numbers(self) -> Iterator[tuple[str, Number]]:
        """Yield all numbers that may be drawn, by name, a robot's own last."""
        yield from zip(("wind_speed", "wind_angle"), self.wind, strict=True)
        yield from ((name, getattr(self, name)) for name in NUMBERS)
        yield "failure_rate", (self.failures or Failures()).rate
        for name in LIMITS:
            value = getattr(self, name)
            if isinstance(value, tuple):
                yield from ((f"{name}_{i}", one) for i, one in enumerate(value))
            else:
                yield name, value

    def with_drawn(self, drawn: Mapping[str, float]) -> NavigationConfig:
        """Return the configuration of an episode that has ``drawn`` these, in settings' units."""
        if not drawn:
            return self
        known = {**dict(self.numbers()), **drawn}
        update: dict[str, Any] = {name: known[name] for name in NUMBERS}
        update["wind"] = known["wind_speed"], known["wind_angle"]
        for name in LIMITS:
            own = tuple(value for key, value in known.items() if key.startswith(f"{name}_"))
            update[name] = own or known[name]
        if self.failures is not None:
            update["failures"] = self.failures.model_copy(update={"rate": known["failure_rate"]})
        return self.model_copy(update=update)

    def at_most(self) -> NavigationConfig:
        """Return it with the highest value of every drawn number."""
        return self.with_drawn({name: ends.high for name, ends in self.drawn.items()})

    @property
    def decoy_range(self) -> tuple[int, int]:
        """The least and the greatest number of an episode's empty ROIs."""
        return self.decoys if isinstance(self.decoys, tuple) else (self.decoys, self.decoys)

    @property
    def top_speed(self) -> float:
        """The highest speed limit of a robot, units/step."""
        limits: tuple[float, ...] = self.at_most().of_each("v_clip", 1)
        return max(limits)

    def wind_increment(self) -> tuple[float, float]:
        """The velocity that the wind adds in one step, ``(x, y)`` in units/step."""
        speed, angle = self.wind
        return speed * math.cos(math.radians(angle)), speed * math.sin(math.radians(angle))


# Settings that are one number, which may be drawn.
NUMBERS = tuple(
    name
    for name, field in NavigationConfig.model_fields.items()
    if field.annotation is float and any(isinstance(m, GetPydanticSchema) for m in field.metadata)
)
# Settings that are a number of each robot, which may be drawn.
LIMITS = ("mass", "f_max", "v_clip")
# Settings that make episodes random unless they are off.
RANDOM = (
    *("random_starts", "gust", "action_noise", "action_loss"),
    *("position_noise", "velocity_noise", "dropout", "comm_loss", "decoys"),
)

Condition = Literal["calm", "windy", "gusty", "noisy", "delayed", "failing", "mixed", "storm"]
_NOISY = {"position_noise": 1.0, "velocity_noise": 0.1, "action_noise": 0.05}
_DELAYED = {"action_delay": 2, "action_loss": 0.1}
_FAILING = {"failures": Failures(between=(5, 60), kind="brake")}
CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    "calm": {},
    "windy": {"wind": (Uniform(0.1, 0.35), Uniform(0.0, 360.0))},
    "gusty": {"gust": 0.15, "gust_time": 10.0},
    "noisy": _NOISY,
    "delayed": _DELAYED,
    "failing": _FAILING,
    "mixed": {"dynamics": "mixed", "turn_max": 0.3, "wheelbase": 4.0, "steer_max": 0.5},
    "storm": {
        "wind": (Uniform(0.1, 0.25), Uniform(0.0, 360.0)),
        **{"gust": 0.08, "gust_time": 10.0},
        **_NOISY,
        **_DELAYED,
        **_FAILING,
    },
}
"""The settings of each named condition (conditions.md)."""


class FixedSettings(TypedDict, total=False):
    """The arguments of :class:`NavigationConfig` without the team size, with ``condition``.

    Keyword arguments can only be typed by such a class, so it lists them again.
    """

    condition: Condition
    reward: str | RewardProfile
    reward_sharing: Literal["individual", "team"]
    dynamics: TeamDynamics | tuple[Dynamics, ...]
    observation: Observation
    assignment: Literal[False, True, "fresh"]
    one_hot: bool
    sensing_radius: float
    knowledge: Literal["team", "own"]
    comm_radius: float
    look_radius: float | None
    hidden_rois: bool
    comm_delay: int
    comm_loss: float
    decoys: int | tuple[int, int]
    empty_rois: tuple[int, ...]
    wind: tuple[Number, Number]
    gust: Number
    gust_time: Number
    action_noise: Number
    action_loss: Number
    action_delay: int
    position_noise: Number
    velocity_noise: Number
    dropout: Number
    max_steps: int
    dtype: Literal["float32", "float64"]
    f_max: Number | tuple[Number, ...]
    v_clip: Number | tuple[Number, ...]
    tau: Number
    mass: Number | tuple[Number, ...]
    turn_max: Number
    wheelbase: Number
    steer_max: Number
    safety_distance: Number
    roi_radius: Number
    random_starts: bool
    failures: Failures | None


class Settings(FixedSettings, total=False):
    """The arguments of :class:`NavigationConfig`, and ``condition``."""

    n_robots: int | None


def expand(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``settings`` with those of their ``condition``, if they name one, in its place.

    Raises:
        ConfigError: there is no such condition, or it sets what is given too.
    """
    values = dict(settings)
    name = values.pop("condition", "calm")
    if not isinstance(name, str) or name not in CONDITIONS:
        problems = [f"condition: {unknown('condition', str(name), CONDITIONS)}"]
        raise ConfigError("configuration", problems)
    if both := sorted(CONDITIONS[name].keys() & values.keys()):
        why = f"is set by condition {name!r}; allowed: one of the two"
        raise ConfigError("configuration", [f"{one}: {why}" for one in both])
    return {**values, **CONDITIONS[name]}


def make_config(settings: Mapping[str, Any], form: object = None) -> NavigationConfig:
    """Validate the arguments of :class:`NavigationConfig`, or a ``condition`` in place of some.

    The error on an unknown setting names the arguments of ``form``'s constructor too.

    Raises:
        ConfigError: naming every unknown or invalid setting and what is allowed; a setting that is
            given beside a condition that sets it is one of them.
    """
    own = [] if form is None else list(signature(type(form).__init__).parameters)[1:-1]
    known = dict.fromkeys([*own, "condition", *NavigationConfig.model_fields])
    wrong = [str(name) for name in settings if name not in known]
    values = {name: value for name, value in settings.items() if name in known}
    problems: list[str] = []
    try:
        values = expand(values)
    except ConfigError as error:
        problems += error.problems
        values.pop("condition")
    try:
        config = NavigationConfig(**values)
    except ConfigError as error:
        problems += error.problems
    problems += [f"{name}: {unknown('name', name, known)}" for name in wrong]
    if problems:
        raise ConfigError("configuration", problems)
    return config


def describe(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Return one line for each problem of a ``model``: place, what is wrong, what is allowed.

    The fields of the model, and of the models in it, are the known names.
    """
    lines = []
    for problem in error.errors():
        path = [part for part in problem["loc"] if part not in (_ONE, _EACH, _DRAWN)]
        place = ".".join(map(str, path)) or model.__name__
        kind, given, context = problem["type"], problem["input"], problem.get("ctx", {})
        if isinstance(cause := context.get("error"), ConfigError):  # of a part that is a model
            lines += [f"{place}.{line}" for line in cause.problems]
            continue
        if kind == "too_short" and len(given) > context["actual_length"]:
            continue  # an entry has its own line
        message = problem["msg"].removeprefix("Value error, ")
        if kind == "extra_forbidden":
            *path, name = problem["loc"]
            known = _level(model, path).model_fields.items()  # without repr: not to be set by hand
            message = unknown("name", str(name), [name for name, field in known if field.repr])
        elif kind == "literal_error":
            choices = [one.strip("'") for one in re.split(", | or ", context["expected"])]
            shown = _shown(given)
            message = f"{shown}: " + unknown("choice", shown.strip("'"), choices)
        elif kind != "missing":  # else the input is all that is around it
            message += f" (got {_shown(given)})"
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
