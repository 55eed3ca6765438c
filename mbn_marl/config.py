"""The configuration of the MDP: every number and rule of it, validated, in one frozen object."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    field_validator,
)

from mbn_marl.errors import ConfigError, unknown

MAX_ROBOTS = 64
MAX_ROIS = 24
"""More ROIs than this would make the visit code inexact in float32."""

_SHORT = reprlib.Repr()
"""Shows values in messages: long ones without their middle."""
_SHORT.maxstring = _SHORT.maxother = 80

RobotIndex = Annotated[int, Field(ge=0, lt=MAX_ROBOTS)]
StepNumber = Annotated[int, Field(ge=1, le=1_000_000)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Dynamics = Literal["point_mass", "holonomic", "unicycle", "bicycle"]

_ONE, _EACH = "for all", "for each"
"""Marks of a setting's two forms, one value for all robots or one per robot; not in messages."""


def _form(value: object) -> str:
    return _EACH if isinstance(value, tuple | list) else _ONE


def _for_each(kind: Any) -> Any:
    """The type of a setting that is one value of a ``kind`` for all robots, or a tuple of them."""
    several = Annotated[tuple[kind, ...], Field(min_length=1, max_length=MAX_ROBOTS), Tag(_EACH)]
    return Annotated[Annotated[kind, Tag(_ONE)] | several, Discriminator(_form)]


if TYPE_CHECKING:
    DynamicsOfEach = Dynamics | tuple[Dynamics, ...]
    PositiveOfEach = float | tuple[float, ...]
else:
    DynamicsOfEach, PositiveOfEach = map(_for_each, (Dynamics, Positive))


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
        kind: what a failed robot does: ``"brake"``, ``"coast"`` or ``"vanish"``.
        most: how many robots of the team can have failed before ``rate`` fails no more, 0 to n;
            ``None`` is n - 1.

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.
    """

    rate: Probability = 0.0
    at: dict[RobotIndex, StepNumber] = {}
    kind: Literal["brake", "coast", "vanish"] = "brake"
    most: Annotated[int, Field(ge=0, le=MAX_ROBOTS)] | None = None


class NavigationConfig(Checked):
    """Everything about the MDP that is not the field. Symbols are those of the paper.

    Attributes:
        n_robots: team size, 1 to 64; ``None`` takes as many as the field has starts.
        reward: the name of a reward profile, or a :class:`RewardProfile`.
        reward_sharing: ``"individual"`` (each robot its own share; the shares sum to the team's
            reward) or ``"team"`` (every robot gets the team's reward).
        dynamics: how robots move: ``"point_mass"``, ``"holonomic"``, ``"unicycle"`` or
            ``"bicycle"`` (mdp.md, "Dynamics"); one name for all robots or one per robot.
        observation: ``"relative"``, ``"state"``, ``"local"``, ``"lidar"`` or ``"lidar_local"``,
            see ``engine.mdp.observations``.
        one_hot: append the robot's index as a one-hot vector to its observation.
        sensing_radius: how far ``"local"``, ``"lidar"`` and ``"lidar_local"`` see, in units.
        wind: ``(v_a, beta_a)``: speed in units/step per step, angle in degrees from +x.
        gust: standard deviation of the gusts along each axis, units/step per step; 0: none.
        gust_time: correlation time of the gusts, steps, > 0.
        action_noise: standard deviation of what is added to each number of an action, >= 0.
        action_loss: probability that an action is lost and the one before it repeated, in [0, 1].
        action_delay: how late actions arrive, steps, 0 to 100.
        position_noise: standard deviation of what a robot observes of positions, units, >= 0.
        velocity_noise: the same of velocities, units/step, >= 0.
        dropout: probability that a robot or ROI is not observed in a step, in [0, 1].
        max_steps: T_max; reaching it truncates the episode.
        dtype: precision of the simulation, ``"float32"`` or ``"float64"``.
        f_max: force of a full-scale action, mass x units/step^2, > 0; one number for all robots
            or one per robot.
        v_clip: speed limit, units/step, > 0, per axis, or along the heading of a robot that has
            one; one number for all robots or one per robot.
        tau: time of one step.
        mass: M_i, one number for all robots or one per robot, > 0.
        turn_max: the most that a unicycle turns, rad/step, > 0 and at most pi.
        wheelbase: distance of a bicycle's axles, units, > 0.
        steer_max: the most that a bicycle steers, rad, > 0 and at most 1.5.
        safety_distance: C; two robots closer than this (strictly) have collided, in units.
        roi_radius: rho; an ROI within this distance of a robot is visited, in units.
        random_starts: start at random points of the field, at least C apart, instead of the
            field's own starts.
        failures: how robots fail during an episode, :class:`Failures`; ``None``: they do not.

    Raises:
        ConfigError: naming every unknown or invalid setting and what is allowed.

    Source:
        Choton, Woods, Hsu, sections 3 and 4: symbols, dynamics and default numbers.
    """

    n_robots: Annotated[int, Field(ge=1, le=MAX_ROBOTS)] | None = None
    reward: RewardProfile = REWARD_PROFILES["released"]
    reward_sharing: Literal["individual", "team"] = "individual"
    dynamics: DynamicsOfEach = "point_mass"
    observation: Literal["relative", "state", "local", "lidar", "lidar_local"] = "relative"
    one_hot: bool = False
    sensing_radius: Positive = 100.0
    wind: tuple[NonNegative, Finite] = (0.0, 0.0)
    gust: NonNegative = 0.0
    gust_time: Positive = 10.0
    action_noise: NonNegative = 0.0
    action_loss: Probability = 0.0
    action_delay: Annotated[int, Field(ge=0, le=100)] = 0
    position_noise: NonNegative = 0.0
    velocity_noise: NonNegative = 0.0
    dropout: Probability = 0.0
    max_steps: StepNumber = 1000
    dtype: Literal["float32", "float64"] = "float32"
    f_max: PositiveOfEach = 0.5
    v_clip: PositiveOfEach = 5.0
    tau: Positive = 1.0
    mass: PositiveOfEach = 1.0
    turn_max: Annotated[float, Field(gt=0.0, le=math.pi)] = 0.3
    wheelbase: Positive = 4.0
    steer_max: Annotated[float, Field(gt=0.0, le=1.5)] = 0.5
    safety_distance: NonNegative = 10.0
    roi_radius: NonNegative = 10.0
    random_starts: bool = False
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

    def of_each(self, name: str, n: int) -> tuple[Any, ...]:
        """The values of the setting ``name`` for the robots of a team of ``n``."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value,) * n

    @property
    def is_random(self) -> bool:
        """Whether episodes or observations depend on random numbers."""
        chances = (self.gust, self.action_noise, self.action_loss)
        sight = (self.position_noise, self.velocity_noise, self.dropout)
        fails = self.failures is not None and self.failures.rate > 0.0
        return self.random_starts or fails or any((*chances, *sight))

    @property
    def top_speed(self) -> float:
        """The highest speed limit of a robot, units/step."""
        limits: tuple[float, ...] = self.of_each("v_clip", 1)
        return max(limits)

    def wind_increment(self) -> tuple[float, float]:
        """The velocity that the wind adds in one step, ``(x, y)`` in units/step."""
        speed, angle = self.wind
        return speed * math.cos(math.radians(angle)), speed * math.sin(math.radians(angle))


class FixedSettings(TypedDict, total=False):
    """The keyword arguments of :class:`NavigationConfig` but the team size, typed."""

    reward: str | RewardProfile
    reward_sharing: Literal["individual", "team"]
    dynamics: Dynamics | tuple[Dynamics, ...]
    observation: Literal["relative", "state", "local", "lidar", "lidar_local"]
    one_hot: bool
    sensing_radius: float
    wind: tuple[float, float]
    gust: float
    gust_time: float
    action_noise: float
    action_loss: float
    action_delay: int
    position_noise: float
    velocity_noise: float
    dropout: float
    max_steps: int
    dtype: Literal["float32", "float64"]
    f_max: float | tuple[float, ...]
    v_clip: float | tuple[float, ...]
    tau: float
    mass: float | tuple[float, ...]
    turn_max: float
    wheelbase: float
    steer_max: float
    safety_distance: float
    roi_radius: float
    random_starts: bool
    failures: Failures | None


class Settings(FixedSettings, total=False):
    """All keyword arguments of :class:`NavigationConfig`, for typed signatures."""

    n_robots: int | None


def make_config(settings: Mapping[str, Any]) -> NavigationConfig:
    """Validate ``settings``, values by name, into a configuration.

    Raises:
        ConfigError: naming every unknown or invalid setting and what is allowed.
    """
    return NavigationConfig(**settings)


def describe(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """One line for each problem that pydantic found: the place, what is wrong, what is allowed.

    Args:
        error: raised by pydantic.
        model: the model to be made; its fields, and those of the models in it, are the known names.
    """
    lines = []
    for problem in error.errors():
        path = [part for part in problem["loc"] if part not in (_ONE, _EACH)]
        place = ".".join(map(str, path)) or model.__name__
        cause = problem.get("ctx", {}).get("error")
        if isinstance(cause, ConfigError):  # of a part that is a model
            lines += [f"{place}.{line}" for line in cause.problems]
            continue
        if problem["type"] == "extra_forbidden":
            *path, name = problem["loc"]
            message = unknown("name", str(name), _level(model, path).model_fields)
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
