"""Parsing the command line: suggestions for wrong names, one-line errors, exposures with units."""

from __future__ import annotations

import argparse
import difflib
import math
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from hsnoise._core.arguments import MOST_SEED
from hsnoise._core.types import BAYER_CFAS

SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6}  # the micro sign, and the Greek letter
_OPTION = re.compile(r"--?[A-Za-z][^=]*")
_NUMBER = r"(\d+\.?\d*(?:e[+-]?\d+)?|\.\d+)"
_EXPOSURE = re.compile(rf"{_NUMBER}(?:/{_NUMBER})?\s*(\D*)", re.IGNORECASE)
_KINDS = {"int": "a whole number", "float": "a number"}


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, and what may have been meant. Options are not abbreviated."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__(allow_abbrev=False, **keywords)

    def parse_known_args(self, args=None, namespace=None):  # called for the main parser and for the command's
        words = sys.argv[1:] if args is None else list(args)
        self._check_options(words)
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        said = re.sub(r"invalid (int|float) value: (.*)", lambda m: f"expected {_KINDS[m[1]]}, got {m[2]}", message)
        if "required" in said:
            said += f" ({self.prog} --help lists them)"
        self.exit(2, f"hsnoise: {said.removeprefix('argument ')}\n")

    def _check_options(self, words: Sequence[str]) -> None:
        """Reject unknown options first: other errors that they cause would mislead."""
        for word in words:
            if word == "--" or self._subparsers is not None and not word.startswith("-"):
                return  # the rest are not options, or belong to the command
            name = _OPTION.match(word)
            if name and name[0] not in self._option_string_actions:
                self.error(f"unknown option {name[0]}{or_near(name[0], self._option_string_actions)}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        choices = [str(choice) for choice in action.choices]
        if isinstance(action, argparse._SubParsersAction):
            self.error(f"unknown command {value}{or_near(value, choices)} (hsnoise --help lists the commands)")
        expected = " or ".join(choices) if len(choices) == 2 else f"one of {', '.join(choices)}"
        raise argparse.ArgumentError(action, f"expected {expected}, got {value!r}{or_near(str(value), choices)}")


def or_near(word: str, known: Iterable[str]) -> str:
    """A question that suggests the nearest known name, to follow an error; empty if none is near."""
    near = difflib.get_close_matches(word.lower(), list(known), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def seconds(text: str) -> float:
    """Seconds of 0.5, 1/30, 20ms, 25us, ..."""
    found = _EXPOSURE.fullmatch(text.strip())
    value = math.nan
    if found and found[3] in SECONDS and float(found[2] or 1) > 0:
        value = float(found[1]) / float(found[2] or 1) * SECONDS[found[3]]
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected seconds, such as 0.5, 1/30, 20ms or 25us, got {text!r}")
    return value


def list_of_seconds(text: str) -> list[float]:
    return [seconds(word) for word in text.split(",")]


def numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or several with commas, got {text!r}") from None


def cfa(text: str) -> str:
    if text.lower() == "mono":
        return "mono"
    if text.upper() not in BAYER_CFAS:
        near = or_near(text.upper(), ("mono", *BAYER_CFAS))
        raise argparse.ArgumentTypeError(f"expected mono or one of {', '.join(BAYER_CFAS)}, got {text!r}{near}")
    return text.upper()


def positive(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text!r}")
    return int(text)


def count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number, 0 or more, got {text!r}")
    if len(text.lstrip("0")) > len(str(MOST_SEED)) or int(text) > MOST_SEED:
        raise argparse.ArgumentTypeError(f"expected at most {MOST_SEED}, got {text:.40}")
    return int(text)


def minutes(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected minutes above 0, got {text!r}")
    return value


def overscan(text: str) -> str | tuple[Any, Any]:
    """auto, or spans of rows and columns; None: all of them."""
    if text == "auto":
        return text
    try:
        rows, columns = (None if one == ":" else tuple(map(int, one.split(":"))) for one in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected auto or R0:R1,C0:C1 such as :,1024:1050, got {text!r}") from None
    return rows, columns


def hdu(text: str) -> int | str:
    """The number of an HDU, or its name."""
    return int(text) if text.strip().isdecimal() else text


def roi(text: str) -> tuple[tuple[int, int], tuple[int, int]]:
    try:
        (r0, r1), (c0, c1) = (map(int, span.split(":")) for span in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected R0:R1,C0:C1 such as 0:512,100:612, got {text!r}") from None
    return (r0, r1), (c0, c1)
