"""What using the environments loads: with a warm cache, no library that derives, learns or draws."""

import os
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


def test_a_thousand_steps_load_no_heavy_library(kernel_cache):
    for env_id in IDS:  # fill the cache
        bare = gym.make(env_id).unwrapped
        bare.reset(seed=0)
        assert np.isfinite([*bare.q, bare.energy]).all()
    before = _files(kernel_cache)
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT], cwd=ROOT, env=dict(os.environ), capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
    assert _files(kernel_cache) == before  # warm: the second process has derived and compiled nothing


def _files(directory):
    return sorted((str(path), path.stat().st_mtime_ns) for path in directory.rglob("*") if path.is_file())
