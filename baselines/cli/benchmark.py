"""``mbn benchmark``: a policy on the frozen fields, by a fixed protocol."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from baselines.cli.options import check_options


@dataclass(frozen=True)
class Benchmark:
    """Measure a policy on frozen fields with proved bounds, by the same rules for all."""

    source: Positional[Annotated[str, arg(metavar="POLICY")]]
    """zoo:NAME, a policy of `mbn zoo`; the folder of a run; greedy, planner, replan or random;
    or module:callable, your own."""
    split: Literal["test", "validation"] = "test"
    """Which fields: those to choose by are of validation."""
    shield: bool = False
    """Let robots do only what they could brake after, whatever the policy wants."""
    tiers: tuple[str, ...] = ()
    """Some of 1-convex, 2-sizes, 3-shapes, 4-crowds, 5-weather; by default all."""
    out: Path | None = None
    """The folder to write: result.json, page.html, episodes; by default
    runs/benchmark-POLICY-SPLIT, or runs/benchmark-POLICY-shield-SPLIT."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """Go on with a benchmark that was interrupted: tiers that are done are kept."""

    def run(self, command_line: str) -> None:
        """Measure with a progress bar, print the tables, write the result and its page."""
        from rich.progress import Progress

        from baselines.compare.benchmark import load_protocol, load_tiers, run_benchmark
        from baselines.compare.benchmark_page import PAGE, result_page, result_tables
        from baselines.console import console
        from baselines.policies.load import check_known
        from baselines.policies.shielded import behind
        from baselines.runs.files import alone, claim_folder, write_text

        wrong = {"force and resume: allowed is one of them": self.force and self.resume}
        check_options("benchmark", wrong)
        check_known(self.source)
        tiers = load_tiers(self.split, self.tiers or load_protocol().tiers)
        policy = f"{self.source}{behind(self.shield)}"
        name = re.sub(r"[^\w.-]+", "-", policy).strip("-")
        out = self.out or Path(f"runs/benchmark-{name}-{self.split}")
        if not self.resume:
            claim_folder(out, force=self.force)
        out.mkdir(parents=True, exist_ok=True)
        with alone(out, "mbn benchmark"), Progress(console=console(), transient=True) as progress:
            task = progress.add_task(name, total=sum(map(len, tiers.values())))
            how: dict[str, Any] = {"command": command_line, "shield": self.shield}
            try:
                record = run_benchmark(
                    *(self.source, self.split, tiers, out),
                    **how,
                    resume=self.resume,
                    advance=lambda count: progress.advance(task, count),
                )
            except KeyboardInterrupt:
                problem = f"{out} has the tiers that are done; continue with --resume"
                raise KeyboardInterrupt(problem) from None
        write_text(out / PAGE, result_page(record, out))
        for title, table in result_tables(record).items():
            table.print(f"{policy} on {self.split}: {title}")
        print(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}")
