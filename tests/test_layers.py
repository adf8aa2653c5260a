"""Who may import whom, and what a bare import may load."""

import subprocess
import sys
from pathlib import Path

from importlinter.cli import lint_imports

ROOT = Path(__file__).parents[1]

HEAVY = ("sympy", "torch", "stable_baselines3", "pygame", "matplotlib")

# What derives kernels is itself imported only when the cache has none, and the adapter only by its users.
APART = ("nhenv.generate", "nhenv.one_kernel", "nhenv.rows_kernel", "nhenv.sb3")
LOAD_EVERY_MODULE = f"""
import importlib, pkgutil, sys
import mechanics, nhenv

for module in pkgutil.walk_packages(nhenv.__path__, "nhenv."):
    if module.name not in {APART}:
        importlib.import_module(module.name)
print(*(name for name in {HEAVY} if name in sys.modules))
"""


def test_imports_keep_the_contracts(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert lint_imports(config_filename="pyproject.toml", no_cache=True) == 0


def test_importing_nhenv_loads_no_heavy_library():
    result = subprocess.run([sys.executable, "-c", LOAD_EVERY_MODULE], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
