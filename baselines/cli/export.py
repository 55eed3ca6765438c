"""``mbn export``: a trained policy as a file for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from baselines.cli.options import check_options


@dataclass(frozen=True)
class Export:
    """Write the mean actions of a trained policy as ONNX, torch.export or plain NumPy arrays."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """The folder of a run, or zoo:NAME (see `mbn zoo`)."""
    out: Path
    """The file to write: .onnx, .pt2 or .npz."""
    field: str | None = None
    """A name of `mbn fields`, or a field file; by default that of the run or of zoo:NAME."""
    force: bool = False
    """If the file exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Load the policy, write and check the file, and say what it needs."""
        from baselines import load_policy
        from baselines.evaluation.export import ALLOWED, export_policy, writer_of
        from baselines.zoo.sources import check_known, is_trained, needs_field
        from mbn_marl.config import make_config

        writer_of(self.out)
        check_known(self.policy)
        check_options("export", {f"{self.policy}: {ALLOWED}": not is_trained(self.policy)})
        policy = load_policy(self.policy, self.field)
        if policy.field is None:
            raise needs_field(self.policy)
        metadata, difference = export_policy(policy, self.out, force=self.force)
        config, clip = make_config(policy.settings), metadata["clip"]
        shape, returned = (", ".join(map(str, metadata[name])) for name in ("shape", "returns"))
        print(f"takes    {metadata['takes']} ({shape}) of W worlds")
        if metadata["takes"] == "observations":
            print(f"         observation={config.observation!r}, one_hot={config.one_hot}")
        clipped = "" if clip is None else f"; normalises them, clipped to +-{clip:g}, itself"
        print(f"         raw numbers{clipped}")
        print(f"returns  actions ({returned}), means in [-1, 1]")
        print(f"made for {metadata['field']}; all settings are in the file, under mbn_marl")
        print(f"written to {self.out}; differs from the policy by {difference:.0e} at most")
