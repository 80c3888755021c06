"""A gain register that only single bright pixels show."""

from __future__ import annotations

from collections.abc import Iterator

from hsnoise.fitting.result import FitResult


def of_register(result: FitResult) -> Iterator[str]:
    """That hits or glitches look like multiplied electrons, where neither flats nor a dark current tell."""
    register = None if result.transfer is None else result.transfer.channels[0].register
    if register is not None and not register.confirmed:
        yield (
            "The gain rests on single bright pixels, which look like electrons that a register multiplied (EMCCD). If"
            " the camera has none, they are hits or glitches, and the gain is wrong. Flats at the same setting, or"
            " longer darks whose dark current shows, would tell."
        )
