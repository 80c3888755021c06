"""Calibrated cameras: Table 2 of Wang et al., ICCV 2019."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, RowGain, ShotNoise
from hsnoise.model import NoiseModel


def canon_5d3(
    *,
    black_level_dn: float | Sequence[float] = 0.0,
    white_level_dn: float | None = None,
    cfa: str = "RGGB",
    shutter: str = "rolling",
    exposure_s: float = 0.05,
) -> NoiseModel:
    """Canon 5D Mark III at ISO 25600: rolling shutter, row gains with a 1/f spectrum, counts clip at black.

    Args:
        black_level_dn: black level, DN, one number or one for each of R, G, B; the paper has 0.
        white_level_dn: largest count, DN; None for no upper limit.
        cfa: 2x2 Bayer string.
        shutter: "rolling" (1/f row gains) or "global" (white ones).
        exposure_s: default exposure, s.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019, Table 2.
    """
    return _camera(
        gain_dn_per_e=(1.53, 1.23, 1.31),
        row_gain_variance=(0.197, 0.039, 0.013),
        dark_current_e_per_s=51.7,
        read_noise_variance_e2=12.5,
        black_level_dn=black_level_dn,
        white_level_dn=white_level_dn,
        cfa=cfa,
        shutter=shutter,
        exposure_s=exposure_s,
    )


def grasshopper3(
    *,
    black_level_dn: float | Sequence[float] = 0.0,
    white_level_dn: float | None = None,
    cfa: str = "RGGB",
    shutter: str = "global",
    exposure_s: float = 0.03,
) -> NoiseModel:
    """FLIR Grasshopper3 GS3-U3-32S4C at 48 dB: global shutter, white row gains. Arguments as in `canon_5d3`.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019, Table 2.
    """
    return _camera(
        gain_dn_per_e=(3.54, 3.11, 3.95),
        row_gain_variance=(0.0081, 0.0069, 0.026),
        dark_current_e_per_s=118.0,
        read_noise_variance_e2=5.43,
        black_level_dn=black_level_dn,
        white_level_dn=white_level_dn,
        cfa=cfa,
        shutter=shutter,
        exposure_s=exposure_s,
    )


def _camera(
    *,
    gain_dn_per_e: Sequence[float],
    row_gain_variance: Sequence[float],
    dark_current_e_per_s: float,
    read_noise_variance_e2: float,
    black_level_dn: float | Sequence[float],
    white_level_dn: float | None,
    cfa: str,
    shutter: str,
    exposure_s: float,
) -> NoiseModel:
    return NoiseModel(
        [
            ShotNoise(),
            DarkCurrent(dark_current_e_per_s),
            ReadNoise(read_noise_variance_e2**0.5),
            RowGain(np.sqrt(row_gain_variance), 1.0 if shutter == "rolling" else 0.0),
            Gain(gain_dn_per_e),
            BlackLevel(black_level_dn),
            ADC(white_level_dn),
        ],
        cfa=cfa,
        shutter=shutter,
        exposure_s=exposure_s,
    )
