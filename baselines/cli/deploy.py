"""``mbn deploy``: a policy of the plane on vehicles with dynamics, in 3-D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from baselines.demo.resolve import Actor
    from mbn_marl.sim3d import Deployment, Scale, Simulator

Flights = dict[str, list["Deployment"]]
"""By what flew them: the simulator, or the plane to compare with."""


@dataclass(frozen=True)
class Deploy:
    """Deploy a policy on simulated vehicles, and say how it fared."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """zoo, the zoo's own policy for each field; zoo:NAME; the folder of a run; greedy; planner, the
    best plan, followed in closed loop; or random."""
    field: tuple[str, ...] = ()
    """Names of `mbn fields`, or field files; by default that of the run or of zoo:NAME."""
    sim: Literal["mujoco", "coppeliasim", "plane"] = "mujoco"
    """What simulates the vehicles; plane is the environment's own point mass."""
    vehicle: Literal["quadrotor", "balancer"] = "quadrotor"
    """In MuJoCo."""
    wind: tuple[float, float] = (0.0, 0.0)
    """Speed (units/step per step) and angle (degrees from +x) of the wind."""
    wind_speeds: str | None = None
    """Wind speeds to deploy at, such as 0.1,..,0.5; without --figure only up to the first
    failure."""
    wind_angle: float = 30.0
    """The direction of those winds, degrees from +x."""
    compare: bool = False
    """Deploy in the plane too, and set both side by side."""
    metres_per_unit: float = 0.1
    """The size of the world."""
    seconds_per_step: float = 1.0
    """The pace of the world: how long a unit of the MDP's time takes."""
    host: str = "localhost"
    """Where CoppeliaSim runs."""
    port: int = 23000
    """Of CoppeliaSim's ZeroMQ remote API."""
    timeout: float = 10.0
    """Seconds that CoppeliaSim may take for an answer."""
    video: Path | None = None
    """Film the first deployment in MuJoCo: an .mp4 file, at twice the speed."""
    camera: Literal["field", "top", "chase"] = "field"
    """What the film is seen from: across the field, from above, or behind robot 0."""
    figure: Path | None = None
    """Draw the paths to this .png, .pdf or .svg file: a panel for each wind and simulator with
    --wind-speeds, else with --compare a panel for each field."""
    json: Path | None = None
    """Write all numbers to this file."""
    force: bool = False
    """If an output exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Deploy, print the table, and write what is asked for."""
        from baselines.demo.deploy3d import find_pilots, strongest_wind, summarise
        from baselines.runs.files import write_json
        from mbn_marl.sim3d import Scale

        self._check()
        scale = Scale(self.metres_per_unit, self.seconds_per_step)
        rows: list[dict[str, Any]] = []
        flights: list[Flights] = []
        with ExitStack() as stack:
            simulators = self._simulators(scale)
            for simulator in simulators.values():
                stack.enter_context(simulator)
            limit = simulators[self.sim].speed_limit
            for actor in find_pilots(self.policy, self.field, limit):
                flown = {name: self._fly(actor, one) for name, one in simulators.items()}
                flights.append(flown)
                for name, deployments in flown.items():
                    strongest = strongest_wind(deployments) if self.wind_speeds else None
                    for one in deployments:
                        step = one.episode.config.tau * scale.seconds
                        row = summarise(one, step)
                        rows.append({"sim": name, **row, "strongest_wind": strongest})
        print_deployments(rows, title=f"{self.policy}, {self._vehicles()}")
        if self.figure is not None:
            self._draw(flights, self.figure)
        if self.json is not None:
            scales = {"metres_per_unit": scale.metres, "seconds_per_step": scale.seconds}
            write_json(self.json, {"command": command_line, **scales, "deployments": rows})

    def _check(self) -> None:
        """Make sure that the options fit together and that no output is in the way."""
        from mbn_marl.errors import ConfigError
        from mbn_marl.files import claim_file

        problems = []
        if self.compare and self.sim == "plane":
            problems.append("compare: allowed with mujoco and coppeliasim")
        if self.vehicle != "quadrotor" and self.sim == "coppeliasim":
            problems.append(f"vehicle: {self.vehicle!r}; allowed with coppeliasim: quadrotor")
        if self.video is not None and self.sim != "mujoco":
            problems.append("video: allowed with mujoco")
        if self.figure is not None and not (self.compare or self.wind_speeds):
            problems.append("figure: allowed with --compare or --wind-speeds")
        if self.wind_speeds is not None and any(self.wind):
            problems.append("wind: allowed without --wind-speeds")
        if problems:
            raise ConfigError("deployment", problems)
        for output in (self.video, self.figure, self.json):
            if output is not None:
                claim_file(output, force=self.force)
        if self.figure is not None:
            from mbn_marl.render.figures import check_name

            check_name(self.figure)

    def _vehicles(self) -> str:
        """What flies or drives, in words."""
        names = {"mujoco": f"{self.vehicle}s in MuJoCo", "plane": "point masses in the plane"}
        return names.get(self.sim, "quadcopters in CoppeliaSim")

    def _simulators(self, scale: Scale) -> dict[str, Simulator]:
        """By name: the simulator, and the plane before it to compare with."""
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

            simulators["coppeliasim"] = CoppeliaSimulator(
                self.host, self.port, timeout=self.timeout, scale=scale
            )
        return simulators

    def _fly(self, actor: Actor, simulator: Simulator) -> list[Deployment]:
        """The deployments of an actor, one for each wind."""
        from baselines.demo.deploy3d import deploy_actor, sweep_wind
        from baselines.evaluation.wind import parse_speeds

        if self.wind_speeds is None:
            return [deploy_actor(actor, simulator, self.wind)]
        speeds, on = parse_speeds(self.wind_speeds), self.figure is not None
        return sweep_wind(actor, simulator, speeds, self.wind_angle, after_failure=on)

    def _draw(self, flights: Sequence[Flights], path: Path) -> None:
        """Draw the paths."""
        from mbn_marl.render import figures

        def last(deployment: Deployment) -> Any:
            return deployment.episode.snapshot(deployment.episode.steps)

        if self.wind_speeds is None:
            pairs = [(flown["plane"][0], flown[self.sim][0]) for flown in flights]
            lasts = {one.episode.field.name: (last(one), last(other)) for one, other in pairs}
            figures.save(figures.overlay_panels(lasts, ("plane", self.sim)), path)
            return
        panels = {
            f"{one.episode.field.name}, {name}, wind {one.episode.config.wind[0]:g}": last(one)
            for flown in flights
            for name, deployments in flown.items()
            for one in deployments
        }
        columns = len(next(iter(flights[0].values())))
        figures.save(figures.trajectory_panels(panels, columns=columns), path)


def print_deployments(rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print deployments (as ``summarise`` has them, with ``sim``) as a table, one a row."""
    from rich import box
    from rich.table import Table

    from baselines.console import console

    caption = (
        "ratio: to the plane's makespan; apart: the smallest distance of two robots, units;\n"
        "error: of tracking, units a step; speed: times real time on one core"
    )
    table = Table(
        title=title, caption=caption, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    headings = ("field", "sim", "wind", "outcome", "makespan", "ratio", "return", "apart")
    for heading in (*headings, "error", "speed"):
        words = heading in ("field", "sim", "outcome")
        table.add_column(heading, justify="left" if words else "right")
    plane = {
        (row["field"], row["wind_speed"]): row["makespan"] for row in rows if row["sim"] == "plane"
    }
    for row in rows:
        makespan, best = row["makespan"], plane.get((row["field"], row["wind_speed"]))
        compared = row["sim"] != "plane" and makespan is not None and best is not None
        pace = row["times_real_time"]
        table.add_row(
            row["field"],
            row["sim"],
            f"{row['wind_speed']:g}",
            row["outcome"],
            "-" if makespan is None else str(makespan),
            f"{makespan / best:.2f}" if compared else "-",
            f"{row['return']:,.0f}",
            "-" if row["separation"] is None else f"{row['separation']:.1f}",
            f"{row['tracking_error']:.2f}",
            "-" if row["sim"] == "plane" or pace is None else f"{pace:.0f}",
        )
    console().print(table)
