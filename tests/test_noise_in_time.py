"""What pixels keep of the frame before, and dark signal that flows without exposure, are told; wandering is neither."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise

SHAPE, FRAMES, GAIN, READ_E = (120, 160), 10, 2.0, 4.0
EXPOSURE_S = (0.01, 0.3, 1.0, 3.0)


def electrons(rng, exposure_s: float, rate: np.ndarray, kept: float = 0.0) -> np.ndarray:
    """Of each pixel in each frame [frame, row, column], read noise included; kept: share left for the next frame."""
    shot = rng.poisson(np.broadcast_to(rate * exposure_s, (FRAMES, *SHAPE)))
    read = READ_E * rng.standard_normal(shot.shape)
    before = np.concatenate([rng.poisson(rate * exposure_s)[None], shot[:-1]]) if kept else shot
    return (1 - kept) * shot + kept * before + read


def capture(change=lambda rng, e: e, waiting_s: float = 0.0, kept: float = 0.0) -> hsnoise.FrameStack:
    rng = np.random.default_rng(4)
    rate, offset = 40 * rng.lognormal(-0.08, 0.4, SHAPE), rng.normal(0, 1.0, SHAPE)
    of = [change(rng, electrons(rng, t + waiting_s, rate, kept)) for t in EXPOSURE_S]
    counts = [np.clip(np.rint(200 + offset + GAIN * e), 0, 65535).astype(np.uint16) for e in of]
    return hsnoise.FrameStack(counts, EXPOSURE_S, white_level=65535, shutter="global")


def fit(*of, **keywords) -> hsnoise.FitResult:
    return hsnoise.fit(capture(*of, **keywords))


def filtered(share: float):
    def change(rng, e):
        out = e.copy()
        for f in range(1, len(e)):
            out[f] = (1 - share) * e[f] + share * out[f - 1]
        return out

    return change


def drifting(rng, e):
    """Offsets of pixels that drift by a fifth of the noise in each frame."""
    return e + 0.2 * READ_E * rng.standard_normal(SHAPE) * np.arange(len(e))[:, None, None]


def wandering(rng, e):
    return e + np.cumsum(0.2 * READ_E * rng.standard_normal(e.shape), axis=0)


def of_frames_and_rows(rng, e):
    return e + 3 * rng.standard_normal((len(e), 1, 1)) + rng.standard_normal((len(e), SHAPE[0], 1))


def blurred(rng, e):
    return (e + np.roll(e, 1, axis=2)) / 2


@pytest.mark.parametrize(("share", "light"), [(0.02, "amber"), (0.1, "red")])
def test_a_filter_over_frames_is_told(share, light):
    found = fit(filtered(share))
    assert str(found.conclusion.light) == light
    assert any("frame before" in doubt for doubt in found.doubts), found.doubts


def test_charge_that_is_kept_is_told_as_a_share_of_the_signal():
    """Beside short darks, which have no charge to keep, 6 % of it had passed unseen, in green (gain 11 % too small)."""
    found = fit(kept=0.06)
    told = [doubt for doubt in found.doubts if "keep some of its charge" in doubt]
    assert told and not found.trustworthy
    share = float(told[0].split("%")[0].split()[-1])
    assert abs(share - 6) < 2


def test_exposures_that_are_not_what_they_say_leave_less_than_no_noise():
    """1 and 4 s as 1 and 2 s: the line ends below no variance, and a read noise of zero had been green."""
    stack = capture()
    wrong = hsnoise.FrameStack(stack.counts[2:], (1.0, 1.5), white_level=65535, shutter="global")
    found = hsnoise.fit(wrong)
    assert any("less than nothing" in doubt for doubt in found.doubts) and not found.trustworthy


def test_a_dark_that_the_camera_subtracts_from_each_frame_is_told():
    """Its fit had given the mean of the noise of all exposures as read noise, with the advice to take longer darks."""
    rng = np.random.default_rng(6)
    rate = 40 * rng.lognormal(-0.08, 0.4, SHAPE)
    counts = [200 + np.rint(electrons(rng, t, rate) - electrons(rng, t, rate)) for t in (0.01, 3.0)]
    stack = hsnoise.FrameStack([one.astype(np.uint16) for one in counts], (0.01, 3.0), shutter="global")
    found = hsnoise.fit(stack, method="line")
    assert any("but their level does not" in doubt for doubt in found.doubts) and str(found.conclusion.light) == "red"


@pytest.mark.parametrize("change", [lambda rng, e: e, drifting, wandering, of_frames_and_rows])
def test_nothing_else_is_taken_for_it(change):
    assert not any("frame before" in doubt for doubt in fit(change).doubts)


def test_dark_signal_without_exposure_is_told():
    told = [note for note in fit(waiting_s=0.2).notes if "longer" in note]
    assert told and "lasted 0.2 s longer" in told[0]
    assert not any("longer:" in note for note in fit().notes)


def test_inspect_says_so_before_any_fit():
    assert any("frame before" in one for one in hsnoise.inspect(capture(filtered(0.1))).findings)
    assert not hsnoise.inspect(capture(of_frames_and_rows)).findings
    assert any("smoothed" in one for one in hsnoise.inspect(capture(blurred)).findings)
