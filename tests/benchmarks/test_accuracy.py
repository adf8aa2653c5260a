"""The accuracy benchmark runs, and on every reference trajectory that there is."""

import json

import pytest

from benchmarks import accuracy


@pytest.mark.slow
def test_it_has_a_row_for_every_record(capsys):
    accuracy.main()
    printed = capsys.readouterr().out
    files = sorted(accuracy.REFERENCE.glob("*.json"))
    assert len(files) == 2
    for path in files:
        for record in json.loads(path.read_text(encoding="utf-8")):
            assert record["id"] in printed
