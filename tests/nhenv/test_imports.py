"""What using the environments loads: with a warm cache, no library that derives, learns or draws."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np

import nhenv

ROOT = Path(__file__).parents[2]
IDS = [name for name in nhenv.environment_ids() if name.startswith(("nhenv/Snakeboard", "nhenv/RollerRacer"))]
IDS = [name for name in IDS if "Massive" not in name]
HEAVY = ("sympy", "mpmath", "torch", "stable_baselines3", "pygame", "matplotlib")

SCRIPT = f"""
import sys
import gymnasium as gym
import numpy as np
import nhenv

for env_id in {IDS}:
    env = gym.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(1000):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()
    bare = env.unwrapped
    assert np.isfinite([*bare.q, *bare.qdot, *bare.v, bare.energy]).all()
print(*(name for name in {HEAVY} if name in sys.modules))
"""


def test_a_thousand_steps_load_no_heavy_library(kernel_cache, tmp_path):
    for env_id in IDS:  # fill the cache
        bare = gym.make(env_id).unwrapped
        bare.reset(seed=0)
        assert np.isfinite([*bare.q, bare.energy]).all()
    # In a copy, because other workers of this session may be filling that cache. A file is written under another name.
    own = shutil.copytree(kernel_cache, tmp_path / "kernels", ignore=shutil.ignore_patterns("*tmp*"))
    before = _files(own)
    environment = {**os.environ, "NHENV_CACHE_DIR": str(own)}
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
    assert _files(own) == before  # warm: the second process has derived and compiled nothing


def _files(directory):
    return sorted((str(path), path.stat().st_mtime_ns) for path in directory.rglob("*") if path.is_file())
