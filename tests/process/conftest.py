"""Linearised rows of every kind of device."""

import process_bank
import pytest
from process_bank import Case
from tangent_bank import SETTINGS, Setting, built


@pytest.fixture(params=list(process_bank.ROWS))
def case(request: pytest.FixtureRequest) -> Case:
    return process_bank.case(request.param)


@pytest.fixture(params=list(SETTINGS))
def setting(request: pytest.FixtureRequest) -> Setting:
    """Measurements after the geometric calibration."""
    return built(request.param)
