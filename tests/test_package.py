"""The wheel: what is in it, and that it works where nothing else of the project is."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MOST_BYTES = 10_000_000
USES = {  # what each extra is for
    "dask": """
import dask.array as da, numpy as np, hsnoise
darks = hsnoise.sample_dark(0, 4, (64, 64), hsnoise.cameras.grasshopper3(), exposure_s=0.1)
print(hsnoise.fit(da.from_array(np.asarray(darks)[None], chunks=(1, 1, 64, 64)), exposure_s=[0.1], cfa="RGGB"))
""",
    "video": """
import hsnoise.cli.main, numpy as np
np.savez("clip.npz", frames=np.full((2, 32, 32, 3), 128, np.uint8))
assert hsnoise.cli.main.main(["sample", "canon_5d3", "--shape", "64x64", "--out", "raw.npz"]) == 0
assert hsnoise.cli.main.main(["enhance", "raw.npz", "bright.mp4", "--camera", "canon_5d3"]) == 0
""",
    "pandas": "import hsnoise; assert len(hsnoise.cameras.canon_5d3().to_pandas()) > 5",
    "vgg": """
from pathlib import Path
import numpy as np
from safetensors.numpy import save_file
from hsnoise.enhance.training.vgg import LAYERS, read_weights
state = {f"features.{i}.weight": np.zeros((o, c, 3, 3), np.float32) for i, c, o in LAYERS}
state |= {f"features.{i}.bias": np.zeros(o, np.float32) for i, _, o in LAYERS}
save_file(state, "vgg.safetensors")
assert len(read_weights(Path("vgg.safetensors"))[0]) == 2 * len(LAYERS)
""",
    "peers": """
import numpy as np
from hsnoise.enhance.training.rivals import rivals
frames = np.random.default_rng(0).random((8, 24, 24, 3)).astype(np.float32)
assert {"BM3D", "BM4D over frames"} <= set(rivals())
for name in ("BM3D", "BM4D over frames"):
    assert np.isfinite(rivals()[name](frames, 0.1)).all()
""",
}


def run(*words: str | Path, cwd: Path, ends: tuple[int, ...] = (0,)) -> str:
    """What a command prints, run outside of the checkout; fails with what it says unless it `ends` as expected."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([*map(str, words)], cwd=cwd, env=clean, capture_output=True, text=True)
    assert done.returncode in ends, f"{' '.join(map(str, words))}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def registry(tmp_path_factory) -> None:
    """Skips where pip finds no packages."""
    pytest.importorskip("pip")
    folder = tmp_path_factory.mktemp("registry")
    found = subprocess.run(
        [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--retries", "0", "-d", str(folder), "hatchling"],
        capture_output=True,
        text=True,
    )
    if found.returncode:
        pytest.skip(f"no package registry: {found.stderr.strip().splitlines()[-1]}")


@pytest.fixture(scope="module")
def wheel(registry, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT, cwd=folder)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The folder of the commands of an environment that holds the wheel and what it requires, nothing else."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=True)
    commands = folder / ("Scripts" if os.name == "nt" else "bin")
    run(commands / "python", "-m", "pip", "install", "-q", wheel, cwd=folder)
    return commands


def beside(installed: Path, folder: Path, package: str) -> Path:
    """Python of an environment of its own that sees the installed wheel and has one package more."""
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    where = "import site; print(site.getsitepackages()[0])"
    shared, own = (run(one, "-c", where, cwd=folder).strip() for one in (installed / "python", python))
    (Path(own) / "shared.pth").write_text(shared)
    run(python, "-m", "pip", "install", "-q", package, cwd=folder)
    return python


def test_the_wheel_holds_the_whole_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    package = {path.relative_to(ROOT).as_posix() for path in (ROOT / "hsnoise").rglob("*") if path.is_file()}
    package = {name for name in package if "__pycache__" not in name}
    assert {
        "hsnoise/py.typed",
        "hsnoise/enhance/data/enhancer_canon_5d3.eqx",
        "hsnoise/enhance/data/enhancer_grasshopper3.eqx",
        "hsnoise/frames/data/st8/README.txt",
    } <= package
    assert len([name for name in package if name.endswith(".fits.fz")]) == 18
    about = f"hsnoise-{PROJECT['version']}.dist-info/"
    assert {name for name in names if not name.startswith(about)} == package
    assert f"{about}licenses/LICENSE" in names
    assert wheel.stat().st_size < MOST_BYTES


def test_the_wheel_says_what_it_is(wheel):
    with zipfile.ZipFile(wheel) as file:
        about = f"hsnoise-{PROJECT['version']}.dist-info"
        metadata = Parser().parsestr(file.read(f"{about}/METADATA").decode())
        assert "hsnoise = hsnoise.cli.main:main" in file.read(f"{about}/entry_points.txt").decode()
    assert metadata["License-Expression"] == "Apache-2.0"
    assert not [one for one in metadata.get_all("Classifier") if one.startswith("License")]  # the expression says it
    assert "Typing :: Typed" in metadata.get_all("Classifier")
    assert set(metadata.get_all("Provides-Extra")) == set(PROJECT["optional-dependencies"])


def test_the_citation_names_this_version():
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.slow
def test_the_installed_package_works_outside_of_the_checkout(installed, tmp_path):
    command = installed / "hsnoise"
    assert f"hsnoise {PROJECT['version']} (Python 3." in run(command, "--version", cwd=tmp_path)
    exposures = ("--exposure", "0.05,0.2,0.8")
    run(command, "sample", "canon_5d3", *exposures, "--shape", "64x96", "--out", "darks.npz", cwd=tmp_path)
    assert np.load(tmp_path / "darks.npz")["counts"].shape == (3, 8, 64, 96)
    assert "dark_current.rate" in run(command, "fit", "darks.npz", "--out", "fit", cwd=tmp_path)
    assert {"model.json", "table.csv"} <= {path.name for path in (tmp_path / "fit").iterdir()}
    code = """
from pathlib import Path
import hsnoise
from hsnoise.enhance.weights import SHIPPED, load_network
folder = Path(hsnoise.__file__).parent
assert (folder / "py.typed").exists() and all(map(load_network, SHIPPED.values()))
print(folder, hsnoise.__version__)
"""
    folder, version = run(installed / "python", "-c", code, cwd=tmp_path).split()
    assert Path(folder).is_relative_to(installed.parent) and version == PROJECT["version"]


@pytest.mark.slow
def test_a_folder_of_fits_files_is_fitted_in_three_commands(installed, tmp_path):
    """Installing is the first; the capture is the one that comes with the package."""
    run(installed / "python", "-c", "import hsnoise; hsnoise.examples.st8('night')", cwd=tmp_path)
    assert "18 frames of 240 rows x 320 columns" in run(installed / "hsnoise", "inspect", "night", cwd=tmp_path)
    run(installed / "hsnoise", "fit", "night", "--out", "fit", cwd=tmp_path)
    table = (tmp_path / "fit" / "table.csv").read_text().splitlines()
    (gain,) = [line for line in table if line.startswith("gain,")]
    assert 2.65 < 1 / float(gain.split(",")[1]) < 2.73  # e-/DN; the header says 2.62


@pytest.mark.slow
def test_the_readme_runs_from_the_wheel(installed, tmp_path):
    """Each command and each line of Python of the README, in order, where only the wheel is installed."""
    python = beside(installed, tmp_path / "own", "av")  # the extra for video
    made = "import hsnoise, shutil; hsnoise.examples.st8('night'); shutil.copytree('night', 'darks');"
    made += " shutil.move('darks/flat3s', 'flats')"
    scene = "; from skimage import data, io; io.imsave('scene.png', data.astronaut()[:192, :256])"
    run(python, "-c", made + scene, cwd=tmp_path)
    little = {"improve": ["--max-steps", "0"], "demo": ["--max-steps", "0"]}
    ran = 0
    for language, block in re.findall(r"^```(python|sh)\n(.*?)^```$", (ROOT / "README.md").read_text(), re.M | re.S):
        if language == "python":
            run(python, "-c", f"import numpy as np\n{block}", cwd=tmp_path)
            ran += 1
            continue
        for line in block.splitlines():
            program, *words = shlex.split(line, comments=True) or [""]
            if program == "hsnoise":
                more = little.get(words[0], [])  # a model of so few steps may be one that should not be used
                run(python, "-m", "hsnoise", *words, *more, cwd=tmp_path, ends=(0, 1) if more else (0,))
                ran += 1
    assert ran >= 10


@pytest.mark.slow
def test_what_belongs_to_an_extra_names_it(installed, tmp_path):
    np.savez(tmp_path / "clip.npz", frames=np.zeros((2, 16, 16, 3), np.uint8))
    words = [str(installed / "hsnoise"), "enhance", "clip.npz", "out.mp4"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "pip install 'hsnoise[video]'" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("extra", PROJECT["optional-dependencies"])
def test_every_extra_works_alone(installed, wheel, tmp_path, extra):
    """In an environment of its own, which sees the package but no other extra."""
    python = beside(installed, tmp_path / "own", f"{wheel}[{extra}]")
    run(python, "-c", USES.get(extra, "import hsnoise"), cwd=tmp_path)


@pytest.mark.slow
def test_the_source_distribution_gives_the_same_wheel(installed, wheel, tmp_path):
    python = installed / "python"
    run(python, "-m", "pip", "install", "-q", "hatchling", cwd=tmp_path)
    run(python, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path, cwd=ROOT)
    (source,) = tmp_path.glob("*.tar.gz")
    run(python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, source, cwd=tmp_path)
    (again,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as other:
        assert {i.filename: i.CRC for i in one.infolist()} == {i.filename: i.CRC for i in other.infolist()}
