"""A few pixels with much larger dark current."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.poisson import normal_of_bits, pixel_words, poisson_of_bits, uniform_of_bits, words_at
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

PIECES, LEAST_PIECE = 32, 64  # of the sensor: its hot pixels are drawn piece by piece


class HotPixels(AbstractEffect):
    """Extra dark electrons, Poisson(rate_i * exposure + at_readout_i), in a fraction of the pixels, always the same.

    Defects of the silicon, many by radiation, generate charge. Every pixel is hot with probability `fraction`,
    independently; the rates of hot pixels are exponentially distributed with mean `rate`, or, as defects differ in
    energy and field, exponential about means that are log-normal: `spread` is the standard deviation of their
    logarithm, and a few pixels are then hundreds of times as hot as most. They generate charge also while a frame waits
    to be read, for the same time in each frame: `at_readout` is proportional to the rate.

    A single generation centre emits a hole, then an electron: if both steps take equally long, every second arrival of
    a Poisson process is an electron, and the variance of many is half of their mean. `fano` is that ratio for large
    charges: a share 2 (1 - fano) of the charge arrives this way, the rest is Poisson.

    In dark frames: bright dots at fixed places that grow with exposure, each with its own shot noise; in slow sensors
    they also show, fainter, in bias frames.

    References: Cox, *Renewal Theory*, 1962; Hopkinson, Dale, Marshall, "Proton effects in charge-coupled devices", IEEE
    Trans. Nucl. Sci. 43, 1996.
    """

    name: ClassVar[str] = "hot_pixels"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    measurable: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    fraction: Scalar = param("1", low=0, high=1, doc="fraction of pixels that are hot")
    rate: Scalar = param("e-/s", low=0, held="at bounds", amplitude=True, doc="mean extra dark current of a hot pixel")
    at_readout: Scalar = param(
        "e-",
        low=0,
        default=0.0,
        held="at bounds",
        amplitude=True,
        doc="mean extra electrons of a hot pixel whatever the exposure",
    )
    fano: Scalar = param("1", low=0.5, high=1, default=1.0, held="at bounds", doc="variance over mean of hot charge")
    spread: Scalar = param(
        "1", low=0, default=0.0, held="at bounds", doc="standard deviation of ln of hot pixels' mean rates"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        where, how_much = jax.random.split(capture.fixed_key(self.name))
        frames, pixels = len(signal), signal[0].size
        hot = uniform_of_bits(pixel_words(where, (1, *signal.shape[1:]))[0]).ravel() <= self.fraction
        so_far = jnp.cumsum(hot.astype(jnp.int32))
        charge = jax.lax.stop_gradient(self.rate * capture.exposure_s + self.at_readout)
        number = so_far[-1]  # without charge, too: a number of its own for each exposure makes loops over them slow
        piece = min(pixels, max(pixels // PIECES, LEAST_PIECE))
        frame = jax.lax.broadcasted_iota(jnp.uint32, (frames, piece), 0)

        def one_more(state):
            """Draw the next hot pixels: they are few, and the others need no numbers."""
            done, drawn = state
            at = jnp.searchsorted(so_far, done + 1 + jnp.arange(piece, dtype=jnp.int32)).astype(jnp.uint32)
            mean = charge * self._strength(*words_at(how_much, jnp.zeros_like(at), at))
            electrons = self._electrons(*words_at(key, frame, at[None]), mean[None])
            return done + piece, drawn.at[:, at].set(electrons.astype(drawn.dtype), mode="drop")

        begun = jnp.zeros_like(number), jnp.zeros((frames, pixels), signal.dtype)
        drawn = jax.lax.while_loop(lambda state: state[0] < number, one_more, begun)[1]
        return signal + drawn.reshape(signal.shape)

    def _strength(self, first: jax.Array, second: jax.Array) -> jax.Array:
        """Charge of hot pixels over their mean charge, from two random words for each."""
        spread = jax.lax.stop_gradient(self.spread)
        return -jnp.log(uniform_of_bits(first)) * jnp.exp(spread * normal_of_bits(second) - spread**2 / 2)

    def _electrons(self, first: jax.Array, second: jax.Array, mean: jax.Array) -> jax.Array:
        """Electrons, from two random words for each."""
        in_pairs = 2 * (1 - jax.lax.stop_gradient(self.fano))
        # The lowest bit tells whether the first hole came before the exposure; counts follow from the highest ones.
        steps = poisson_of_bits(second, 2 * in_pairs * mean) + (second & 1)
        return poisson_of_bits(first, (1 - in_pairs) * mean) + jnp.where(in_pairs > 0, jnp.floor(steps / 2), 0.0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        def make(size: float, rng: np.random.Generator) -> HotPixels:
            # From just above the read noise to far beyond it, in three pixels of a thousand: a few dozen in any frame.
            charge = np.exp(rng.uniform(np.log(4), np.log(120))) * facts.read_noise_e
            fraction = min(0.003 * size, 0.2)
            if not facts.has_exposure:  # collected while bias frames wait to be read
                return cls(fraction, 0.0, charge)
            rate = charge / facts.longest_s
            # In some sensors a hundredth of the charge while a frame waits to be read, which only a bias frame tells.
            return cls(fraction, rate, rng.choice([0.0, 0.01]) * rate * facts.longest_s if facts.has_bias else 0.0)

        return make

    def components(self, capture: Capture) -> dict[str, float]:
        if self.fano < 1:  # the variance of a few electrons in pairs has no simple formula
            return {}
        mean = float(self.rate * capture.exposure_s + self.at_readout)
        # Exponential charges have twice the square of their mean as their mean square.
        square = 2 * np.exp(float(self.spread) ** 2)
        static = float(self.fraction) * (square - float(self.fraction)) * mean**2
        return {
            "pixel": capture.offset_variance(static),
            "temporal": capture.offset_variance(float(self.fraction) * mean),
        }
