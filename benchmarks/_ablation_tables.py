"""Tables of `benchmarks.noise_ablation`.

Results of a network are {sensor: {noise: [{clip: score} of each seed]}}, for one of SCORES.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hsnoise._core.sheet import Sheet
from hsnoise.enhance.training import tables

NOISES = ("gaussian", "poisson-gaussian", "paper", "improved")
REAL, SHUFFLED = "real darks", "shuffled darks"
LIMITS = (REAL, SHUFFLED)
SCORES = {"psnr_db": "PSNR as it is", "psnr_scaled_db": "PSNR scaled", "ssim_scaled": "SSIM scaled"}
DIGITS = {"psnr_db": 2, "psnr_scaled_db": 2, "ssim_scaled": 3}
Seeds = list[dict[str, float]]


def picked(results: dict[str, dict[str, list[dict[str, dict[str, float]]]]], score: str) -> dict[str, dict[str, Seeds]]:
    """One score of results {sensor: {noise: [{clip: {score: value}}]}}."""

    def one(clips: dict[str, dict[str, float]]) -> dict[str, float]:
        return {clip: of[score] for clip, of in clips.items()}

    return {name: {noise: list(map(one, seeds)) for noise, seeds in of.items()} for name, of in results.items()}


def table_of(results: dict[str, dict[str, Seeds]], score: str, network: str) -> Sheet:
    """Mean score of each sensor and noise over seeds and clips, and gains over (b) with their standard errors.

    Last the share of what training on real darks gains that the improved model gains, too.
    """
    over, digits = ("paper", "improved", REAL), DIGITS[score]
    head = ("sensor", *NOISES, *LIMITS, *(f"{name} - poisson-gaussian" for name in over), "share of the gap closed")
    rows = []
    for sensor, of in results.items():
        means = [np.mean([v for clips in of[name] for v in clips.values()]) for name in (*NOISES, *LIMITS)]
        gains = {name: gain_of(apart(of[name], of["poisson-gaussian"])) for name in over}
        told = [f"{mean:+.{digits}f} +- {error:.{digits}f}" for mean, error in gains.values()]
        rows.append((sensor, *(f"{mean:.{digits}f}" for mean in means), *told, _share(of, gains)))
    return Sheet(f"{network} on real dark frames: {SCORES[score]}", head, rows)


def apart(one: Seeds, other: Seeds, share: float = 1.0) -> Seeds:
    """Differences {clip: value} of two noises, seed by seed: the first less this share of the other."""
    return [{clip: of[clip] - share * less[clip] for clip in of} for of, less in zip(one, other, strict=True)]


def _share(of: dict[str, Seeds], gains: dict[str, tuple[float, float]]) -> str:
    """Gain of the improved model over that of real darks, its error from clips; none if real darks gain nothing."""
    (ours, _), (most, error) = gains["improved"], gains[REAL]
    if most < 2 * error or most <= 0:
        return "no gap beyond chance"
    share, base = ours / most, of["poisson-gaussian"]
    _, error = gain_of(apart(apart(of["improved"], base), apart(of[REAL], base), share))
    return f"{100 * share:.0f} +- {100 * error / most:.0f} %"


def gain_of(differences: Seeds) -> tuple[float, float]:
    """Mean of differences {clip: value} of several seeds, and its standard error: over clips or seeds, if larger.

    Seeds hold out different clips, so both contain the scatter between clips, and the second that between trainings.
    If more seeds repeat the clips, only the first contains the scatter between clips, and both are added.
    """
    clips = sorted({clip for of in differences for clip in of})
    of_clips = [[of[clip] for of in differences if clip in of] for clip in clips]
    of_seeds = [list(of.values()) for of in differences]
    errors = [standard_error([float(np.mean(values)) for values in groups]) for groups in (of_clips, of_seeds)]
    mean, repeated = float(np.mean([value for of in of_seeds for value in of])), any(len(of) > 1 for of in of_clips)
    return mean, float(np.hypot(*errors)) if repeated else max(errors)


def standard_error(means: Sequence[float]) -> float:
    """Standard error of the mean of these means; 0 for a single one, which cannot show it."""
    return tables.standard_error(means) if len(means) > 1 else 0.0
