"""Candidates are judged by their shifts, alone and two together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hsnoise import effects as fx
from hsnoise.criticism import rules
from hsnoise.criticism.candidates import made
from hsnoise.criticism.finding import Diagnosis, Unexplained
from hsnoise.criticism.fingerprint import Fingerprint
from hsnoise.criticism.nearest import nearest, together
from hsnoise.criticism.ranking import (
    GRID,
    Candidate,
    Evidence,
    Pair,
    best_pairs,
    closest,
    judge,
    limit_by_chance,
)
from hsnoise.criticism.search import Search
from hsnoise.criticism.verdict import verdict_of
from hsnoise.simulation.gaussian import Gaussian, shrunk

STATISTICS, AMPLITUDES = 40, (0.35, 1.0, 2.5)
NAMES = tuple(f"statistic {i}" for i in range(STATISTICS))
GROUPS = tuple("abcd"[i // 10] for i in range(STATISTICS))


def fingerprint(name: str, which: slice, size: float = 12.0) -> Fingerprint:
    """An effect that moves some statistics in proportion to its amplitude, a little differently in each detail."""
    shift = np.zeros(STATISTICS)
    shift[which] = size
    rng = np.random.default_rng(len(name))
    details = 1 + 0.03 * rng.standard_normal((3, 4, 1))
    shifts = np.array(AMPLITUDES)[:, None, None] * shift * details
    return Fingerprint(name, lambda amplitude, rng: fx.RowNoise(amplitude), AMPLITUDES, shifts)


PRINTS = [fingerprint("left", slice(0, 5)), fingerprint("middle", slice(12, 18)), fingerprint("right", slice(30, 38))]


def evidence(*hidden: Fingerprint, amplitude: float = 0.8) -> Evidence:
    noise = np.random.default_rng(5).standard_normal(STATISTICS)
    z = noise + sum(of.at(amplitude).mean(0) for of in hidden)
    return Evidence(z, Gaussian(np.zeros(STATISTICS), np.eye(STATISTICS)), NAMES, GROUPS, len(PRINTS))


def test_a_named_effect_is_described_with_its_size_and_what_to_do_next():
    one = Candidate("periodic_banding", fx.PeriodicBanding(0.8, 0.2866), 930.0, 0.0, 1.2)
    told = str(Diagnosis((one,), "named", one, (one.name,), "", Unexplained(1.2, "tails", ())))
    for words in ("amplitude 0.8 e-, frequency 0.287 cycles/pixel, axis", "< 1e-9", "next: hsnoise improve"):
        assert words in " ".join(told.split())


def test_single_effect_is_first_and_leaves_nothing():
    found = evidence(PRINTS[1])
    judged = sorted((judge(of, found) for of in PRINTS), key=lambda one: -one.score)
    assert judged[0].of.name == "middle" and 0.6 < judged[0].amplitude < 1.1
    assert judged[0].misfit < 3 < judged[1].misfit
    candidate = judged[0].candidate(found)
    assert candidate.p_value < 1e-6 and float(candidate.effect.sigma) == judged[0].amplitude


def test_nothing_hidden_gives_no_evidence():
    scores = [judge(of, evidence()).score for of in PRINTS]
    assert max(scores) < 3 and evidence().p_value(max(scores)) > 0.05


def test_two_effects_are_found_together():
    found = evidence(PRINTS[0], PRINTS[2])
    judged = sorted((judge(of, found) for of in PRINTS), key=lambda one: -one.score)
    assert judged[0].misfit > 4
    pair, other = best_pairs(judged, found, 2)
    assert pair.score >= other.score and [effect.name for effect in pair.effects] == ["row_noise"] * 2
    assert set(pair.names) == {"left", "right"} and pair.misfit < 3 and pair.score > judged[0].score + 10
    assert best_pairs(judged[:1], found, 3) == []


def test_details_are_chosen_beside_what_else_is_there():
    """The first detail looks like the other effect; with that in the sensor, the second is the right one."""

    def maker(amplitude, rng):
        return fx.RowNoise(amplitude * (1 + rng.random()))

    shifts = np.zeros((1, 2, STATISTICS))
    shifts[0, 0, :5], shifts[0, 1, 5:10] = 12.0, 12.0
    of, other = Fingerprint("places", maker, (1.0,), shifts), PRINTS[0].at(2.0).mean(0)
    found = evidence()
    found = replace(found, z=found.z + other + shifts[0, 1])
    alone, beside = (float(closest(of, found, shift).sigma) for shift in (0 * other, other))
    ratios = [float(made(maker, 1.0, detail).sigma) for detail in (0, 1)]
    grid = np.geomspace(0.15, 5.0, 18)
    assert np.isclose(alone, ratios[0] * grid, rtol=1e-4).any()
    assert np.isclose(beside, ratios[1] * grid, rtol=1e-4).any()


NULL = Gaussian(np.zeros(STATISTICS), np.eye(STATISTICS))


def pair_of(names: tuple[str, str], score: float, misfit: float) -> Pair:
    effects, shifts = (fx.RowNoise(2.0), fx.RowNoise(3.0)), (np.zeros(STATISTICS), np.zeros(STATISTICS))
    return Pair(names, effects, shifts, score, misfit, NULL)


def verdict(left: float, pair: Pair | None, worst: float = 20.0):
    """The verdict on a capture whose worst group is `worst` off and of which the first candidate leaves `left`."""
    rows = [("left", 400.0, left), ("middle", 90.0, 15.0), ("right", 20.0, 18.0)]
    ranking = [Candidate(name, fx.RowNoise(1.0), score, 1e-9, misfit) for name, score, misfit in rows]
    z = np.zeros(STATISTICS)
    z[:10] = (1 - 2 / 90 + worst * np.sqrt(2 / 90)) ** 1.5  # Wilson and Hilferty, of ten statistics
    return verdict_of(ranking, pair, replace(evidence(), z=z), distributions(z, left, worst))


def distributions(z: np.ndarray, left: float, worst: float) -> dict[str, Gaussian]:
    """The distribution with the first candidate takes so much of z away that `left` remains."""
    share = 1 - ((1 - 2 / 90 + left * np.sqrt(2 / 90)) / (1 - 2 / 90 + worst * np.sqrt(2 / 90))) ** 1.5
    return {"left": Gaussian(share * z, np.eye(STATISTICS))}


@pytest.mark.parametrize(
    ("left", "pair", "names"),
    [
        (2.0, None, ("left",)),
        (2.0, pair_of(("left", "right"), 420.0, 1.0), ("left", "right")),  # the two leave nothing, and less
        (3.4, pair_of(("left", "right"), 420.0, 3.45), ("left",)),  # no less is left
        (9.0, pair_of(("left", "right"), 420.0, 5.0), ()),  # both leave too much
        (9.0, pair_of(("right", "left"), 401.0, 1.0), ()),  # no more evidence than one
        (9.0, pair_of(("left", "right"), 420.0, 1.0), ("left", "right")),
        (9.0, None, ()),
    ],
)
def test_names_of_a_verdict(left, pair, names):
    found = verdict(left, pair)
    assert found.names == names
    assert found.verdict == ("named" if names else "unexplained")
    assert found.headline == (f"missing: {' and '.join(names)}" if names else "unexplained")


def test_a_strong_effect_may_leave_more_but_not_much():
    assert verdict(5.0, None, worst=200.0).verdict == "named"
    assert verdict(12.0, None, worst=2000.0).verdict == "unexplained"


def test_what_remains_is_told_beside_what_is_named():
    found = verdict(2.0, None)
    assert found.unexplained.misfit == pytest.approx(2.0, abs=0.3)
    assert all(abs(float(text.split("z = ")[1].rstrip(")"))) < 6 for text in found.unexplained.statistics)


def test_an_effect_that_explains_a_part_is_named_in_the_advice():
    partly, hardly = verdict(9.0, None), verdict(18.0, None)
    assert "left would explain part" in partly.advice and partly.unexplained.misfit == pytest.approx(9.0, abs=0.5)
    assert "none comes close" in hardly.advice and hardly.unexplained.misfit == pytest.approx(20.0, abs=0.5)


def test_nearest_is_what_explains_most_statistics_however_far_off_the_rest_are():
    """A wide effect scatters statistics that something else has moved; another explains its own exactly."""
    z = evidence(PRINTS[0]).z
    z[30:38] += 300.0
    rng = np.random.default_rng(3)
    wild = np.zeros(STATISTICS)
    wild[25:38] = 1.0
    scattered = np.array(AMPLITUDES)[:, None, None] * wild * 60 * rng.standard_normal((3, 4, STATISTICS))
    wide = Fingerprint("wide", lambda amplitude, rng: fx.RowNoise(amplitude), AMPLITUDES, scattered)
    prints = [PRINTS[0], wide]
    found = Evidence(z, Gaussian(np.zeros(STATISTICS), np.eye(STATISTICS)), NAMES, GROUPS, 2)
    judged = sorted((judge(of, found) for of in prints), key=lambda one: -one.score)
    ranking = [one.candidate(found) for one in judged]
    assert [one.name for one in ranking] == ["wide", "left"]  # by normal distributions, far from any of them
    no_base, ones = np.zeros((1, STATISTICS)), np.ones(STATISTICS)
    assert nearest(prints, ranking, found, no_base, ones)[0].name == "left"
    # What a wrong base parameter would do is no gain.
    base = PRINTS[0].at(1.0).mean(0)[None]
    assert "left" not in [one.name for one in nearest(prints, ranking, found, base, ones)]
    assert nearest(prints, ranking, evidence(), no_base, ones) == ()


def test_what_takes_most_from_the_worst_group_is_tried_after_what_explains_most_statistics():
    """Many statistics are a little off, a few by far: what `compare` calls the error is theirs."""
    many, other = fingerprint("many", slice(0, 18)), fingerprint("other", slice(18, 25))
    few = fingerprint("few", slice(31, 34), 90.0)
    found = evidence(many, few, other)
    prints = [many, other, few]
    ranking = [judge(of, found).candidate(found) for of in prints]
    no_base, ones = np.zeros((1, STATISTICS)), np.ones(STATISTICS)
    assert [one.name for one in nearest(prints, ranking, found, no_base, ones)] == ["many", "few", "other"]
    without = [one.name for one in nearest(prints[:2], ranking, found, no_base, ones)]
    assert without == ["many", "other"]  # neither takes half of what is off there


def test_together_are_effects_that_explain_different_parts_and_no_two_that_explain_one():
    """Rivals of the first explain the same statistics, and leave nothing for one another; each has its own size."""
    first, rival = fingerprint("first", slice(0, 18)), fingerprint("rival", slice(1, 18))
    second, third, absent = (
        fingerprint("second", slice(16, 24)),
        fingerprint("third", slice(30, 34)),
        fingerprint("absent", slice(35, 40)),
    )
    z = evidence(first, amplitude=1.5).z + second.at(0.6).mean(0) + third.at(0.8).mean(0)
    found = Evidence(z, Gaussian(np.zeros(STATISTICS), np.eye(STATISTICS)), NAMES, GROUPS, 5)
    prints = [rival, third, absent, second, first]
    ranking = [judge(of, found).candidate(found) for of in prints]
    base = (found, np.zeros((1, STATISTICS)), np.ones(STATISTICS))
    near = nearest(prints, ranking, *base)
    assert {"first", "rival"} < {one.name for one in near}
    chosen = together(prints, near, *base)
    assert [one.name for one in chosen] == ["first", "second", "third"]
    # GRID[::2] has steps of a factor of 1.5.
    for one, size in zip(chosen, (1.5, 0.6, 0.8), strict=True):
        assert abs(np.log(float(one.effect.sigma) / size)) < 0.25
    # What a wrong base parameter would do is left to the base.
    of_base = (found, second.at(1.0).mean(0)[None], np.ones(STATISTICS))
    assert [one.name for one in together(prints, near, *of_base)] == ["first", "third"]
    assert together(prints, (), *base) == ()


@pytest.mark.parametrize(
    ("hidden", "size", "in_vain"),
    [("one", 5.0, False), ("one two", 5.0, False), ("one two three", 5.0, True), ("one two three", 0.25, False)],
)
def test_a_closer_look_at_one_or_two_is_in_vain_where_more_are_missing(hidden, size, in_vain):
    prints = {name: fingerprint(name, slice(i * 10, i * 10 + 9)) for i, name in enumerate(("one", "two", "three"))}
    found = evidence(*(prints[name] for name in hidden.split()), amplitude=size)
    judged = sorted((judge(of, found) for of in prints.values()), key=lambda one: -one.score)
    assert Search(None, found, {}, {}).is_in_vain(judged) is in_vain


def test_rare_statistics_that_go_with_others_leave_a_distribution():
    """Counts of rare pixels hardly vary, and do so together with what the same pixels do elsewhere."""
    z = np.random.default_rng(12).standard_normal((64, STATISTICS))
    z[:, :19] = 0.45 * z[:, 20:21]
    found = shrunk(z, np.zeros((1, STATISTICS)))
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert np.all(np.diagonal(found.covariance)[:19] >= 1)


def test_the_limit_of_chance_is_exceeded_by_few_captures_without_an_effect():
    """Distributions from few draws are too narrow, and their scores too high by chance: the limit rises with them."""
    z = np.random.default_rng(11).standard_normal((4000, STATISTICS))
    limits = {}
    for deviation in (1.0, 0.6):
        null = Gaussian(np.zeros(STATISTICS), deviation**2 * np.eye(STATISTICS))
        found = replace(evidence(), null=null)
        limits[deviation] = limit_by_chance(PRINTS, found, z[:64])
        nothing = null.log_density(z)
        best = np.max([of.distribution(float(a), null).log_density(z) for of in PRINTS for a in GRID], 0) - nothing
        assert np.mean(best > limits[deviation]) < 0.01
    assert limits[1.0] < rules.evidence(len(PRINTS), rules.CHANCE_RATE) < limits[0.6]  # Markov's bound


def test_the_limit_is_that_of_chance_where_chance_gives_more_than_the_bound():
    found = evidence()
    assert found.limit == found.least == rules.evidence(len(PRINTS))
    assert replace(found, chance=found.least - 1).limit == found.least
    assert replace(found, chance=found.least + 1).limit == found.least + 1
