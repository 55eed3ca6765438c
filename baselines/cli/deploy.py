"""``mbn deploy``: a policy of the plane on vehicles with dynamics, in 3-D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from baselines.cli.options import InWeather, check_options
from baselines.compare.text_table import TextTable, shown
from baselines.runs.files import write_json
from mbn_marl.config import CONDITIONS
from mbn_marl.errors import ConfigError
from mbn_marl.files import check_free, claim_file

if TYPE_CHECKING:
    from baselines.policies.loaded import LoadedPolicy
    from mbn_marl.sim3d import Deployment, Scale, Simulator

MOST_SPEEDS = 100
COPPELIA = "coppeliasim"


@dataclass(frozen=True, kw_only=True)
class Deploy(InWeather):
    """Deploy a policy on simulated vehicles, and print how it did."""

    field: tuple[str, ...] = ()
    """Names of `mbn fields`, or field files; by default that of the run or of zoo:NAME."""
    sim: Literal["mujoco", "coppeliasim", "plane"] = "mujoco"
    """The simulator of the vehicles; plane is the environment's own point mass."""
    vehicle: Literal["quadrotor", "balancer"] = "quadrotor"
    """In MuJoCo."""
    wind_speeds: str | None = None
    """Wind speeds, such as 0.1,0.2,..,0.5; without --figure only up to the first failure."""
    wind_angle: float = 30.0
    """The direction of those winds, degrees from +x."""
    compare: bool = False
    """Deploy in the plane too, and set both side by side."""
    metres_per_unit: float = 0.1
    """The size of the world."""
    seconds_per_step: float = 1.0
    """The pace of the world: how long a unit of the MDP's time takes."""
    host: str = "localhost"
    """The machine on which CoppeliaSim runs."""
    port: int = 23000
    """Of CoppeliaSim's ZeroMQ remote API."""
    timeout: float = 10.0
    """Seconds that CoppeliaSim may take for an answer."""
    video: Path | None = None
    """Film the first deployment in MuJoCo: an .mp4 file, at twice the speed."""
    camera: Literal["field", "top", "chase"] = "field"
    """The camera: across the field, from above, or behind robot 0."""
    figure: Path | None = None
    """Draw the paths, with --compare or --wind-speeds, in this .png, .pdf or .svg file."""
    json: Path | None = None
    """Write all numbers to this file."""

    def run(self, command_line: str) -> None:
        from baselines.policies.classical import CLASSICAL
        from baselines.policies.load import find_policy
        from mbn_marl.sim3d import Scale

        speeds, angle = self._check()
        scale = Scale(self.metres_per_unit, self.seconds_per_step)
        rows: list[dict[str, Any]] = []
        flights: list[dict[str, list[Deployment]]] = []
        with ExitStack() as stack:
            simulators = self._simulators(scale)
            for simulator in simulators.values():
                stack.enter_context(simulator)
            asked, limit = self.asked, simulators[self.sim].speed_limit
            if self.source in CLASSICAL and limit is not None:  # they plan with it
                asked["v_clip"] = limit
            pilots = [find_policy(self.source, name, **asked) for name in self.field or (None,)]
            if self.video is not None:
                claim_file(self.video, force=self.force)
            for actor in pilots:
                flights.append({})
                for name, one in simulators.items():
                    sweep = sweep_wind(actor, one, speeds, angle, every=self.figure is not None)
                    flights[-1][name] = sweep
                    good = takewhile(lambda flight: flight.success, sweep)
                    winds = [flight.config.wind[0] for flight in good if self.wind_speeds]
                    last = {"strongest_wind": max(winds, default=None)}
                    rows += [{"sim": name, **summarise(flight, scale), **last} for flight in sweep]
        names = {
            "mujoco": f"{self.vehicle}s in MuJoCo",
            "plane": "point masses in the plane",
            "coppeliasim": "quadcopters in CoppeliaSim",
        }
        print_deployments(rows, title=f"{self.source}, {names[self.sim]}{self.weather}")
        if self.figure is not None:
            self._draw(flights, claim_file(self.figure, force=self.force))
        if self.json is not None:
            scales = {"metres_per_unit": scale.metres, "seconds_per_step": scale.seconds}
            numbers = {"command": command_line, **scales, "deployments": rows}
            write_json(claim_file(self.json, force=self.force), numbers)

    def _check(self) -> tuple[list[float], float]:
        # No wind where the policy's, or the condition's, is to stay.
        from mbn_marl.render.figures import check_name

        blown = self.wind_speeds and "wind" in CONDITIONS[self.condition or "calm"]
        panels = self.compare or self.wind_speeds
        wrong = {
            "compare: allowed with mujoco and coppeliasim": self.compare and self.sim == "plane",
            f"vehicle: {self.vehicle!r}; allowed with coppeliasim: quadrotor": (
                self.vehicle != "quadrotor" and self.sim == "coppeliasim"
            ),
            "video: allowed with mujoco": self.video and self.sim != "mujoco",
            f"video: {self.video}; allowed: a name that ends in .mp4": (
                self.video and self.video.suffix.lower() != ".mp4"
            ),
            "figure: allowed with --compare or --wind-speeds": self.figure and not panels,
            "wind: allowed without --wind-speeds": self.wind_speeds and self.wind,
            f"wind_speeds: allowed without --condition {self.condition}, which has wind": blown,
        }
        needed = {
            **{"vehicle": ("mujoco", self.sim != "plane"), "camera": ("--video", self.video)},
            "wind_angle": ("--wind-speeds", self.wind_speeds),
            **dict.fromkeys(("host", "port", "timeout"), (COPPELIA, self.sim == COPPELIA)),
        }
        wrong |= {
            f"{name}: allowed with {what}": not there
            and getattr(self, name) != getattr(Deploy, name)
            for name, (what, there) in needed.items()
        }
        check_options("deployment", wrong)
        if self.figure is not None:
            check_name(self.figure)
        for output in filter(None, (self.video, self.figure, self.json)):
            check_free(output, force=self.force)
        if self.wind_speeds is not None:
            return parse_speeds(self.wind_speeds), self.wind_angle
        return [], 0.0

    def _simulators(self, scale: Scale) -> dict[str, Simulator]:
        from mbn_marl.sim3d import PlaneSimulator

        simulators: dict[str, Simulator] = {}
        if self.compare or self.sim == "plane":
            simulators["plane"] = PlaneSimulator()
        if self.sim == "mujoco":
            from mbn_marl.sim3d.film import Film
            from mbn_marl.sim3d.mujoco_simulator import MujocoSimulator

            film = None if self.video is None else Film(self.video, self.camera)
            simulators["mujoco"] = MujocoSimulator(self.vehicle, scale=scale, film=film)
        if self.sim == "coppeliasim":
            from mbn_marl.sim3d.coppeliasim import CoppeliaSimulator

            place = (self.host, self.port)
            simulators[self.sim] = CoppeliaSimulator(*place, timeout=self.timeout, scale=scale)
        return simulators

    def _draw(self, flights: Sequence[Mapping[str, list[Deployment]]], path: Path) -> None:
        from mbn_marl.render import figures

        def last(deployment: Deployment) -> Any:
            return deployment.episode.snapshot(deployment.episode.steps)

        if self.wind_speeds is None:
            pairs = [(flown["plane"][0], flown[self.sim][0]) for flown in flights]
            lasts = {one.episode.field.name: (last(one), last(other)) for one, other in pairs}
            figures.save(figures.overlay_panels(lasts, ("plane", self.sim)), path)
            return
        panels = {
            f"{one.episode.field.name}, {name}, wind {one.config.wind[0]:g}": last(one)
            for flown in flights
            for name, sweep in flown.items()
            for one in sweep
        }
        columns = len(next(iter(flights[0].values())))
        figures.save(figures.trajectory_panels(panels, columns=columns), path)


def parse_speeds(text: str) -> list[float]:
    """Read wind speeds: ``0,0.1,..,0.5`` is ``0,0.1,0.2,0.3,0.4,0.5``."""
    words, speeds = text.replace(" ", "").split(","), list[float]()
    try:
        for place, word in enumerate(words):
            if word != "..":
                speeds.append(float(word))
                continue
            (first, second), last = speeds[-2:], float(words[place + 1])
            count = round((last - second) / (second - first))
            steps = range(1, min(count, MOST_SPEEDS) + 1)
            between = [round(second + step * (second - first), 12) for step in steps]
            if abs(between.pop() - last) > 1e-9:
                raise ValueError
            speeds += between
        if len(speeds) > MOST_SPEEDS or not all(0.0 <= one < float("inf") for one in speeds):
            raise ValueError
    except (ValueError, IndexError, ZeroDivisionError, OverflowError):
        allowed = (
            f"allowed: up to {MOST_SPEEDS} speeds of 0 and above between commas, and '..' for even "
            "steps from two of them to the next; for example 0,0.1,..,0.5"
        )
        raise ConfigError("deployment", [f"wind_speeds {text!r}: {allowed}"]) from None
    return speeds


def print_deployments(rows: Sequence[Mapping[str, Any]], title: str) -> None:
    caption = (
        "ratio: to the plane's makespan; apart: least distance of robots, units;\n"
        "error: of tracking, units a step; speed: times real time on one core"
    )
    headings = ("field", "sim", "outcome", "wind", "makespan", "ratio", "return", "apart")
    plane = {
        (row["field"], row["wind_speed"]): row["makespan"] for row in rows if row["sim"] == "plane"
    }
    lines = []
    for row in rows:
        flat, makespan = row["sim"] == "plane", row["makespan"]
        best = None if flat else plane.get((row["field"], row["wind_speed"]))
        failed = sum(step is not None for step in row["failed"])
        lines.append(
            (
                *(row["field"], row["sim"]),
                row["outcome"] + (f", {failed} failed" if failed else ""),
                f"{row['wind_speed']:g}",
                shown(makespan),
                shown(makespan / best if makespan and best else None, "{:.2f}"),
                shown(row["return"]),
                shown(row["separation"], "{:,.1f}"),
                shown(row["tracking_error"], "{:,.2f}"),
                shown(None if flat else row["times_real_time"]),
            )
        )
    TextTable(caption, (*headings, "error", "speed"), lines, words=3).print(title)


def sweep_wind(
    policy: LoadedPolicy, simulator: Simulator, speeds: list[float], angle: float, *, every: bool
) -> list[Deployment]:
    """Deploy in winds, the weakest first, up to the first failure or in ``every`` one."""
    from mbn_marl.engine import BatchEngine
    from mbn_marl.sim3d import deploy

    fitted = policy.fit(BatchEngine(policy.place, 1, threads=1, **policy.settings))
    deployments: list[Deployment] = []
    for wind in [{"wind": (speed, angle)} for speed in sorted(set(speeds))] or [{}]:
        fitted.reset()
        settings = {**policy.settings, **wind}
        flown = deploy(fitted, policy.place, settings, simulator, source=policy.name)
        deployments.append(flown)
        if not (flown.success or every):
            break
    return deployments


def summarise(deployment: Deployment, scale: Scale) -> dict[str, Any]:
    episode, taken = deployment.episode, deployment.seconds
    simulated = episode.steps * deployment.config.tau * scale.seconds
    own = ("success", "makespan", "wall_hits", "separation", "tracking_error")
    return {
        "field": episode.field.name,
        **dict(zip(("wind_speed", "wind_angle"), deployment.config.wind, strict=True)),
        **{name: getattr(episode, name) for name in ("outcome", "steps", "rois_visited")},
        **{name: getattr(deployment, name) for name in own},
        "return": episode.team_return,
        "failed": [int(step) or None for step in episode.failed],
        "times_real_time": simulated / taken if taken else None,
    }
