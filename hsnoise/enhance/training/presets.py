"""Sizes of a training run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """Network and optimiser.

    decay: the learning rate falls to 0 by a cosine, as short runs need; else constant. warm_up: frames that half of the
    examples have seen before those that are learnt from, so that long videos do not get worse.
    """

    maps: int = 64
    kernels: tuple[int, ...] = (3, 5, 5, 3)
    stride: int = 2
    rate: float = 1e-3
    decay: bool = True
    checkpoint: bool = False
    warm_up: int = 0


@dataclass(frozen=True)
class Preset:
    """Sizes of a run; frames: that an example is learnt from; recipe: network and optimiser."""

    steps: int
    batch: int
    frames: int
    side: int
    validate_every: int
    recipe: Recipe

    @property
    def seen(self) -> int:
        """Frames of an example, with those before it is learnt from."""
        return self.frames + self.recipe.warm_up


PRESETS = {
    # In so little light, details below 4 pixels are lost: coarse blocks see four times the scene in the same time.
    "smoke": Preset(200, 4, 4, 64, 100, Recipe(maps=8, stride=4, rate=5e-3)),
    "cpu": Preset(4_400, 4, 12, 64, 500, Recipe(maps=16, stride=4, rate=2e-3, warm_up=24)),
    # The same network, and so as fast in use, from 36 times as many pieces.
    "gpu": Preset(20_000, 32, 12, 64, 1000, Recipe(maps=16, stride=4, rate=2e-3, warm_up=24)),
    "paper": Preset(100_000, 8, 8, 64, 1000, Recipe(maps=64, decay=False)),
}
