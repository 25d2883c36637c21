"""`diffeo-calib images`: a folder of images of a printed board as a table of corners that `fit` reads."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.detection import Board
from diffeo_calib.cameras.files import camera_text
from diffeo_calib.cameras.folder import read_folder
from diffeo_calib.cli.console import progress_bar, say
from diffeo_calib.cli.options import BoardImages
from diffeo_calib.cli.record import record
from diffeo_calib.common.errors import shown
from diffeo_calib.common.files import write_together
from diffeo_calib.measurements.csv.images import IMAGE, PIXEL, POINT
from diffeo_calib.measurements.table_format import TableFormat


def run(folder: Path, joints: Path, given: BoardImages, output: Path) -> None:
    """Find the board, and write corners, camera and overview."""
    table = TableFormat(given.length.value, "rad", given.sep, given.decimal)
    with progress_bar() as progress:
        found = read_folder(folder, joints, Board.of(given.board), table.sep, progress)
    for one in found.images:
        if one.refused:
            say(f"{one.name}: {one.refused}: left out")
    text, camera = io.StringIO(newline=""), output.with_suffix(".yaml")
    sheet = csv.writer(text, delimiter=table.sep)
    sheet.writerow([IMAGE, *found.header, *POINT, *PIXEL])
    sheet.writerows(found.rows(table.per_metre, table.decimal))
    contents = {output: text.getvalue().encode()}
    contents[camera] = camera_text(found.camera(BoardPrior(scale=given.board_std))).encode()
    if given.overview is not None:
        contents[given.overview] = found.page().encode()
    write_together(contents)
    corners = sum(len(one.numbers) for one in found.used)
    width, height = found.size
    used = f"{len(found.used)} of {len(found.images)} images of {width} x {height} pixels"
    say(f"{used}, {corners} corners: {shown(output)}")
    say(
        f"fit {shown(output)} ... --reading corners={shown(camera)}, with --camera-on-tool if the camera is on the tool"
    )
    refused = {one.name: one.refused for one in found.images if one.refused}
    record.add(rows=len(found.used), refused=refused, files={"table": output, "camera": camera})
