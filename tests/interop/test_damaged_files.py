"""Damaged model files, files of other kinds, failing saves: each is refused with one clear sentence."""

from __future__ import annotations

import json
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import pytest
import torch
from model_file_bank import Editor, refused
from product_bank import simulated
from safetensors.torch import save_file

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, ModelFileError
from diffeo_calib.interop import model_file, model_header


def test_cut_short(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.safetensors"
    for length in [*range(64), *range(64, len(sound), 61), len(sound) - 8, len(sound) - 1]:
        path.write_bytes(sound[:length])
        assert "copy or save it again" in refused(path), length
    path.write_bytes(sound + b"\0")
    refused(path)


@pytest.mark.parametrize(("part", "stride"), [("header", 13), ("tensors", 29)])
def test_flipped_bits(part: str, stride: int, small: dc.CalibratedKinematics, sound: bytes, tmp_path: Path) -> None:
    """Refused, or without effect: e-05 may become E-05, or a 17th digit may change without changing the number."""
    path, q = tmp_path / "flipped.safetensors", simulated(1)[2].q[:3]
    expected, start = small(q), 8 + struct.unpack("<Q", sound[:8])[0]
    places = range(0, start, stride) if part == "header" else range(start, len(sound), stride)
    harmless = 0
    for count, place in enumerate(places):
        flipped = bytearray(sound)
        flipped[place] ^= (0x01, 0x20, 0x80, 0xFF)[count % 4]
        path.write_bytes(flipped)
        try:
            model = dc.load(path)
        except ModelFileError:
            continue
        harmless += 1
        assert part == "header", place
        assert torch.equal(model(q), expected), place
    assert harmless < 0.02 * len(places)


def test_files_of_other_kinds(tmp_path: Path) -> None:
    path = tmp_path / "other"
    for content, message in (
        (b"", "cannot be read as a model file"),
        (b"robot: ur10\n", "cannot be read as a model file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "cannot be read as a model file"),
        (pickle.dumps({"model": 1}), "cannot be read as a model file"),
        (bytes([255] * 8), "cannot be read as a model file"),
    ):
        path.write_bytes(content)
        assert message in refused(path)
    save_file({"weight": torch.zeros(3)}, path)
    assert "is not a diffeo_calib model" in refused(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={"format": "pt"})
    assert "is not a diffeo_calib model" in refused(path)
    for text in ("[]", "null", "3", '"model"'):
        save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: text})
        assert "is not a diffeo_calib model" in refused(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: "{"})
    assert "cannot be read" in refused(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: "{}"})
    assert "format version None" in refused(path)
    header = json.dumps({"format": model_header.FORMAT})
    save_file({"weight": torch.zeros(3)}, path, metadata={model_file.ENTRY: header})
    assert "checksum" in refused(path)


@pytest.mark.parametrize(
    ("text", "dtype"), [("[" * 100_000, torch.float64), (json.dumps({"format": model_header.FORMAT}), torch.bfloat16)]
)
def test_odd_files_of_other_kinds(text: str, dtype: torch.dtype, tmp_path: Path) -> None:
    save_file({"weight": torch.zeros(3, dtype=dtype)}, tmp_path / "odd", metadata={model_file.ENTRY: text})
    refused(tmp_path / "odd")


def test_missing_files(tmp_path: Path) -> None:
    assert "there is no model file" in refused(tmp_path / "nowhere.safetensors")
    assert "there is no model file" in refused(tmp_path)


def test_torch_s_own_files_are_not_unpickled(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return (Path.touch, (Path(tmp_path / "executed"),))  # pyright: ignore[reportReturnType]

    torch.save({"model": Trap()}, tmp_path / "trap.pt")
    (tmp_path / "trap.pkl").write_bytes(pickle.dumps(Trap()))
    for name in ("trap.pt", "trap.pkl"):
        refused(tmp_path / name)
    assert not (tmp_path / "executed").exists()


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
