"""Digital gain: some codes never occur."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Counts, Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import LARGEST_UINT32, check_white_level, param


class MissingCodes(AbstractEffect):
    """The converter works in steps of `gain` DN, and a digital gain stretches its codes: round(gain round(y / gain)).

    Cameras reach their highest sensitivities by multiplying counts. About one in `gain` codes remains; the mean does
    not change, because the model's gain is for the whole camera. Add it after `adc`, so that it acts on counts. With
    gain 1, counts do not change.

    In dark frames: regularly spaced gaps in the histogram of counts, the same in all exposures. `diagnose` takes the
    gain from them; a fit holds it.

    Attributes:
        white_level_dn: largest count, DN, to which stretched codes are clipped; None for that of the integer type.

    Reference: Martinec, "Noise, dynamic range and bit depth in digital SLRs", University of Chicago, 2008.
    """

    name: ClassVar[str] = "missing_codes"
    stage: ClassVar[Stage] = Stage.DIGITAL
    gain: Scalar = param(
        "1", low=1, held=True, amplitude=True, absent=1, doc="digital gain: distance of two codes, DN; fits hold it"
    )
    white_level_dn: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_white_level("missing_codes.white_level_dn", self.white_level_dn)

    def sample(self, signal: Frames | Counts, capture: Capture, *, key: RandomKey) -> Frames | Counts:
        steps = capture.rounded(signal.astype(self.gain.dtype) / self.gain)
        stretched = capture.rounded(steps * self.gain)
        limit = np.iinfo(np.uint16).max if signal.dtype == jnp.uint16 else LARGEST_UINT32
        white = limit if self.white_level_dn is None else min(self.white_level_dn, limit)
        return jnp.minimum(stretched, white).astype(signal.dtype)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # The gain that left gaps between the codes. If there are none, any gain, and the counts speak against it.
        return lambda size, rng: cls(facts.code_step or 1.0 + min(size, 1.0) * rng.uniform(0.1, 1.5))
