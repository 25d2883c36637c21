"""Saving models: what cannot be written, and files that survive a failed attempt."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import pytest
import torch
from model_file_bank import Editor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError


def test_saving_into_a_missing_folder(small: dc.CalibratedKinematics, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.*cannot be written .*No such file or directory.*make its folder first"):
        dc.save(small, tmp_path / "none" / "model.safetensors")
    assert not (tmp_path / "none").exists()


def test_saving_over_a_folder(small: dc.CalibratedKinematics, tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        dc.save(small, tmp_path / "model")
    assert [p.name for p in tmp_path.iterdir()] == ["model"]


@pytest.mark.parametrize("what", [3, "model", None, torch.zeros(3)])
def test_only_models_are_saved(what: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"`model`: expected a calibrated model, got .*result.model"):
        dc.save(what, tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_replaced(small: dc.CalibratedKinematics, sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_text("old")
    dc.save(small, str(path))
    assert path.read_bytes() == sound
    assert [p.name for p in tmp_path.iterdir()] == ["model.safetensors"]


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


def test_an_existing_file_keeps_its_permissions_and_its_link(small: dc.CalibratedKinematics, tmp_path: Path) -> None:
    path, link = tmp_path / "model.safetensors", tmp_path / "link"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path.name)
    dc.save(small, link)
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert isinstance(dc.load(path), dc.CalibratedKinematics)
