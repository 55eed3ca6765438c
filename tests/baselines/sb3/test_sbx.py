"""CrossQ of sbx: torch's networks are those that JAX has learned."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from baselines.sb3.trainer import Learner
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import prepare
from tests.support.runs import small_config

pytestmark = pytest.mark.slow


def test_networks_in_torch_are_those_of_jax():
    learner = Learner(*prepare(small_config("crossq-sbx")), EpisodeWindow())
    model = learner.model
    model.learn(140)
    assert model._n_updates > 0
    seen = learner.worlds.reset()
    theirs, _ = model.predict(seen, deterministic=True)
    ours, _ = learner.policy.network.predict(seen, deterministic=True)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    state = model.policy.qf_state
    variables = {"params": state.params, "batch_stats": state.batch_stats}
    values = model.qf.apply(variables, seen, theirs)
    critics = learner.policy.network.critic(torch.as_tensor(seen), torch.as_tensor(theirs))
    np.testing.assert_allclose(torch.stack(critics).detach(), values, rtol=1e-4, atol=1e-5)


def test_a_trained_policy_acts_without_jax(tiny_runs):
    run = tiny_runs.finished("crossq-sbx")
    code = """
import sys
from pathlib import Path
sys.modules |= {"jax": None, "sbx": None}
from baselines.policies.load import load_trained
from baselines.runs.folder import RunFolder
load_trained(RunFolder.open(Path(sys.argv[1])))
"""
    subprocess.run([sys.executable, "-c", code, str(run.path)], check=True)
