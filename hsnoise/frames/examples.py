"""The real capture that comes with hsnoise."""

from __future__ import annotations

from importlib.resources import as_file, files
from os import PathLike
from pathlib import Path

from hsnoise._core.output import write_atomically


def st8(folder: str | PathLike) -> Path:
    """Write the example capture to a folder as an astronomer would keep it: FITS in dark3s/, dark25s/ and flat3s/.

    The camera is an SBIG ST-8, an astronomical CCD, at -10 degrees Celsius: 6 darks of 3 s, 7 darks of 25 s and 5
    flats of 3 s, 240 x 320 pixels from the middle of the sensor. Public domain (CC0); its README.txt names the source.

    Args:
        folder: created if it does not exist; files of the same names are replaced.

    Returns:
        the folder, to pass to `hsnoise.load`, `fit` or `inspect`.

    Raises:
        OSError: the folder cannot be written.
    """
    folder = Path(folder)
    with as_file(files("hsnoise.frames") / "data" / "st8") as shipped:
        for path in sorted(one for one in shipped.rglob("*") if one.is_file()):
            target = folder / path.relative_to(shipped)
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(target, path.read_bytes())
    return folder
