"""Fixtures of the tests of scales: measurements of every kind after the geometric calibration."""

import pytest
from tangent_bank import SETTINGS, Setting, built


@pytest.fixture(params=list(SETTINGS))
def setting(request: pytest.FixtureRequest) -> Setting:
    """Measurements of every kind."""
    return built(request.param)
