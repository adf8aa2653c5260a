"""The README's programs run as they stand there, and its pictures exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)


def test_there_are_programs():
    assert len(PROGRAMS) == 6


@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_programs_run(number, capsys):
    exec(compile(PROGRAMS[number], f"README program {number + 1}", "exec"), {})
    assert re.search(r"\d", capsys.readouterr().out)  # each prints numbers


def test_files_exist():
    files = re.findall(r"\]\(([^)#]+)\)", TEXT) + re.findall(r"`((?:tests|mechanics|benchmarks)/[\w/]+\.py)`", TEXT)
    assert files
    missing = [name for name in files if "NAME" not in name and not (ROOT / name).exists()]
    assert missing == []
