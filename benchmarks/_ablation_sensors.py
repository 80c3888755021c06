"""The sensors of `benchmarks.noise_ablation`: what of their captures is fitted, and what no fit sees."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

import hsnoise
from hsnoise import NoiseModel
from hsnoise.likelihood.flat_likelihood import ROUNDING_VARIANCE

OUTSIDE = 6.0  # standard deviations


@dataclass(frozen=True)
class Sensor:
    """A real sensor: the capture to fit, and dark frames [frame, row, column] of one exposure that no fit sees."""

    name: str
    fitted: hsnoise.FrameStack
    unseen: np.ndarray
    exposure_s: float

    @cached_property
    def fitted_darks(self) -> np.ndarray:
        """The fitted darks nearest in exposure, DN [frame, row, column]."""
        stack = self.fitted
        darks = [i for i, kind in enumerate(stack.kind) if kind == "dark"]
        chosen = min(darks, key=lambda i: abs(stack.exposure_s[i] - self.exposure_s))
        return np.stack([stack.frame(chosen, i) for i in range(stack.n_frames[chosen])]).astype(np.float64)

    @cached_property
    def dark_sigma_dn(self) -> float:
        """Temporal standard deviation of these darks, DN, before they were rounded to counts.

        From differences of frames.
        """
        apart = np.diff(self.fitted_darks, axis=0)
        # Cosmic rays are rare and huge: differences far outside the others are clipped to just outside.
        low, high = np.quantile(apart, [0.1587, 0.8413])
        far = OUTSIDE * (high - low) / 2
        return float(np.sqrt(np.mean(np.clip(apart, -far, far) ** 2) / 2 - ROUNDING_VARIANCE))

    def dark_sigma_e(self, params: NoiseModel) -> float:
        return self.dark_sigma_dn / float(np.mean(np.asarray(params["gain"].value)))


def sensors(folder: Path) -> dict[str, Callable[[], Sensor]]:
    def read(name: str):
        return np.load(folder / f"{name}.npz"), json.loads((folder / f"{name}.json").read_text())["arrays"]

    def stack(data, about, frames: dict[str, slice], white: float) -> hsnoise.FrameStack:
        return hsnoise.FrameStack(
            [data[name][part] for name, part in frames.items()],
            [about[name]["exposure_s"] for name in frames],
            kind=["flat" if name.startswith("flat") else "dark" for name in frames],
            white_level=white,
            cfa="mono",
            shutter="global",
        )

    def imx541() -> Sensor:
        # The rows that darks and flats share; six of the eight frames of an exposure are fitted.
        data, about = read("imx541_mono_emva")
        darks = {n: (slice(6), slice(128)) for n in ("dark_000025us", "dark_006443us")}
        flats = {n: (slice(None), slice(128)) for n in ("flat_000272us", "flat_000985us")}
        # At most 6 ms without light, and cooled: the exposures differ only in length.
        unseen = np.concatenate([data[n][6:] for n in data.files if n.startswith("dark")])
        return Sensor("imx541", stack(data, about, darks | flats, 4095), unseen, about["dark_000272us"]["exposure_s"])

    def stl1001() -> Sensor:
        data, about = read("sbig_stl1001_ccd")
        frames = {n: (slice(5), slice(128)) for n in ("bias_m05C", "dark_m05C_060s")}
        frames["flat_m05C_023s"] = (slice(None), slice(128))
        exposure_s = about["dark_m05C_060s"]["exposure_s"]
        return Sensor("stl1001", stack(data, about, frames, 65535), data["dark_m05C_060s"][5:], exposure_s)

    def tc237() -> Sensor:
        data, about = read("sbig_st7e_tc237_ccd_clipped")
        middle = slice(100, 300), slice(200, 456)
        frames = {"bias": (slice(4), *middle), "flat_006s": (slice(None), *middle)}
        return Sensor("tc237", stack(data, about, frames, 65535), data["bias"][(slice(4, None), *middle)], 0.0)

    def emva001() -> Sensor:
        # Twenty darks and flats of one exposure: half of them are fitted, with the pairs of all others.
        whole = hsnoise.load(folder / "emva1288" / "001_CCD_12Bit", progress=False)
        many = next(i for i, n in enumerate(whole.n_frames) if n > 2 and whole.kind[i] == "dark")
        half = whole.n_frames[many] // 2
        fitted = whole.select(frames=[slice(half if n > 2 else None) for n in whole.n_frames])
        unseen = np.stack([whole.frame(many, f) for f in range(half, whole.n_frames[many])])
        return Sensor("emva001", fitted, unseen, float(whole.exposure_s[many]))

    def st8() -> Sensor:
        # Two of the seven darks of 25 s are unseen.
        whole = hsnoise.load(folder / "sbig_st8_cc0", progress=False).select(rows=slice(128))
        longest = int(np.argmax(whole.exposure_s))
        kept = whole.n_frames[longest] - 2
        fitted = whole.select(frames=[slice(kept if e == longest else None) for e in range(whole.n_exposures)])
        unseen = np.stack([whole.frame(longest, f) for f in range(kept, kept + 2)])
        return Sensor("st8", fitted, unseen, float(whole.exposure_s[longest]))

    return {"imx541": imx541, "stl1001": stl1001, "tc237": tc237, "emva001": emva001, "st8": st8}
