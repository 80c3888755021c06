"""Every threshold of the loop, with its reason; `python -m benchmarks.rules` derives again those that can be derived.

These numbers decide the verdict on a model. Numbers of draws are a matter of effort, and are defined where the draws
are made.
"""

from __future__ import annotations

import math

# One definition of a model that fits: an error below FITS, as 98 to 99 % of right models have (benchmarks.rules), and
# no single statistic MAX_Z deviations off, which a large group would hide: of 600 right models one had 5.4.
FITS, MAX_Z = 2.0, 7.0
CLOSED_SHARE = 0.01  # of the variance, unexplained in a component of a closed model: half a percent of the rms
CLOSE = 10.0  # an error below this: of use, with doubts; noise of the wrong kind is off by no more than its own size

# A ranking of captures without anything missing names something in at most this share of them.
FALSE_ALARM_RATE = 0.01
LATER_RATE = 1e-4  # of a ranking where the model fits already: chosen from the frames that chose what is in the model
MARKOV_UP_TO = 40.0  # nats; scores below this, above the bound, are compared with those of fresh draws
CHANCE_RATE, CHANCE_TAIL = 0.001, 0.1  # of those scores: probability to exceed, and the share that shows their tail

AMBIGUOUS = math.log(20)  # nats between two names: odds of 20 to 1, "strong" after Kass and Raftery, JASA 90, 1995
SIDES_APART = 2 * AMBIGUOUS  # between the sides of the gain, which two refits have chosen

# Normal scores of the worst of about 22 groups of statistics: 99.5 % of right models stay below the first, all but one
# in ten thousand below the second.
MISFIT_LEFT, MISFIT = 3.5, 4.5
# What the named effect may leave, as a share of the misfit without it, and at most: the shifts of strong effects are
# known to some percent only.
SHARE_LEFT, MOST_LEFT = 0.05, 10.0
HALF = 0.5  # share of a misfit that must go for an effect to be part of the explanation

# Nats of log score on frames that no fit has seen, from which an addition is kept: a likelihood ratio comes there by
# chance in 5 % at most (Markov's inequality), beyond so many errors of its simulation.
PREDICTS, PREDICTS_SIGMA = math.log(20), 2.0
MOVED_SIGMA = 2.0  # standard errors from which a base parameter has moved: 95 %

NOTABLE_Z = 4.0  # deviations of a single statistic among 300 that are worth a sentence: 1 in 50 right models has one
NOTABLE_GAIN = 1.0  # in deviations, of a statistic that came nearer


def fits(error: float, max_z: float) -> bool:
    """Whether a capture could have been drawn from a model of this error and largest |z|."""
    return error < FITS and max_z < MAX_Z


def evidence(candidates: int, rate: float = FALSE_ALARM_RATE) -> float:
    """Log-likelihood ratio, nats, from which one of so many candidates is there.

    Under "nothing missing", a likelihood ratio exceeds c with probability 1 / c at most (Markov's inequality), so one
    of n candidates exceeds n / rate with probability `rate` at most.
    """
    return math.log(candidates / rate)
