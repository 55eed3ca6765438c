"""The configuration of the MDP: every number and rule of it, validated, in one frozen object."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Iterator, Mapping, Sequence
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


RealNumber = Annotated[float, BeforeValidator(_number)]
WholeNumber = Annotated[int, BeforeValidator(_number)]
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
            message = (
                f"{problem['input']!r:.80}: {unknown('choice', str(problem['input']), choices)}"
            )
        else:
            message = problem["msg"].removeprefix("Value error, ")
            if problem["type"] != "missing":  # else the input is all that is around it
                message += f" (got {_SHORT.repr(problem['input'])})"
        lines.append(f"{place}: {message}")
    return lines


def _level(model: type[BaseModel], path: Sequence[int | str]) -> type[BaseModel]:
    """Return the model that the value at ``path`` inside ``model`` is validated as."""
    for name in path:
        field = model.model_fields.get(str(name))
        if field is not None and isinstance(field.annotation, type):
            model = field.annotation if issubclass(field.annotation, BaseModel) else model
    return model


MAX_ROBOTS = 64
MAX_ROIS = 24
"""More ROIs than this would make the visit code inexact in float32."""
LEAST, MOST = 1e-12, 1e12
"""The range of what must be above 0: in float32 squares and quotients are finite, above 0 too."""

RobotIndex = Annotated[int, Field(ge=0, lt=MAX_ROBOTS)]
StepNumber = Annotated[WholeNumber, Field(ge=1, le=1_000_000)]
Finite = Annotated[RealNumber, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
Probability = Annotated[RealNumber, Field(ge=0.0, le=1.0)]
Positive = Annotated[RealNumber, Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
NonNegative = Annotated[RealNumber, Field(ge=0.0, le=MOST, allow_inf_nan=False)]
Turn = Annotated[RealNumber, Field(ge=LEAST, le=math.pi)]
Steering = Annotated[RealNumber, Field(ge=LEAST, le=1.5)]
Dynamics = Literal["point_mass", "holonomic", "unicycle", "bicycle"]
TeamDynamics = Literal[Dynamics, "mixed"]
Observation = Literal["relative", "state", "local", "lidar", "lidar_local", "entities"]
WITHOUT_RADIUS = ("relative", "state")
"""Observations that do not depend on the sensing radius."""
MIXED: tuple[Dynamics, ...] = ("point_mass", "unicycle", "bicycle")
"""The dynamics of a ``"mixed"`` team's robots, in turn."""

if TYPE_CHECKING:  # a setting that draws its number has none before an episode: see ``drawn``
    DynamicsOfEach = TeamDynamics | tuple[Dynamics, ...]
    PositiveOfEach = float | tuple[float, ...]
    AnyNumber = float
    AnyPositive = float
    AnyNonNegative = float
    AnyProbability = float
    AnyTurn = float
    AnySteering = float
else:
    AnyNumber, AnyPositive, AnyNonNegative = map(or_drawn, (Finite, Positive, NonNegative))
    AnyProbability, AnyTurn, AnySteering = map(or_drawn, (Probability, Turn, Steering))
    DynamicsOfEach = or_each(Dynamics, MAX_ROBOTS, TeamDynamics)
    PositiveOfEach = or_each(AnyPositive, MAX_ROBOTS)

Number = float | Uniform
"""A number, or the range that each episode draws it from."""


class RewardProfile(Checked):
    """A named set of reward rules and weights (mdp.md, "Reward profiles").

    Attributes:
        name: how the profile is called.
        rules: ``"released"`` (the authors' released code) or ``"formal"`` (the paper's section 3).
        small: r_s, the charge of a step on new ground (reward units, >= 0).
        medium: r_m, the charge of a step on known ground (reward units, >= 0).
        large: r_l, for a visited ROI, and against leaving the field (reward units, >= 0).
        infinite: r_inf, finite in place of infinity: success and collision (reward units, >= 0).

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.

    Source:
        Choton, Woods, Hsu, section 3 (``"formal"``) and the authors' released code
        (``"released"``).
    """

    name: str
    rules: Literal["released", "formal"] = "released"
    small: NonNegative = 10.0
    medium: NonNegative = 100.0
    large: NonNegative = 10_000.0
    infinite: NonNegative = 100_000.0


REWARD_PROFILES: Mapping[str, RewardProfile] = {
    "released": RewardProfile(name="released"),
    "formal": RewardProfile(name="formal", rules="formal"),
}


class Failures(Checked):
    """How robots fail during an episode (mdp.md, "Failures").

    Attributes:
        rate: the probability that a robot fails in a step, in [0, 1].
        at: the step, from 1 on, in which a robot fails, by the robot's index, from 0 on.
        between: a first and a last step: each episode draws one robot, and the step from the first
            to the last in which it fails; ``None``: it draws none.
        kind: what a failed robot does: ``"brake"``, ``"coast"`` or ``"vanish"``.
        most: how many robots of the team can have failed before ``rate`` fails no more, 0 to n;
            ``None`` is n - 1.

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.
    """

    rate: AnyProbability = 0.0
    at: dict[RobotIndex, StepNumber] = Field(default_factory=dict)
    between: tuple[StepNumber, StepNumber] | None = None
    kind: Literal["brake", "coast", "vanish"] = "brake"
    most: Annotated[WholeNumber, Field(ge=0, le=MAX_ROBOTS)] | None = None

    @field_validator("between")
    @classmethod
    def _in_order(cls, value: tuple[int, int] | None) -> tuple[int, int] | None:
        if value is not None and value[0] > value[1]:
            raise ValueError("the first step must not be after the last")
        return value


_NO_FAILURES = Failures()
NUMBERS = (
    *("gust", "gust_time", "action_noise", "action_loss"),
    *("position_noise", "velocity_noise", "dropout"),
    *("tau", "turn_max", "wheelbase", "steer_max", "safety_distance", "roi_radius"),
)
"""Settings that are one number, which may be drawn."""
LIMITS = ("mass", "f_max", "v_clip")
"""Settings that are a number of each robot, which may be drawn."""


class NavigationConfig(Checked):
    """Everything about the MDP that is not the field. Symbols are those of the paper.

    A number that may be drawn (*drawn* below) may be given as a :class:`Uniform`: each episode then
    draws it (mdp.md, "Drawn numbers").

    Attributes:
        n_robots: team size, 1 to 64; ``None`` takes as many as the field has starts.
        reward: the name of a reward profile, or a :class:`RewardProfile`.
        reward_sharing: ``"individual"`` (each robot its own share; the shares sum to the team's
            reward) or ``"team"`` (every robot gets the team's reward).
        dynamics: how robots move: ``"point_mass"``, ``"holonomic"``, ``"unicycle"`` or
            ``"bicycle"`` (mdp.md, "Dynamics"); one name for all robots or one per robot;
            ``"mixed"``: point mass, unicycle and bicycle in turn.
        observation: ``"relative"``, ``"state"``, ``"local"``, ``"lidar"``, ``"lidar_local"`` or
            ``"entities"``, see ``engine.mdp.observations``.
        assignment: only with ``"entities"``: who visits which ROI when; ``"fresh"``: as of now.
        one_hot: append the robot's index as a one-hot vector to its observation.
        sensing_radius: how far ``"local"``, ``"lidar"`` and ``"lidar_local"`` see, and the rays of
            ``"entities"``, in units; with other observations nothing else than 100 is allowed.
        wind: ``(v_a, beta_a)``: units/step per step, degrees from +x; both may be drawn.
        gust: standard deviation of gusts along each axis, units/step per step; may be drawn.
        gust_time: correlation time of the gusts, steps, > 0; may be drawn.
        action_noise: standard deviation of each number of an action, >= 0; may be drawn.
        action_loss: probability that the action before is repeated, in [0, 1]; may be drawn.
        action_delay: how late actions arrive, steps, 0 to 100.
        position_noise: standard deviation of observed positions, units, >= 0; may be drawn.
        velocity_noise: the same of velocities, units/step, >= 0; may be drawn.
        dropout: probability that a robot or ROI is not observed, in [0, 1]; may be drawn.
        max_steps: T_max; reaching it truncates the episode.
        dtype: precision of the simulation, ``"float32"`` or ``"float64"``.
        f_max: force of a full-scale action, mass x units/step^2, > 0; one number for all robots
            or one per robot; may be drawn.
        v_clip: speed limit, units/step, > 0, per axis, or along the heading of a robot that has
            one; one number for all robots or one per robot; may be drawn.
        tau: time of one step, > 0; may be drawn.
        mass: M_i, one number for all robots or one per robot, > 0; may be drawn.
        turn_max: the most that a unicycle turns, rad/step, > 0 and at most pi; may be drawn.
        wheelbase: distance of a bicycle's axles, units, > 0; may be drawn.
        steer_max: the most that a bicycle steers, rad, > 0 and at most 1.5; may be drawn.
        safety_distance: C; robots strictly closer than this have collided, units; may be drawn.
        roi_radius: rho; an ROI within this distance of a robot is visited, units; may be drawn.
        random_starts: start at random points, at least C apart; at the starts if none are found.
        failures: how robots fail during an episode, :class:`Failures`; ``None``: they do not.

    Raises:
        ConfigError: naming every unknown or invalid setting and what is allowed.

    Source:
        Choton, Woods, Hsu, sections 3 and 4: symbols, dynamics and default numbers.
    """

    n_robots: Annotated[WholeNumber, Field(ge=1, le=MAX_ROBOTS)] | None = None
    reward: RewardProfile = REWARD_PROFILES["released"]
    reward_sharing: Literal["individual", "team"] = "individual"
    dynamics: DynamicsOfEach = "point_mass"
    observation: Observation = "relative"
    assignment: Literal[False, True, "fresh"] = False
    one_hot: Flag = False
    sensing_radius: Positive = 100.0
    wind: tuple[AnyNonNegative, AnyNumber] = (0.0, 0.0)
    gust: AnyNonNegative = 0.0
    gust_time: AnyPositive = 10.0
    action_noise: AnyNonNegative = 0.0
    action_loss: AnyProbability = 0.0
    action_delay: Annotated[WholeNumber, Field(ge=0, le=100)] = 0
    position_noise: AnyNonNegative = 0.0
    velocity_noise: AnyNonNegative = 0.0
    dropout: AnyProbability = 0.0
    max_steps: StepNumber = 1000
    dtype: Literal["float32", "float64"] = "float32"
    f_max: PositiveOfEach = 0.5
    v_clip: PositiveOfEach = 5.0
    tau: AnyPositive = 1.0
    mass: PositiveOfEach = 1.0
    turn_max: AnyTurn = 0.3
    wheelbase: AnyPositive = 4.0
    steer_max: AnySteering = 0.5
    safety_distance: AnyNonNegative = 10.0
    roi_radius: AnyNonNegative = 10.0
    random_starts: Flag = False
    failures: Failures | None = None

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
        """Return whether episodes or observations depend on random numbers."""
        chances = (self.gust, self.action_noise, self.action_loss)
        sight = (self.position_noise, self.velocity_noise, self.dropout)
        failures = self.failures or _NO_FAILURES
        fails = bool(failures.rate) or failures.between is not None
        return bool(self.random_starts or fails or self.drawn or any((*chances, *sight)))

    @property
    def drawn(self) -> dict[str, Uniform]:
        """Return the ranges of drawn numbers by name, such as ``wind_speed`` or ``mass_0``."""
        return {name: one for name, one in self.numbers() if isinstance(one, Uniform)}

    def numbers(self) -> Iterator[tuple[str, Number]]:
        """Yield all numbers that may be drawn, by name, a robot's own last."""
        yield from zip(("wind_speed", "wind_angle"), self.wind, strict=True)
        for name in NUMBERS:
            yield name, getattr(self, name)
        yield "failure_rate", (self.failures or _NO_FAILURES).rate
        for name in LIMITS:
            value = getattr(self, name)
            own = isinstance(value, tuple)
            yield from ((f"{name}_{i}", v) for i, v in enumerate(value)) if own else [(name, value)]

    def with_drawn(self, drawn: Mapping[str, float]) -> NavigationConfig:
        """Return the configuration of an episode that has ``drawn`` these, in settings' units."""
        if not drawn:
            return self
        known = {**dict(self.numbers()), **drawn}
        update: dict[str, Any] = {name: known[name] for name in NUMBERS}
        update["wind"] = known["wind_speed"], known["wind_angle"]
        for name in LIMITS:
            value = getattr(self, name)
            own = isinstance(value, tuple)
            each = tuple(known[f"{name}_{i}"] for i in range(len(value))) if own else known[name]
            update[name] = each
        if self.failures is not None:
            update["failures"] = self.failures.model_copy(update={"rate": known["failure_rate"]})
        return self.model_copy(update=update)

    def at_most(self) -> NavigationConfig:
        """Return it with the highest value of every drawn number."""
        return self.with_drawn({name: ends.high for name, ends in self.drawn.items()})

    @property
    def top_speed(self) -> float:
        """The highest speed limit of a robot, units/step."""
        limits: tuple[float, ...] = self.at_most().of_each("v_clip", 1)
        return max(limits)

    def wind_increment(self) -> tuple[float, float]:
        """The velocity that the wind adds in one step, ``(x, y)`` in units/step."""
        speed, angle = self.wind
        return speed * math.cos(math.radians(angle)), speed * math.sin(math.radians(angle))


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
"""The settings of each named condition (mdp.md, "Conditions")."""


class FixedSettings(TypedDict, total=False):
    """The keyword arguments of :class:`NavigationConfig` but the team size, and ``condition``."""

    condition: Condition
    reward: str | RewardProfile
    reward_sharing: Literal["individual", "team"]
    dynamics: TeamDynamics | tuple[Dynamics, ...]
    observation: Observation
    assignment: Literal[False, True, "fresh"]
    one_hot: bool
    sensing_radius: float
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
    """All keyword arguments of :class:`NavigationConfig`, and ``condition``, typed."""

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


def make_config(settings: Mapping[str, Any]) -> NavigationConfig:
    """Validate ``settings``, values by name, into a configuration.

    Args:
        settings: the arguments of :class:`NavigationConfig`; ``condition``, the name of one of
            ``CONDITIONS``, stands for the settings listed there.

    Raises:
        ConfigError: naming every unknown or invalid setting and what is allowed; a setting that is
            given beside a condition that sets it is one of them.
    """
    problems: list[str] = []
    try:
        values = expand(settings)
    except ConfigError as error:
        problems += error.problems
        values = {name: value for name, value in settings.items() if name != "condition"}
    try:
        config = NavigationConfig(**values)
    except ConfigError as error:
        problems += error.problems
    if problems:
        raise ConfigError("configuration", problems)
    return config
