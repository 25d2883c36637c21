"""Golden numbers: every kind of measurement gives the numbers that it gave, whatever the code looks like.

After a change that is meant to change numbers: ``python tests/golden/write.py``, and say why in the commit.
"""

import pytest
import torch
import write as golden_file
from source_bank import KINDS, SOURCES

SLOW = {*KINDS} - {"positions", "poses", "mixture", "heights", "hidden markers", "ball in sockets", "payloads"}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in SOURCES])
def test_the_numbers_are_as_they_were(name: str) -> None:
    found, known = golden_file.computed(name), golden_file.read()[name]
    wrong = golden_file.mistakes(found, known)
    assert not wrong, f"{len(wrong)} of {len(known)} quantities:\n" + "\n".join(wrong)


def test_the_file_has_the_cases() -> None:
    assert list(golden_file.read()) == list(SOURCES)


def test_small_changes_of_a_long_tensor_are_seen() -> None:
    values = torch.linspace(1, 2, 300, dtype=torch.float64).view(100, 3)
    values[7, 1] = torch.nan
    known = golden_file.entry(values)
    assert golden_file.mistakes({"k1": known}, {"k1": known}) == []
    changed = values.clone()
    changed[51, 2] += 1e-5
    assert 1e-9 < golden_file.difference(golden_file.entry(changed), known) < 1e-6
    for other in (values.nan_to_num(0.0), values.view(3, 100)):
        assert golden_file.difference(golden_file.entry(other), known) == float("inf")
    assert golden_file.mistakes({"p": known}, {"k1": known}) == ["k1: missing", "p: not in the file"]
