"""``python -m tests.lowest``: run the environments on the lowest versions that they allow.

The wheel is installed without extras, with the oldest allowed version of every dependency.
"""

import subprocess
import tempfile
import tomllib
import venv
from pathlib import Path

from tests.support.pages import ROOT
from tests.support.wheel import build_wheel

FORMS = """
import gymnasium
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from mbn_marl import BatchEngine, centralized_env, env, parallel_env

parallel_api_test(parallel_env("field_03"), 60)
parallel_seed_test(lambda: parallel_env("field_03"))
api_test(env("field_03"), 60)
alone = centralized_env("field_03")
alone.reset(seed=0)
alone.step(alone.action_space.sample())
envs = gymnasium.make_vec("mbn/field_03-v0", num_envs=3)
envs.reset(seed=0)
assert envs.step(envs.action_space.sample())[0].shape == (3, 13)
engine = BatchEngine("field_03", 3, threads=2)
engine.reset(seed=0)
engine.step(engine.sample_actions())
"""


def lowest() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [requirement.replace(">=", "==") for requirement in project["dependencies"]]


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="lowest") as name:
        folder = Path(name)
        wheel = build_wheel(folder / "build")
        venv.create(folder / "venv", with_pip=True)
        programs = folder / "venv" / "bin"
        subprocess.run([programs / "pip", "install", "-q", wheel, *lowest()], check=True)
        environment = {"PATH": str(programs), "NUMBA_CACHE_DIR": str(folder / "cache")}
        for words in (["mbn", "fields", "field_03"], ["python", "-c", FORMS]):
            command = [programs / words[0], *words[1:]]
            subprocess.run(command, cwd=folder, env=environment, check=True)


if __name__ == "__main__":
    main()
