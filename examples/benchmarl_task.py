"""BenchMARL: the suite as a task, for any of its algorithms.

Requirements: pip install ".[torchrl]" benchmarl==1.5.2 torchrl==0.11.1 tensordict==0.11.0
Command: python examples/benchmarl_task.py mappo (or masac --frames 40960)
Printed: success 52% in the last five batches, with sampled actions: too few frames to solve the
    field
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from benchmarl.algorithms import MappoConfig, MasacConfig
from benchmarl.environments.common import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torchrl.data import Composite
from torchrl.envs import EnvBase, RewardScaling

from mbn_marl.adapters.torchrl import NavigationEnv


class Navigation(TaskClass):
    """A field and the settings of ``NavigationEnv``: ``Navigation("field_03", {...})``."""

    def get_env_fun(self, num_envs, continuous_actions, seed, device):
        settings = {"state": False, "team_reward": False, "metrics": ["success"], **self.config}
        return lambda: NavigationEnv(self.name, num_envs, seed=seed or 0, device=device, **settings)

    def supports_continuous_actions(self):
        return True

    def supports_discrete_actions(self):
        return False

    def has_render(self, env):
        """One batch is many worlds."""
        return False

    def max_steps(self, env):
        return env.engine.config.max_steps

    def group_map(self, env):
        return env.group_map

    def observation_spec(self, env):
        spec = env.full_observation_spec_unbatched
        return Composite(
            robots=Composite(observation=spec["robots", "observation"], shape=[env.n_agents])
        )

    def info_spec(self, env):
        """There is none in the group."""

    def state_spec(self, env):
        """Critics see all observations."""

    def action_spec(self, env):
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env):
        """All forces are allowed."""

    def get_env_transforms(self, env: EnvBase):
        """Scale rewards of up to 100,000."""
        return [RewardScaling(0.0, 5e-5, in_keys=[("robots", "reward")])]

    @staticmethod
    def log_info(batch):
        """Log how many episodes that ended were successes."""
        ended = batch["next", "done"]
        share = (
            batch["next", "metrics", "success"][ended].float().mean() if ended.any() else torch.nan
        )
        return {"collection/success": float(share)}

    @staticmethod
    def env_name():
        return "mbn_marl"


parser = argparse.ArgumentParser()
parser.add_argument("algorithm", choices=["mappo", "masac"])
parser.add_argument("--frames", type=int, default=192_000, help="env-steps to learn from")
arguments = parser.parse_args()

config = ExperimentConfig.get_from_yaml()
config.loggers, config.evaluation, config.render, config.create_json = ["csv"], False, False, False
config.save_folder = tempfile.mkdtemp()
config.max_n_frames, config.lr = arguments.frames, 5e-4
config.on_policy_n_envs_per_worker, config.off_policy_n_envs_per_worker = 64, 16
config.on_policy_collected_frames_per_batch = 4096
config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 10, 1024
config.off_policy_collected_frames_per_batch, config.off_policy_n_optimizer_steps = 1024, 32
algorithm = {"mappo": MappoConfig, "masac": MasacConfig}[arguments.algorithm].get_from_yaml()
if arguments.algorithm == "mappo":  # MASAC finds its entropy by itself
    algorithm.entropy_coef, algorithm.lmbda = 0.01, 0.95
model = MlpConfig(num_cells=[64, 64], activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear)
task = Navigation("field_03", {"one_hot": True, "reward_sharing": "team"})
experiment = Experiment(
    task=task,
    algorithm_config=algorithm,
    model_config=model,
    critic_model_config=model,
    seed=0,
    config=config,
)
experiment.run()
(log,) = Path(config.save_folder).rglob("collection_success.csv")
shares = [float(line.split(",")[1]) for line in log.read_text().splitlines()]
print(f"success {np.nanmean(shares[-5:]):.0%} in the last five batches, with sampled actions")
