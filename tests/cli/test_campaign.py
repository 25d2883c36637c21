"""Campaign files: options written once."""

from pathlib import Path

import pytest

from diffeo_calib.cli.main import expanded
from diffeo_calib.common.errors import InputError


def campaign(tmp_path: Path, text: str) -> str:
    (tmp_path / "cell.toml").write_text(text, encoding="utf-8")
    return str(tmp_path / "cell.toml")


def test_entries_become_options_and_typed_ones_replace_them(tmp_path: Path) -> None:
    text = 'csv = "a.csv"\nrobot = "r.urdf"\nposition = ["x,y,z", "u,v,w"]\njoints = ["q1", "q2"]\nholdout = 0.2\n'
    words = expanded(["fit", campaign(tmp_path, text), "--holdout", "0"])
    table = [str(tmp_path / "a.csv"), "--robot", str(tmp_path / "r.urdf")]
    markers = ["--position", "x,y,z", "--position", "u,v,w", "--joints", "q1,q2"]
    assert words == ["fit", *table, *markers, "--holdout", "0"]
    for typed in (["--tip", "flange"], ["--tip=flange"]):  # a tip beside those of the file would be another arm
        text = 'csv = "a.csv"\ntip = ["one", "two"]\nholdout = 0.2\n'
        assert expanded(["fit", campaign(tmp_path, text), *typed])[2:] == ["--holdout", "0.2", *typed]
    for other in (["fit", "a.csv"], ["evaluate", "a.toml"], ["fit"], []):
        assert expanded(other) == other


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('csv = "a.csv"\nlenght = "mm"\n', "lenght"),
        ('length = "mm"\n', "csv"),
        ("csv = \n", "TOML"),
        ('csv = "a.csv"\nlength = {unit = "mm"}\n', "length"),
        ('csv = ["a.csv"]\n', "csv"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        expanded(["fit", campaign(tmp_path, text)])
    with pytest.raises(InputError, match=r"none\.toml"):
        expanded(["fit", str(tmp_path / "none.toml")])
    with pytest.raises(InputError, match=r"\.toml. is too large for a campaign file: expected at most 1 MB"):
        expanded(["fit", campaign(tmp_path, "#" * (1 << 20) + "\n")])
    (tmp_path / "endless.toml").symlink_to("/dev/zero")
    deep = campaign(tmp_path, "x=" + "[" * 5000), "is no TOML"
    for name, words in (deep, ("a\0.toml", "no file"), (str(tmp_path / "endless.toml"), "is no file")):
        with pytest.raises(InputError, match=words):
            expanded(["fit", name])
