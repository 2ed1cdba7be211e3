"""Everything that reads what others wrote, under seeded mutations: a result or an FtlmError, nothing else."""

import pytest

from fuzz import REGRESSIONS, fault, fuzz
from slow_cases import slow_after
from targets import NEEDS, SLOW, TARGETS

KEPT = sorted(path for path in REGRESSIONS.rglob("*") if path.is_file())


@slow_after(1, "count", [40, 200])
@pytest.mark.parametrize("target", TARGETS)
def test_mutations_end_well_or_in_an_error_of_ftlm(target, count):
    if target in NEEDS:
        pytest.importorskip(NEEDS[target])
    count //= 20 if target in SLOW else 1
    tried, faults = fuzz(target, seed=1, inputs=count)
    assert (tried, faults) == (count, {})


@pytest.mark.parametrize("path", KEPT, ids=lambda p: f"{p.parent.name}-{p.name}")
def test_inputs_that_once_broke_something_do_no_longer(path):
    assert fault(path.parent.name, path.read_bytes()) is None


def test_there_are_such_inputs():
    assert KEPT


def test_a_fault_would_be_seen(monkeypatch):
    def broken(data):
        if b"\0" in data:
            raise IndexError("out of range")

    monkeypatch.setitem(TARGETS, "values", broken)
    tried, faults = fuzz("values", inputs=2000)
    assert tried == 2000
    assert [what.split(":")[0] for what in faults] == ["IndexError at test_fuzz.py"]
