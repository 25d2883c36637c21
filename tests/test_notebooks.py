"""What notebooks show of models, results, errors and measurements."""

from __future__ import annotations

import pytest
from lxml import html
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.common.data_frames import table_html


@pytest.mark.parametrize("name", ["arm", "posed"])
def test_everything_has_a_table(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    errors = dc.evaluate(case.model, case.test)
    for shown, expected in (
        (case.model, ["simulated_arm", "rows of the fit", str(len(case.train))]),
        (case.result, ["gravity on joints", "transmission of elbow_joint", case.result.status]),
        (errors, [f"{1e3 * errors.rms:.4f}", f"{1e3 * errors.p95:.4f}"]),
        (case.test, [repr(case.test), "0" if case.test.joint_names is None else "elbow_joint"]),
    ):
        page = html.fromstring(shown._repr_html_())
        assert len(list(page.iter("table"))) >= 1
        for text in expected:
            assert text in page.text_content()
    assert ("orientation" in errors._repr_html_()) == (name == "posed")


def test_names_are_text() -> None:
    assert "<b>" not in table_html("<b>", ("<b>",), [["<b>"]])
