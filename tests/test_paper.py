"""The page that maps the paper to the code names only what exists."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "mechanics" / "PAPER.md").read_text(encoding="utf-8")
REFERENCES = sorted(set(re.findall(r"`((?:\.\./)?(?:\w+/)?\w+\.py)::([\w.]+)`", TEXT)))


def definitions(path):
    """Names defined at the top of a module, and Class.member."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{member.name}" for member in node.body if isinstance(member, ast.FunctionDef)}
        if isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def test_there_are_references():
    assert len(REFERENCES) > 60


@pytest.mark.parametrize(("file", "name"), REFERENCES)
def test_reference(file, name):
    folder = ROOT / "tests" / "mechanics" if file.startswith("test_") else ROOT / "mechanics" / "geometry"
    assert name in definitions((folder / file).resolve())


def test_every_row_of_the_errata_has_a_proof():
    table = TEXT.split("## Errata")[1]
    rows = [row for row in table.splitlines() if row.startswith("| ") and "|---" not in row][1:]
    assert len(rows) == 12
    assert all("test_" in row or "| wording |" in row for row in rows)
