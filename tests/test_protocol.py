"""The protocol of training and scoring: light, brightness, fixed split, tables."""

from __future__ import annotations

import os
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import constants

from hsnoise.chain.photometry import display_from_linear, linear_from_display
from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, ShotNoise
from hsnoise.enhance.mosaic import electrons_of, mosaic
from hsnoise.enhance.training import evaluate, tables
from hsnoise.enhance.training.anscombe import Anscombe
from hsnoise.enhance.training.clips import Clip
from hsnoise.enhance.training.noisy import camera_of
from hsnoise.enhance.training.protocol import OPTICS, scaled_to
from hsnoise.enhance.training.rivals import DOMAINS, denoised
from hsnoise.enhance.training.scenes import scene_of
from hsnoise.enhance.training.split import split_of
from hsnoise.model import NoiseModel, sample

ROOT = Path(__file__).parent.parent
CLIPS = Path(os.environ.get("HSNOISE_SHARED", ROOT.parent / "shared")) / "clips"


def bare_e(optics, lux):
    """Equation 9 by hand, with light on the sensor, for one second and one electron a photon."""
    return lux * optics.pixel_pitch_m**2 / (683 * constants.h * constants.c / 555e-9)


@pytest.mark.parametrize("name", OPTICS)
def test_each_correction_of_equation_9_is_stated_with_both_forms(name):
    optics = OPTICS[name]
    lux = optics.lux[1]
    found = optics.corrections(lux)
    t, eta, lens = optics.exposure_s, optics.quantum_efficiency, 1 / (4 * optics.f_number**2)
    right = bare_e(optics, lux) * t * eta * lens
    expected = {"exposure": t, "quantum efficiency": eta, "lens": lens, "all": t * eta * lens}
    assert set(found) == set(expected)
    for correction, factor in expected.items():
        np.testing.assert_allclose(found[correction], (right / factor, right, factor), rtol=1e-6)


def test_the_table_of_corrections_in_the_docs_is_true():
    text = (ROOT / "docs" / "enhancer.md").read_text()
    for name, optics in OPTICS.items():
        for lux in optics.lux:
            for correction, (without, right, ratio) in optics.corrections(lux).items():
                row = f"| {name} | {lux:g} | {correction} | {without:.3g} | {right:.3g} | {ratio:.3g} |"
                assert row in text, row


def test_clips_average_the_electrons_of_their_light_in_units_of_the_camera():
    camera = camera_of("canon_5d3", None, (20.0, 80.0))
    grey = np.full((2, 32, 32, 3), 100, np.uint8)
    half = grey.copy()
    half[:, :, 16:] = 0
    for frames in (grey, half):  # a darker clip gets the same light
        scene = scene_of(Clip("clip", frames), camera, 40.0, 32, 0)
        assert (scene.white_e * np.asarray(linear_from_display(scene.clean))).mean() == pytest.approx(40, rel=1e-5)
    assert camera.unit_e == pytest.approx(200)
    # The input of the same white does not depend on the rest of the clip but through its light.
    assert scene_of(Clip("clip", grey), camera, 40.0, 32, 0).noisy_e.mean() == pytest.approx(40, rel=0.1)
    with pytest.raises(ValueError, match="clip night: expected some light"):
        scene_of(Clip("night", 0 * grey), camera, 40.0, 32, 0)


@pytest.mark.parametrize("factor", [0.1, 0.8, 1.0, 3.0, 20.0])
def test_brightness_is_scaled_by_the_factor_of_the_light(rng, factor):
    clean = rng.uniform(0.05, 0.95, (3, 16, 16, 3)).astype(np.float32)
    found = np.asarray(display_from_linear(linear_from_display(clean) * factor))
    np.testing.assert_allclose(scaled_to(found, clean), clean, atol=2e-3)


def test_no_output_loses_by_scaling(rng):
    for _ in range(5):
        clean = rng.uniform(0, 1, (2, 12, 12, 3))
        found = rng.uniform(0.2, 2) * clean + rng.normal(0, rng.uniform(0.1, 0.6), clean.shape)
        before = np.mean((np.clip(found, 0, 1) - clean) ** 2)
        scaled = scaled_to(found, clean)
        assert 0 <= scaled.min() and scaled.max() <= 1
        assert np.mean((scaled - clean) ** 2) <= before + 1e-7
    with pytest.raises(ValueError, match="found: expected the shape of the truth"):
        scaled_to(clean[:1], clean)


def bayer(read_e=3.0):
    effects = [ShotNoise(), DarkCurrent(20.0), ReadNoise(read_e), Gain(4.0), BlackLevel(500.0), ADC(65535)]
    return NoiseModel(effects, cfa="RGGB", shutter="global", exposure_s=0.1)


@pytest.mark.parametrize("light_e", [5.0, 12.0, 80.0])
def test_the_transform_of_anscombe_makes_the_variance_1_and_is_unbiased(light_e):
    model = bayer()
    transform = Anscombe.of(model)
    counts = sample(jax.random.key(0), mosaic(np.full((4, 192, 192, 3), light_e, np.float32), "RGGB"), model)
    values = transform.forward(np.asarray(electrons_of(counts, model), float))
    np.testing.assert_allclose(values.var((0, 1, 2)), 1, atol=0.03)
    np.testing.assert_allclose(transform.inverse(values.mean((0, 1, 2))), light_e, rtol=0.01)


def test_the_transform_knows_dark_current_rounding_and_two_greens():
    transform = Anscombe.of(bayer(read_e=2.0))
    np.testing.assert_array_equal(transform.pixels, [1, 2, 1])
    np.testing.assert_allclose(transform.variance_e2, 4 + 2 + 1 / 12 / 16)


@pytest.mark.parametrize("domain", DOMAINS)
def test_rivals_that_change_nothing_give_back_the_scene(domain):
    """A bright scene: the domains and the brightness of an automatic exposure are undone."""
    frames = np.random.default_rng(0).integers(60, 160, (3, 24, 24, 3), dtype=np.uint8)
    scene = scene_of(Clip("bright", frames), camera_of("grasshopper3", None, (1e5, 1e5)), 1e5, 24, 0)
    found = denoised(lambda frames, sigma: frames, scene, 1.0, domain)
    shown = np.asarray(display_from_linear(scene.noisy_e / scene.white_e))
    np.testing.assert_allclose(scaled_to(found, scene.clean), scaled_to(shown, scene.clean), atol=0.01)


def records_of(by_method):
    """Records of two frames, the second 1 dB better, of {method: {clip: dB}}; SSIM is a hundredth of the PSNR."""
    return [
        {"method": m, "clip": c, "mean_e": e, "frame": n, "psnr_db": db + n + e, "ssim": (db + n + e) / 100}
        for m, clips in by_method.items()
        for c, db in clips.items()
        for e in (1.0, 2.0)
        for n in range(2)
    ]


def test_tables_have_errors_over_clips_and_the_paired_lead():
    clips = {
        tables.REFER: {"a": 10.0, "b": 12.0, "c": 17.0},
        tables.OURS: {"a": 15.0, "b": 17.5, "c": 21.5},
        tables.SCALED: {"a": 16.0, "b": 18.5, "c": 22.5},
        tables.AT_BEST: {"a": 17.0, "b": 19.5, "c": 23.5},
        "weak": {"a": 9.0, "b": 9.0, "c": 9.0},
        "strong": {"a": 14.0, "b": 16.0, "c": 21.0},
    }
    records = records_of(clips)
    assert tables.best_rival(records, "psnr_db") == "strong"
    lights, ahead, psnr, ssim, frames = (sheet.markdown() for sheet in tables.tables(records, lambda e: f"{e:g} e-"))
    spread = np.std([14, 16, 21], ddof=1) / np.sqrt(3)
    assert f"| strong | 19.00 ± {spread:.2f} / 0.190 ± {spread / 100:.3f} | 18.50 ± {spread:.2f} /" in lights
    error = np.std([1, 1.5, 0.5], ddof=1) / np.sqrt(3)
    assert f"| {tables.OURS}, PSNR / dB | strong | +1.00 ± {error:.2f} | +1.00 ± {error:.2f} |" in ahead
    assert f"| {tables.SCALED}, PSNR / dB | strong | +2.00 ± {error:.2f} |" in ahead
    assert f"| {tables.AT_BEST}, PSNR / dB | strong | +3.00 ± {error:.2f} |" in ahead
    assert "| a | 12.00 | 17.00 | 18.00 | 19.00 | 11.00 | 16.00 |" in psnr and "| a | 0.120 |" in ssim
    assert "n = 2 |" in frames and f"| strong | 18.50 ± {spread:.2f} /" in frames
    short = [r for r in records if r["clip"] != "a" or r["frame"] == 0]
    assert "2 longest clips" in tables.tables(short, str)[-1].title
    assert "| strong | 20.00 ± 2.50 /" in tables.tables(short, str)[-1].markdown()  # of b and c alone
    # Frames and lights of a clip do not make the error smaller.
    assert tables.standard_error([14, 16, 21]) == pytest.approx(spread) and np.isnan(tables.standard_error([1.0]))


def test_the_network_is_scored_as_it_is_and_scaled():
    camera = camera_of("canon_5d3", None, (20.0, 20.0))
    scene = scene_of(Clip("clip", np.full((3, 16, 16, 3), 100, np.uint8)), camera, 20.0, 16, 0)
    methods = evaluate.methods_of(lambda noisy: np.full(noisy.shape, 1.2, np.float32), None, untrained=False)
    found = evaluate.outputs(methods, scene)
    assert list(found) == [tables.REFER, tables.OURS, tables.SCALED, tables.AT_BEST]
    np.testing.assert_array_equal(found[tables.OURS], 1.0)
    for name in (tables.SCALED, tables.AT_BEST):
        np.testing.assert_allclose(found[name], scene.clean, atol=1e-3)


def test_weights_of_another_protocol_are_told(capsys):
    for about, words in (({}, "trained by an unknown protocol"), ({"protocol": "another one"}, "by another one,")):
        evaluate.note_protocol(Path("weights.eqx"), about)
        assert words in capsys.readouterr().err
    evaluate.note_protocol(Path("weights.eqx"), {"protocol": evaluate.PROTOCOL})
    assert capsys.readouterr() == ("", "")


def clips_of(*names):
    return [Clip(name, np.zeros((1, 8, 8, 3), np.uint8)) for name in names]


def test_a_split_in_a_file_takes_videos_with_all_their_cuts(tmp_path):
    path = tmp_path / "split.toml"
    path.write_text('training = ["a", "b"]\nvalidation = ["c"]\ntest = ["d"]\n')
    found = split_of(clips_of("a", "a_long", "b_long", "c", "d", "d_long", "e"), path)
    assert [[clip.name for clip in clips] for clips in found] == [["a", "b_long"], ["c"], ["d", "d_long"]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('training = ["a"]\nvalidation = ["b"]\ntest = ["a"]', "each video once in .*, got a more often"),
        ('training = ["a"]\nvalidation = ["b"]\ntest = ["x", "y"]', "names x, y, of which --clips has no clip"),
        ('training = ["a"]\nvalidation = ["b"]', "expected the lists training, validation, test"),
        ('training = ["a"]\nvalidation = []\ntest = ["b"]', "names of videos in validation"),
        ("training = [", "expected a TOML file"),
    ],
)
def test_a_wrong_split_is_refused(tmp_path, text, words):
    path = tmp_path / "split.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        split_of(clips_of("a", "b"), path)


def test_the_split_of_the_benchmarks_has_every_clip_once():
    if not CLIPS.is_dir():
        pytest.skip("the benchmarks' clips are not here")
    names = sorted(path.stem for path in CLIPS.glob("*.npz"))
    found = split_of(clips_of(*names), ROOT / "benchmarks" / "split.toml")
    assert {clip.source for clips in found for clip in clips} == {re.sub("_long$", "", name) for name in names}
    sources = [{clip.source for clip in clips} for clips in found]
    assert all({"intel_asl_night", "intel_asl_walk"} <= of or not {"intel_asl_night"} & of for of in sources)
