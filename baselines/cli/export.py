"""``mbn export``: a trained policy as a file for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from baselines.cli.options import check_options


@dataclass(frozen=True)
class Export:
    """Write the mean actions of a trained policy as an ONNX file."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """The folder of a run, or zoo:NAME (see `mbn zoo`)."""
    out: Path
    """The .onnx file to write."""
    field: str | None = None
    """A name of `mbn fields`, or a field file; by default that of the run or of zoo:NAME."""
    force: bool = False
    """If the file exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Load the policy, write and check the file, and say what it needs."""
        from baselines.policies.export import ALLOWED, check_name, export_policy
        from baselines.policies.load import check_known, find_policy
        from baselines.policies.trained import is_trained
        from mbn_marl.config import make_config

        check_name(self.out)
        check_known(self.policy)
        check_options("export", {f"{self.policy}: {ALLOWED}": not is_trained(self.policy)})
        policy = find_policy(self.policy, self.field)
        metadata, difference = export_policy(policy, self.out, force=self.force)
        shape, returned = (", ".join(map(str, metadata[name])) for name in ("shape", "returns"))
        print(f"takes    {metadata['takes']} ({shape}) of W worlds, raw numbers")
        if metadata["takes"] == "observations":
            config = make_config(policy.settings)
            print(f"         observation={config.observation!r}, one_hot={config.one_hot}")
        print(f"returns  actions ({returned}), means in [-1, 1]")
        print(f"made for {metadata['field']}; all settings are in the file, under mbn_marl")
        print(f"written to {self.out}; differs from the policy by {difference:.0e} at most")
