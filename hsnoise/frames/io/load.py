"""Reading captures from camera raw, DNG, FITS, TIFF, PNG, NumPy and HDF5 files into a `FrameStack`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hsnoise._core.arguments import one_of
from hsnoise._core.types import BAYER_CFAS, SHUTTERS
from hsnoise.frames.io._capture import read_capture
from hsnoise.frames.stack import FrameStack


def load(
    path: Any,
    *,
    exposure_s: Any = None,
    kind: str | Sequence[str] | None = None,
    cfa: str | None = None,
    black_level: Any = None,
    white_level: float | None = None,
    shutter: str | None = None,
    row_axis: int = 0,
    roi: tuple[Any, Any] | None = None,
    overscan: str | tuple[Any, Any] | None = None,
    hdu: int | str | None = None,
    progress: bool = True,
) -> FrameStack:
    """Read a capture: dark frames, flat frames or both, of one camera at one gain setting.

    Only headers are read now, and one frame per file of flats; other frames are read one at a time when the stack is
    iterated (.npz files are loaded whole, .gz files unpacked whole). Frames of one kind whose exposures agree to 1e-3
    form a group: darks first, short before long. Flats of one exposure whose light differs by more than 5 % form
    several groups. Arguments override what the files state; a warning reports exposures that differ.

    Frames that do not belong with the others (lights, masters, another format, size, binning, gain, ISO or temperature)
    are set aside, and flats of another crop go to `elsewhere`. The stack's `assumed` reports all this.

    Args:
        path: a folder, a glob pattern, one file, or a list of files and folders. Files in and below a folder are read
            in natural order (frame2 before frame10); files of unknown formats are skipped. In a folder with
            EMVA1288_Data.txt, that file says what to read.
        exposure_s: exposure time, s; one for all, or one per file (one per exposure if a file holds several).
        kind: "dark" or "flat", likewise. None: as the files state, or else by the names of files and folders
            (bias, zero, dark, flat, darkflat, ...), or else "dark".
        cfa: "mono" or the Bayer order of the first stored pixel. None: as the files state, or "mono".
        black_level, white_level: DN; black is one value or one per channel. None: as the files state; if they do
            not, black is estimated and white unknown.
        shutter: "rolling" or "global". None: as the files state, or "rolling".
        row_axis: axis of a stored frame that counts sensor rows; 1 for frames stored in portrait.
        roi: ((first row, end row), (first column, end column)) in sensor coordinates, ends excluded; either
            may be None. Odd starts rotate `cfa`.
        overscan: "auto" removes rows or columns at the edges that do not follow the light of flats, or that the
            headers name, and keeps their means in `overscan_dn`. ((first row, end row), (first column, end column)),
            one of them None, removes these. None only names what is found.
        hdu: which image of FITS files with several, such as those of the amplifiers of one sensor: its number in the
            file (0 is the primary one) or its EXTNAME.
        progress: show a bar on long reads.

    Raises:
        FileNotFoundError: no such file.
        TypeError: `hdu` is neither a number nor a name.
        ValueError: an unreadable file, no exposure time, or frames that do not belong together without a majority;
            the message names the file. Also all errors of `FrameStack`.
    """
    if cfa is not None:
        one_of("cfa", cfa, ("mono", *BAYER_CFAS))
    if shutter is not None:
        one_of("shutter", shutter, SHUTTERS)
    if hdu is not None and (isinstance(hdu, bool) or not isinstance(hdu, int | str)):
        raise TypeError(f"hdu: expected the number or the name of an HDU, got {hdu!r:.60}.")
    options = {"cfa": cfa, "black_level": black_level, "white_level": white_level, "shutter": shutter}
    return read_capture(
        path,
        exposure_s=exposure_s,
        kind=kind,
        overscan=overscan,
        hdu=hdu,
        progress=progress,
        roi=roi,
        row_axis=one_of("row_axis", row_axis, (0, 1)),
        **options,
    )
