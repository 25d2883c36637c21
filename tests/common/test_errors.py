"""The grammar of messages, and where warnings point."""

import pytest

import diffeo_calib as dc
from diffeo_calib.common.errors import (
    DiffeoCalibWarning,
    InputError,
    MeasurementError,
    few,
    listed,
    sentence,
    warn_user,
)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "`q`."),
        ({"fix": "repair it"}, "`q`; repair it."),
        ({"expected": 3, "got": 4}, "`q`: expected 3, got 4."),
        ({"got": 0, "fix": "repair it"}, "`q`: got 0; repair it."),
    ],
)
def test_a_message_is_one_sentence(given: dict[str, object], expected: str) -> None:
    assert sentence("`q`", **given) == expected  # pyright: ignore[reportArgumentType]
    error = MeasurementError.of("`q`", **given)  # pyright: ignore[reportArgumentType]
    assert type(error) is MeasurementError
    assert isinstance(error, (InputError, ValueError, dc.DiffeoCalibError))
    assert str(error) == expected


def test_long_lists_are_cut_short() -> None:
    assert few([1, 2, 3]) == "1, 2, 3"
    assert few(range(9)) == "0, 1, 2, 3, 4 and 4 more"
    assert listed(["x", "y"]) == "['x', 'y']"
    assert listed([str(k) for k in range(20)]).endswith("'11' and 8 more]")


def test_warnings_point_at_the_line_outside_the_package() -> None:
    with pytest.warns(DiffeoCalibWarning, match="^odd$") as direct:
        warn_user("odd")
    with pytest.warns(DiffeoCalibWarning, match="degrees") as nested:
        dc.Measurements([[90.0]], [[1, 2, 3]])  # through two functions of the package
    assert [one.filename for one in (*direct, *nested)] == [__file__] * 2
    assert nested[0].lineno == direct[0].lineno + 2
