"""Options and files that are wrong: one sentence, exit status 2, at once, and nothing is written."""

from __future__ import annotations

import gc
import os
import shlex
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hsnoise
from hsnoise.cli.main import main

MOST_S = 2.0
OF_CAPTURES = """
--exposure -1 | --exposure nan | --exposure 1e999 | --exposure 1/0 | --exposure 1,2,3 | --exposure 1,,2 | --exposure=
--black-level nan | --black-level -5 | --black-level inf | --black-level 1e9 | --black-level 1,2 | --black-level x
--white-level nan | --white-level -1 | --white-level 0 | --white-level 50 | --white-level inf | --white-level 1e400
--cfa RGGB --roi 0:3,0:3 | --cfa ABCD | --cfa '' | --shutter open | --kind bias | --kind dork
--row-axis 2 | --row-axis -1 | --row-axis x
--roi 5:2,0:4 | --roi -5:2,0:4 | --roi 0:0,0:4 | --roi 0:99999999999999999999,0:4 | --roi a:b,c:d | --roi :,: | --roi 1
--overscan 9:1,: | --overscan 0:99,: | --overscan :,: | --overscan x | --overscan 0:5,0:5
--flats nowhere | --flats empty | --flats darks.npz --flats-exposure -1
"""
OF_FITS = """
--method magic | --pixels some | --seed 3 | --exposure | --ou x
--maps x.jpg | --maps nowhere/x.npz | --maps empty | --maps folder.npz | --maps file.txt/x.npz
--out file.txt | --out loop | --out file.txt/x | --out /proc/nowhere | --out /dev/full
--model nowhere.json | --model empty.json | --model bytes.json | --model empty | --model darks.npz | --model ''
"""
OF_SAMPLES = """
--frames -1 | --frames 0 | --frames 1e9 | --frames 99999999999999 | --frames 9999999999999999999999999999999999
--shape -4x4 | --shape 4x | --shape 4x4x4 | --shape 1e3x4 | --shape 99999999999999999999999x2 | --shape 3x3
--exposure -1 | --exposure nan | --exposure 1e300 | --exposure 1/0 | --exposure 1s2
--seed -1 | --seed 1.5 | --seed x | --seed 99999999999999999999
--mean-e nan --clean clean.npy | --mean-e inf --clean clean.npy | --mean-e -1 --clean clean.npy | --mean-e 5
--mean-e 5 --clean zero.npy | --clean nan.npy | --clean negative.npy | --clean odd.npy | --clean text.npy
--clean complex.npy | --clean archive.npy | --clean objects.npy | --clean one.npy | --clean nowhere.npy
--clean cut.png | --clean cut.npy | --clean cut-archive.npy | --clean no-bytes.npy | --clean large.png
--clean broken.png | --clean broken.tif | --clean empty | --clean loop | --clean file.txt
--out empty | --out folder.npz | --out file.txt/x.npz | --out nowhere/x.npz | --out /dev/full
--out x.tif --shape 8x8 --exposure 1e30 | --out x.tif --shape 8x8 --exposure 1e-12
--out x.tif --shape 8x8 --exposure 1,2
--out x | --out /proc/x.npz --shape 8x8
"""
OTHERS = """
fit nowhere | fit empty | fit loop | fit model.json | fit '*.xyz' | fit /dev/null | fit /dev/zero | fit '' | fit
inspect | inspect nowhere | inspect darks.npz --json --black-level nan | inspect bytes.npz
compare darks.npz | compare darks.npz --model nowhere | compare darks.npz --model grasshopper
compare darks.npz --model model.json | compare darks.npz --model canon_5d3 --seed -1
compare darks.npz --model canon_5d3 --seed 1e3 | compare darks.npz --model canon_5d3 --report empty
compare darks.npz --model canon_5d3 --report x.pdf | compare darks.npz --model canon_5d3 --report nowhere/x.html
diagnose darks.npz --report /dev/full/x.html | diagnose darks.npz --model nowhere
improve darks.npz --max-minutes 0 | improve darks.npz --max-minutes nan | improve darks.npz --max-minutes -1
improve darks.npz --max-minutes inf | improve darks.npz --max-steps -1 | improve darks.npz --max-steps 1.5
improve darks.npz --out file.txt | demo --data nowhere --out file.txt | demo --max-minutes 0
sample empty.json --out x.npz | sample bytes.json --out x.npz | sample empty --out x.npz | sample '' --out x.npz
enhance nowhere x.mp4 | enhance empty x.mp4 | enhance file.txt x.mp4 | enhance darks.npz empty --camera canon_5d3
enhance darks.npz x.mp4 --camera nowhere | enhance darks.npz x.xyz --camera canon_5d3
enhance darks.npz x.mp4 --camera canon_5d3 --weights nowhere
enhance darks.npz x.mp4 --camera canon_5d3 --weights empty
enhance darks.npz x.mp4 --camera canon_5d3 --weights file.txt | enhance darks.npz x.mp4 --camera canon_5d3 --tile 0
enhance darks.npz x.mp4 --camera canon_5d3 --tile 7 | enhance darks.npz x.mp4 --camera canon_5d3 --brighten nan
enhance darks.npz x.mp4 --camera canon_5d3 --rate nan | enhance darks.npz nowhere/x.mp4 --camera canon_5d3
train nowhere | train empty --out file.txt | evaluate nowhere | evaluate empty | fitt darks.npz | --frobnicate
"""


def listed(text: str) -> list[str]:
    return [one.strip() for line in text.strip().splitlines() for one in line.split("|")]


ATTACKS = [
    *(f"fit darks.npz {options}" for options in listed(OF_CAPTURES) + listed(OF_FITS)),
    *(f"sample canon_5d3 --out x.npz {options}" for options in listed(OF_SAMPLES)),
    *listed(OTHERS),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("options")
    dark = np.random.default_rng(0).poisson(100, (4, 16, 24)).astype(np.uint16)
    np.savez(folder / "darks.npz", counts=dark, exposure_s=0.1)
    light = np.full((16, 24), 5.0)
    images = {
        "clean": light,
        "nan": light * np.nan,
        "negative": -light,
        "zero": 0 * light,
        "odd": light[1:, 1:],
        "one": light[0],
        "complex": light * 1j,
        "text": np.array(["light"]),
        "objects": np.array([{}], object),
    }
    for name, image in images.items():
        np.save(folder / f"{name}.npy", image, allow_pickle=True)
    np.savez(folder / "archive.npz", light=light)
    (folder / "archive.npz").rename(folder / "archive.npy")
    hsnoise.cameras.canon_5d3().save(folder / "model.json")
    for name in ("empty", "folder.npz"):
        (folder / name).mkdir()
    for name in ("bytes.json", "bytes.npz", "broken.png", "broken.tif"):
        (folder / name).write_bytes(b"\xff\xfe{}")
    Image.fromarray(light.astype(np.uint8)).save(folder / "clean.png")
    png = (folder / "clean.png").read_bytes()
    (folder / "large.png").write_bytes(png[:16] + struct.pack(">II", 100_000, 100_000) + png[24:])
    for name, suffix, length in (("clean", ".png", 50), ("clean", ".npy", 300), ("archive", ".npy", 300)):
        content = (folder / f"{name}{suffix}").read_bytes()[:length]
        (folder / f"cut{'-archive' if name == 'archive' else ''}{suffix}").write_bytes(content)
    (folder / "no-bytes.npy").write_bytes(b"")
    (folder / "empty.json").write_text("")
    (folder / "file.txt").write_text("text")
    os.symlink("loop", folder / "loop")
    return folder


@pytest.fixture
def no_collection():
    """In a process with many compiled programs, collecting garbage takes seconds, which would count as work."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("no_collection")
@pytest.mark.parametrize("words", ATTACKS)
def test_is_one_sentence(words, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before, began = set(folder.rglob("*")), time.process_time()
    try:
        status = main(shlex.split(words))
    except SystemExit as ended:  # argparse
        status = ended.code
    assert time.process_time() - began < MOST_S
    said = capsys.readouterr().err.splitlines()
    assert status == 2 and [line.startswith("hsnoise: ") for line in said].count(True) == 1, said
    assert said[-1].startswith("hsnoise: ") and "Traceback" not in "".join(said)
    assert set(folder.rglob("*")) == before
