"""Noise of rows that are read together: one offset for several rows, in one converter bank or several."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar, cfa_tile
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import MOST_LINES, is_whole, param

TINY = 1e-12  # a shared part whose root has a derivative


class RowGroupNoise(AbstractEffect):
    """Offset of a group of rows, Normal(0, sigma^2) in e-, new in each group and in each frame.

    Fast sensors convert several rows at a time, with one ramp and one reference, whose noise all of them get. Even and
    odd rows, or columns, may be converted by banks of their own, above and below the pixels: each bank has an offset in
    a group, a share of the variance being common to all banks.

    In dark frames: streaks as wide as a group, whose edges lie at the same rows in all frames. A row equals the others
    of its group and bank, and tells nothing of the next group. `diagnose` and fits take the groups from the frames;
    fits hold them.

    Attributes:
        rows: number of rows that are read together.
        start: the first row of the sensor at which a group begins, less than `rows`.
        row_banks, column_banks: 2 if even and odd rows (columns) have banks of their own, else 1.
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Seen on the Sony IMX541: groups of eight rows with four banks. Reference: Kawahito, "Column-parallel ADCs for CMOS
    image sensors and their FoM-based evaluations", IEICE Trans. Electron. E101-C, 2018.
    """

    name: ClassVar[str] = "row_group_noise"
    stage: ClassVar[Stage] = Stage.READ
    selection_nats: ClassVar[float] = 5.0  # its groups are the best of some hundred divisions of the rows
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over groups")
    shared: Scalar = param("1", low=0, high=1, default=0.0, doc="share of the variance that is common to all banks")
    rows: int = eqx.field(static=True, default=2)
    start: int = eqx.field(static=True, default=0)
    row_banks: int = eqx.field(static=True, default=1)
    column_banks: int = eqx.field(static=True, default=1)
    after_gain: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        bounds = {"rows": (2, MOST_LINES), "row_banks": (1, 2), "column_banks": (1, 2)}
        for field, (low, high) in bounds.items():
            self._check(field, low, high)
        self._check("start", 0, self.rows - 1)

    def _check(self, field: str, low: int, high: int) -> None:
        value = getattr(self, field)
        if not is_whole(value, low, high):
            raise ValueError(
                f"row_group_noise.{field}: expected a whole number from {low} to {high}, got {value!r:.60}."
            )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        groups, banks = capture.sensor_shape[0] // self.rows + 2, self.row_banks * self.column_banks
        drawn = jax.random.normal(key, (signal.shape[0], groups, banks + 1), signal.dtype)
        own, common = drawn[..., :banks], drawn[..., banks:]
        roots = (jnp.sqrt(jnp.maximum(share, TINY)) for share in (1 - self.shared, self.shared))
        offset = self.sigma * sum(root * part for root, part in zip(roots, (own, common), strict=True))
        of_rows = offset.reshape(*offset.shape[:2], self.row_banks, self.column_banks)
        row, column = capture.rows, capture.columns
        in_rows = of_rows[:, (row + self.rows - self.start) // self.rows, row % self.row_banks]
        return signal + capture.offset(in_rows[..., column % self.column_banks], self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if facts.row_groups is None:
            return None
        # A quarter of the read noise, in the groups that the capture shows.
        settings = dict(zip(("rows", "start", "row_banks", "column_banks"), facts.row_groups, strict=True))
        return lambda size, rng: cls(
            0.25 * size * facts.read_noise_e, rng.uniform(0, 0.6), **settings, after_gain=either_side(rng)
        )

    def components(self, capture: Capture) -> dict[str, float]:
        variance, shared = capture.offset_variance(self.sigma**2, self.after_gain), float(self.shared)
        colours = len(cfa_tile(capture.cfa))
        # Rows and columns of one colour in a Bayer sensor are of one bank.
        across, along = (1, 1) if colours > 1 else (self.column_banks, self.row_banks)
        of_row, of_group = ((1 + (n - 1) * shared) / n for n in (across, across * along))
        spread = np.full(capture.shape[0], self.rows / colours * of_group / of_row)
        lines, whole = capture.spread_of_lines(0, spread)
        of_rows = variance * of_row
        return {"row_x_frame": lines * of_rows, "frame": whole * of_rows, "temporal": variance - of_rows}
