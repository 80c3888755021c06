"""What stands in the documentation runs: each block of code, in order, in a fresh folder beside a real capture."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path

import av
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from astropy.io import fits
from skimage.data import astronaut, coffee
from skimage.io import imsave

import hsnoise
from hsnoise.cli import results
from hsnoise.cli.main import main
from hsnoise.criticism import Step, Story
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.simulation import portion
from hsnoise.simulation.simulator import Simulator

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOK = ROOT / "docs" / "first-hour.ipynb"
BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE, WORDS = {"python", "sh", "console"}, {"text"}
# Long work in little: added to the command, the last of an option counts.
IN_LITTLE = {
    "demo": ["--max-steps", "0"],
    "improve": ["--max-steps", "0"],
    "train": ["--steps", "2", "--preset", "smoke"],
    "evaluate": ["--no-rivals", "--crop", "32"],
}
# Their code runs by default: everyone's first page, and two in seconds; that of the others takes minutes.
QUICK = ("README", "capture-guide", "files")
# Candidates of a diagnosis: what the pages' captures have, and what resembles it.
FEW = ("row_noise", "column_fixed_pattern", "photo_response_nonuniformity", "dark_current_drift", "frame_offset")


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and content of each block of a page; of a notebook each cell of code."""
    if page == NOTEBOOK:
        cells = json.loads(page.read_text())["cells"]
        return [("python", "".join(cell["source"])) for cell in cells if cell["cell_type"] == "code"]
    return BLOCK.findall(page.read_text())


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def commands(block: str) -> list[str]:
    """The commands of a block for a shell; of a transcript those behind the prompt."""
    lines = block.replace("\\\n", " ").splitlines()
    if any(line.startswith("$ ") for line in lines):
        lines = [line[2:] for line in lines if line.startswith("$ ")]
    return [line for line in lines if line.strip() and not line.startswith("#")]


def without_comment(command: str) -> str:
    return shlex.join(shlex.split(command, comments=True))


def without_numbers(text: str) -> list[str]:
    return re.sub(r"[^A-Za-z]+", " ", text).split()


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A fresh folder with what a reader has: frames of a camera, a picture, videos."""
    night = hsnoise.examples.st8(tmp_path / "night")
    for path in night.rglob("*.fits.fz"):  # a quarter of the pixels: pages draw hundreds of such captures
        with fits.open(path) as file:
            middle, header = file[1].data[60:180, 80:240], file[1].header
        fits.CompImageHDU(middle, header).writeto(path, overwrite=True)
    for name in ("dark3s", "dark25s", "flat3s"):
        of = tmp_path / ("flats" if name == "flat3s" else "darks")
        of.mkdir(exist_ok=True)
        for path in (night / name).iterdir():
            (of / f"{name}_{path.name}").write_bytes(path.read_bytes())
    # Arrays on a disk: darks of a colour camera, in chunks.
    camera = hsnoise.cameras.canon_5d3(black_level_dn=512)
    exposures_s = (0.1, 1.0, 10.0)
    drawn = [hsnoise.sample_dark(i, 4, (64, 96), camera, exposure_s=t) for i, t in enumerate(exposures_s)]
    zarr.save(str(tmp_path / "darks.zarr"), np.stack(drawn))
    imsave(tmp_path / "scene.png", astronaut()[:192, :256], check_contrast=False)
    with av.open(str(tmp_path / "dark.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=25, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        for frame in np.random.default_rng(0).integers(0, 90, (4, 96, 128, 3)).astype(np.uint8):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
        file.mux(stream.encode())
    (tmp_path / "clips").mkdir()
    for i in range(4):
        frames = np.stack([coffee()[20 * i : 20 * i + 96, 3 * f : 3 * f + 128] for f in range(12)])
        np.savez(tmp_path / "clips" / f"clip{i}.npz", frames=frames)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def few_draws(monkeypatch):
    """Comparisons by eight draws, for time's sake, and of one size with those of figures: most of it is compilation.

    Figures are drawn, but files of figures stay empty: other tests look at those. A story is that of the first model
    alone: tests/test_logging.py has one from the loop, and the slow tests run all that the pages say.
    """

    stories = {}  # a page's commands are about one capture: its first model is fitted once

    def improved(stack, tell, *, keep, **_):
        capture = (stack.shape, stack.n_frames, *stack.exposure_s, *stack.frame(0, 0)[0])
        if capture not in stories:
            fit = hsnoise.fit(stack)
            first = Step(fit, hsnoise.compare(fit, stack), None, None, 0.0, ())
            stories[capture] = Story((first,), Ending(Ended.STEPS, 0))
        keep(stories[capture])
        return stories[capture]

    monkeypatch.setattr(results, "improved", improved)
    monkeypatch.setattr(results, "write_figure", lambda path, figure: path.touch())
    monkeypatch.setattr(portion, "MOST_PIXELS", 1)  # of four frames and 64 columns
    monkeypatch.setattr(portion, "LEAST_FRAMES", 4)
    monkeypatch.setattr(portion, "MIDDLE", (4, 240, 64))
    reference = Simulator.reference
    monkeypatch.setattr(
        Simulator, "reference", lambda self, model, n, *first: reference(self, model, min(n, 8), *first)
    )


class Reader:
    """Runs a page: Python blocks share their names, commands of hsnoise run in this process."""

    def __init__(self, page: Path, monkeypatch, capsys) -> None:
        self.page, self.capsys, self.said = page, capsys, {}
        self.module = types.ModuleType(f"page_{page.stem.replace('-', '_')}")
        self.module.__dict__.update(np=np, jax=jax, hsnoise=hsnoise)
        monkeypatch.setitem(sys.modules, self.module.__name__, self.module)

    def run(self, language: str, block: str) -> None:
        if language == "python":
            exec(compile(block, name_of(self.page), "exec"), self.module.__dict__)
        elif language in ("sh", "console"):
            # A transcript may show what a command printed that ran before.
            ran = self.said if language == "console" else {}
            said = "".join(ran.get(without_comment(line)) or self.command(line) for line in commands(block))
            if language == "console":
                self.compare(block, said)

    def command(self, line: str) -> str:
        """Run one command; returns what it prints."""
        program, *words = shlex.split(line, comments=True)
        if program == "make":  # installs an environment: tests/test_package.py does that
            words = [word for word in words if "=" not in word]
            return subprocess.run(["make", "-n", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout
        if program == "python":  # benchmarks take long: their options are looked up
            helped = subprocess.run([sys.executable, *words[:2], "--help"], cwd=ROOT, capture_output=True, text=True)
            unknown = [word for word in words if word.startswith("--") and word not in helped.stdout]
            assert helped.returncode == 0 and not unknown, (line, unknown)
            return helped.stdout
        assert program == "hsnoise", f"no such command is run here: {line}"
        self.capsys.readouterr()
        status = main([*words, *IN_LITTLE.get(words[0], [])])
        out, err = self.capsys.readouterr()
        # With so few steps the model may be one that should not be used.
        assert status == 0 or (status == 1 and words[0] in ("fit", "improve")), (
            f"{line}: exit status {status}\n{out}\n{err}"
        )
        self.said[without_comment(line)] = out
        return out

    def compare(self, block: str, said: str) -> None:
        """Whether a transcript shows words that the command still prints."""
        printed = " ".join(without_numbers(said))
        for line in block.splitlines():
            words = " ".join(without_numbers(line))
            if words and not line.startswith("$ ") and line.strip() != "...":
                assert words in printed, f"{name_of(self.page)} shows what is not printed: {line}\n{said}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_says_what_it_is(page):
    """Code is code that runs, or it is called text; blocks by indentation would escape."""
    languages = {language for language, _ in blocks(page)}
    assert languages <= CODE | WORDS, languages
    outside = BLOCK.sub("", page.read_text())
    assert "```" not in outside
    assert not re.search(r"\n\n    \S", outside)
    for language, block in blocks(page):
        if language == "text":
            assert not re.match(r"(\$ )?(hsnoise|pip|make|python|import|from) ", block), block


RUNS = [
    pytest.param(page, library, id=f"{library}-{name_of(page)}", marks=() if quick else pytest.mark.slow)
    for page in (*PAGES, NOTEBOOK)
    if CODE & {kind for kind, _ in blocks(page)}
    for library, quick in (("few", page.stem in QUICK), ("whole", False))
]


@pytest.fixture
def code_of_users():
    """Effects of users may broadcast as NumPy does; the tests of ours may not."""
    strict = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", "allow")
    yield
    jax.config.update("jax_numpy_rank_promotion", strict)


@pytest.mark.usefixtures("code_of_users")
@pytest.mark.parametrize(("page", "library"), RUNS)
def test_page_runs(page, library, folder, request, monkeypatch, capsys):
    if library == "few":
        request.getfixturevalue("few_candidates")
        if page.stem in QUICK:
            request.getfixturevalue("few_draws")
    reader = Reader(page, monkeypatch, capsys)
    if page == NOTEBOOK:  # which writes all pixels
        monkeypatch.setattr(hsnoise.examples, "st8", lambda name: folder / name)
    for language, block in blocks(page):
        reader.run(language, block)
    CHECKS.get(page.stem, lambda _: None)(reader.module)


def _own_effect(page) -> None:
    assert page.without.verdict != "named"
    assert page.found.best.name == page.found.ranking[0].name == "chessboard"
    assert 0.5 < page.found.best.effect.offset < 2  # a first estimate of 1


def _sampling(page) -> None:
    assert page.dark_current == pytest.approx(118, rel=0.1)
    assert page.read_noise == pytest.approx(2.33, rel=0.1)
    np.testing.assert_array_equal(page.counts, hsnoise.sample(jax.random.key(0), page.clean, page.camera))


def _enhancer(page) -> None:
    assert page.enhanced.shape == (48, 64, 3) and np.isfinite(page.enhanced).all()


def _first_hour(page) -> None:
    name = "flats, static pixels"  # where the effects show that the fit adds
    assert page.report.groups[name] < page.paper.groups[name] / 10


CHECKS = {"add-an-effect": _own_effect, "sampling": _sampling, "enhancer": _enhancer, "first-hour": _first_hour}


def test_pytorch_takes_the_draws_without_a_copy():
    torch = pytest.importorskip("torch")
    (block,) = [code for _, code in blocks(ROOT / "docs" / "sampling.md") if "import torch as xp" in code]
    block = block.replace("import numpy as xp", "import torch as xp")
    page = {"jax": jax, "jnp": jnp, "hsnoise": hsnoise, "camera": hsnoise.cameras.grasshopper3()}
    exec(compile(block, "sampling.md", "exec"), page)
    light = torch.full((2, 32, 64), 3.0)
    drawn = page["noisy"](1, light)
    assert drawn.shape == light.shape and drawn.dtype == torch.float32
    expected = hsnoise.sample(jax.random.key(1), np.full((2, 32, 64), 3.0, np.float32), page["camera"])
    np.testing.assert_array_equal(drawn.numpy(), np.asarray(expected, np.float32))
    # The same memory on both sides.
    array = jax.dlpack.from_dlpack(light)
    assert array.unsafe_buffer_pointer() == light.data_ptr()
    assert torch.from_dlpack(array).data_ptr() == array.unsafe_buffer_pointer()
    # In a training loop: the loss of a network on fresh noise falls.
    torch.manual_seed(0)
    network, losses = torch.nn.Conv2d(1, 1, 5, padding=2), []
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    for step in range(30):
        loss = ((network(page["noisy"](step, light)[:, None])[:, 0] - light) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
