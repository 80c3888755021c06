"""Tables and figures of an evaluation, from records of each frame.

A record has `method`, `clip`, `mean_e` (light of the scene, e-), `frame` (from 0), `psnr_db` and `ssim`. Frames of a
clip resemble each other, so standard errors are those of the means of clips.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from hsnoise._core.sheet import Sheet
from hsnoise.enhance.training.scenes import Scene
from hsnoise.enhance.training.validation import psnr_db

REFER, OURS, SCALED = "scaled input", "hsnoise ST-LSTM", "hsnoise ST-LSTM, scaled"
AT_BEST = "hsnoise at its best, scaled"  # with the frames that follow, and mirrored ones
OF_HSNOISE = (OURS, SCALED, AT_BEST)
FORMS = {"psnr_db": ".2f", "ssim": ".3f"}
SHOWN_FRAMES = (1, 2, 3, 5, 8, 12, 16, 20)
InWords = Callable[[float], str]  # the light of a scene from `mean_e`


def methods_in(records: Sequence[dict]) -> list[str]:
    return list(dict.fromkeys(record["method"] for record in records))


def lights_in(records: Sequence[dict]) -> list[float]:
    return sorted({record["mean_e"] for record in records})


def of_clips(records: Sequence[dict], what: str, **chosen) -> dict[str, float]:
    """Mean of `what` over the chosen frames of each clip."""
    kept = [record for record in records if all(record[name] == value for name, value in chosen.items())]
    clips = dict.fromkeys(record["clip"] for record in kept)
    return {clip: float(np.mean([r[what] for r in kept if r["clip"] == clip])) for clip in clips}


def standard_error(means: Sequence[float]) -> float:
    """Standard error of the mean of these means; NaN for a single one, which cannot show it."""
    return float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else float("nan")


def in_figures(of: dict[str, float], form: str) -> str:
    """Mean over clips and its standard error."""
    values = list(of.values())
    error = f" ± {standard_error(values):{form.lstrip('+')}}" if len(values) > 1 else ""
    return f"{np.mean(values):{form}}{error}"


def both(records: Sequence[dict], **chosen) -> str:
    """PSNR and SSIM, each with its standard error over clips."""
    return " / ".join(in_figures(of_clips(records, what, **chosen), form) for what, form in FORMS.items())


def best_rival(records: Sequence[dict], what: str) -> str:
    """The method with the highest mean, our own aside."""
    rivals = [method for method in methods_in(records) if method not in OF_HSNOISE]
    return max(rivals, key=lambda method: np.mean(list(of_clips(records, what, method=method).values())))


def lead(records: Sequence[dict], method: str, what: str, **chosen) -> dict[str, float]:
    """By how much a method is ahead of the best rival, for each clip."""
    of = of_clips(records, what, method=method, **chosen)
    other = of_clips(records, what, method=best_rival(records, what), **chosen)
    return {clip: of[clip] - other[clip] for clip in of}


def of_longest(records: Sequence[dict]) -> list[dict]:
    """Records of the clips with the most frames: with others, means would change where a clip ends."""
    last = max(record["frame"] for record in records)
    clips = {record["clip"] for record in records if record["frame"] == last}
    return [record for record in records if record["clip"] in clips]


def tables(records: Sequence[dict], in_words: InWords) -> list[Sheet]:
    """By light, ahead of the best rival, by clip, by number of the frame."""
    return [_of_lights(records, in_words), _ahead(records, in_words), *_of_clips(records), _of_frames(records)]


def _of_lights(records: Sequence[dict], in_words: InWords) -> Sheet:
    lights = lights_in(records)
    head = ("method", "all light", *map(in_words, lights))
    rows = [
        (method, both(records, method=method), *(both(records, method=method, mean_e=light) for light in lights))
        for method in methods_in(records)
    ]
    return Sheet("PSNR / dB and SSIM of the clips, with standard errors over clips", head, rows)


def _ahead(records: Sequence[dict], in_words: InWords) -> Sheet:
    lights = lights_in(records)
    rows = [
        (
            f"{method}, {name}",
            best_rival(records, what),
            in_figures(lead(records, method, what), f"+{FORMS[what]}"),
            *(in_figures(lead(records, method, what, mean_e=light), f"+{FORMS[what]}") for light in lights),
        )
        for what, name in (("psnr_db", "PSNR / dB"), ("ssim", "SSIM"))
        for method in OF_HSNOISE
    ]
    head = ("method", "best rival", "all light", *map(in_words, lights))
    return Sheet("Ahead of the best rival, clip by clip", head, rows, left=2)


def _of_clips(records: Sequence[dict]) -> list[Sheet]:
    methods, clips = methods_in(records), dict.fromkeys(record["clip"] for record in records)
    return [
        Sheet(
            f"{name} of each clip",
            ("clip", *methods),
            [(clip, *(f"{of_clips(records, what, method=m)[clip]:{FORMS[what]}}" for m in methods)) for clip in clips],
        )
        for what, name in (("psnr_db", "PSNR / dB"), ("ssim", "SSIM"))
    ]


def _of_frames(records: Sequence[dict]) -> Sheet:
    kept = of_longest(records)
    shown = [n for n in SHOWN_FRAMES if n <= max(record["frame"] for record in kept) + 1]
    rows = [(m, *(both(kept, method=m, frame=n - 1) for n in shown)) for m in methods_in(kept)]
    title = f"PSNR / dB and SSIM of the nth frame, {len({record['clip'] for record in kept})} longest clips"
    return Sheet(title, ("method", *(f"n = {n}" for n in shown)), rows)


def memory_sheet(filling: dict[str, list[float]]) -> Sheet:
    """How much the preceding frames help, for each clip."""
    shown = [n for n in SHOWN_FRAMES if n <= max(map(len, filling.values()))]
    rows = [(clip, *(f"{of[n - 1]:.2f}" if n <= len(of) else "" for n in shown)) for clip, of in filling.items()]
    title = "PSNR of the nth frame that the network sees, the same frames for each n, dB"
    return Sheet(title, ("clip", *(f"n = {n}" for n in shown)), rows)


def as_csv(records: Sequence[dict]) -> str:
    """All records, one row per frame."""
    file = io.StringIO()
    writer = csv.DictWriter(file, records[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return file.getvalue()


def draw_curves(records: Sequence[dict], filling: dict[str, list[float]], in_words: InWords) -> Figure:
    """PSNR against illuminance and frame number (all methods), and while the network's memory fills."""
    figure = Figure(figsize=(14, 4.4), layout="constrained")
    against_light, against_frame, memory = figure.subplots(1, 3)
    lights, longest = lights_in(records), of_longest(records)
    frames = sorted({record["frame"] for record in longest})
    for method, marker in zip(methods_in(records), cycle("so*vDXP^"), strict=False):
        style = {"label": method, "alpha": 0.8, "lw": 2.5 if method in OF_HSNOISE else 1.2}
        of = [list(of_clips(records, "psnr_db", method=method, mean_e=light).values()) for light in lights]
        errors = [standard_error(values) for values in of]
        against_light.errorbar(lights, [np.mean(values) for values in of], errors, fmt=f"{marker}-", capsize=3, **style)
        of = [list(of_clips(longest, "psnr_db", method=method, frame=frame).values()) for frame in frames]
        against_frame.plot([n + 1 for n in frames], [np.mean(values) for values in of], f"{marker}-", ms=4, **style)
    against_light.set_xscale("log")
    against_light.set_xticks(lights, [in_words(light) for light in lights])
    against_light.minorticks_off()
    against_light.legend(fontsize=8)
    against_frame.legend(fontsize=8)
    for number, (label, values) in enumerate(filling.items()):  # each clip as it is, and scaled
        line, colour = ("o-", "o--")[number % 2], f"C{9 - number // 2 % 7}"  # not a colour of the methods
        memory.plot(range(1, len(values) + 1), values, line, ms=3, color=colour, label=label)
    memory.legend(fontsize=8)
    names = ("light of the scene", "number of the frame", "frames seen, the scored one included")
    titles = (
        "Against light, with standard errors",
        "Against the number of the frame, longest clips",
        "While the memory fills",
    )
    for axis, name, title in zip((against_light, against_frame, memory), names, titles, strict=True):
        axis.set_xlabel(name)
        axis.set_ylabel("PSNR (dB)")
        axis.set_title(title, loc="left")
    return figure


def draw_frames(scene: Scene, found: dict[str, np.ndarray]) -> Figure:
    """The last frame of a scene by all methods."""
    panels = {**found, "clean": scene.clean}
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    aspect = scene.clean.shape[1] / scene.clean.shape[2]
    figure = Figure(figsize=(3.2 * columns, (3.2 * aspect + 0.35) * rows + 0.35), layout="constrained")
    light = scene.camera.in_words(scene.mean_e)
    figure.suptitle(f"{scene.clip}, {light}, frame {len(scene.clean)}: PSNR of this frame", fontsize=11)
    axes = np.ravel(figure.subplots(rows, columns))
    for axis in axes:
        axis.axis("off")
    for axis, (name, frames) in zip(axes, panels.items(), strict=False):
        axis.imshow(np.clip(frames[-1], 0, 1).squeeze(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        value = "" if name == "clean" else f", {psnr_db(frames[-1], scene.clean[-1]):.1f} dB"
        axis.set_title(f"{name}{value}", fontsize=10, loc="left")
    return figure
