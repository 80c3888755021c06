"""Reads cases of the attack in a process of its own, and prints one line of JSON for each.

    python worker.py FIRST END

After the table come more cases of those that are drawn at random. The number of a case is printed before it begins. A
case that takes too long ends the process: a signal that no library holds up.
"""

from __future__ import annotations

import json
import resource
import shutil
import signal
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from breaks import cases
from captures import CLEAN, GIVEN
from case import Case

import hsnoise

MOST_BYTES, MOST_S = 2 << 30, 20
OWN = (ValueError, TypeError, FileNotFoundError, OSError)


def read(folder: Path, format: str) -> tuple[dict[str, Any], set[str]]:
    """What a capture holds, and what was said about it."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        stack = hsnoise.load(folder, **GIVEN.get(format, {}), progress=False)
        held = {
            "frames": [np.stack(list(stack.frames(i))).tolist() for i in range(stack.n_exposures)],
            "exposure_s": stack.exposure_s.tolist(),
            "black_level": np.asarray(stack.black_level).tolist(),
            **{name: getattr(stack, name) for name in ("kind", "cfa", "white_level", "shutter")},
        }
    return held, {*stack.assumed, *(str(one.message) for one in told if one.category is UserWarning)}


def outcome(case: Case, number: int, clean: tuple[dict[str, Any], set[str]], folder: Path) -> str:
    """ "same", "told", "refused" or "differs", or what is wrong with it."""
    case.make(folder, np.random.default_rng(number))
    try:
        held, told = read(folder, case.format)
    except OWN as error:
        chain: Any = error
        while chain is not None:
            if isinstance(chain, MemoryError):
                return f"wrong: took too much memory: {error!r:.300}"
            chain = chain.__cause__
        names = str(error)
        return "refused" if str(folder) in names else f"wrong: names no file: {error!r:.300}"
    except BaseException as error:
        return f"wrong: {error!r:.300}"
    if held == clean[0]:
        return "same"
    if not case.knowable:
        return "differs"
    if told - clean[1]:
        return f"told: {sorted(told - clean[1])}"
    return f"wrong: silent: {[name for name in held if held[name] != clean[0][name]]} differ"


def main(first: int, end: int) -> None:
    table = cases()
    drawn = [case for case in table if case.drawn]
    root = Path(tempfile.mkdtemp())
    clean = {}
    for format, (write, _) in CLEAN.items():
        (root / "clean" / format).mkdir(parents=True)
        write(root / "clean" / format)
        clean[format] = read(root / "clean" / format, format)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES,) * 2)
    for number in range(first, end):
        case = table[number] if number < len(table) else drawn[number % len(drawn)]
        print(json.dumps({"begins": number, "case": f"{case.format}: {case.name}"}), flush=True)
        folder = root / "broken"
        folder.mkdir()
        signal.alarm(MOST_S)
        found = outcome(case, number, clean[case.format], folder)
        signal.alarm(0)
        shutil.rmtree(folder)
        print(json.dumps({"outcome": found}), flush=True)
    shutil.rmtree(root)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
