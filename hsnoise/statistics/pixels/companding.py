"""Counts that a camera compressed: the brighter, the farther apart are the codes that it uses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise.statistics.pixels.survey import Group, Survey

FEWEST_CODES = 4  # of the middle half of the counts, that tell how far codes are apart
WIDER, LEAST_SHARE = 1.3, 0.005  # of codes under light; of the noise of light, that their rounding adds


def spacing_of(group: Group, channel: int) -> float:
    """How far the codes of a channel are apart, DN, by those that the middle half of the extreme counts uses."""
    values = np.concatenate([group.pixels(channel, name) for name in ("lowest", "highest")])
    low, high = np.quantile(values, (0.25, 0.75)).round()
    inside, width = values[(values >= low) & (values <= high)], high - low + 1
    if width < FEWEST_CODES:
        return 1.0
    by_chance = width * -np.expm1(-len(inside) / width)  # codes that as many counts would hold if all were used
    return max(float(by_chance / len(np.unique(inside))), 1.0)


def companded(found: Survey) -> Iterator[str]:
    """A sentence on flats whose codes lie farther apart than those of darks, if that adds to their noise."""
    for channel in range(len(found.channels)):
        if not found.repeated_darks:
            return
        dark = min(found.repeated_darks, key=lambda group: group.exposure_s)
        of_dark, noise_dn2 = spacing_of(dark, channel), dark.noise_dn**2
        for group in found.repeated_flats:
            of_flat, light_dn2 = spacing_of(group, channel), group.noise_dn**2 - noise_dn2
            rounding_dn2 = (of_flat**2 - of_dark**2) / 12
            if of_flat > WIDER * of_dark and rounding_dn2 > LEAST_SHARE * light_dn2 > 0:
                yield (
                    f"Flats of {group.mean_dn(channel):.0f} DN use one code of {of_flat:.2g}, darks one of"
                    f" {of_dark:.2g}: the camera compresses its counts, and rounding adds"
                    f" {rounding_dn2 / light_dn2:.1%} to the noise of that light. Gain and read noise may be too large"
                    " by several percent; take frames without lossy compression."
                )
                return
