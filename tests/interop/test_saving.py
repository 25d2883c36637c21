"""Saving models: what cannot be written, and files that survive a failed attempt, see tests/common/test_files.py."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch
from model_file_bank import Editor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError


@pytest.mark.parametrize("what", [3, "model", None, torch.zeros(3)])
def test_only_models_are_saved(what: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"`model`: expected a calibrated model, got .*result.model"):
        dc.save(what, tmp_path / "model")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failing_save_leaves_the_old_file(
    where: str, error: BaseException, editor: Editor, sound: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = dc.load(editor.path)

    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(os, where, fail)
    expected = InputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected, match="No space left.*free some space" if isinstance(error, OSError) else None):
        dc.save(model, editor.path)
    assert editor.path.read_bytes() == sound
    assert [path.name for path in editor.path.parent.iterdir()] == [editor.path.name]
