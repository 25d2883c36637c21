"""The list of what is refused and warned about names sentences that users see."""

from __future__ import annotations

import pytest
import sentences


def test_sentences_are_put_together_as_users_see_them(capsys: pytest.CaptureFixture[str]) -> None:
    sentences.main()
    text = capsys.readouterr().out
    assert "| refused | file '{path}' does not exist; check the name and the folder" in text
    assert "| warned | {count} are too few to select scales: defaults are used; measure at least" in text
    assert all(f"## {title}" in text for title in sentences.TITLES.values())
    assert len(set(sentences.sentences())) > 200
