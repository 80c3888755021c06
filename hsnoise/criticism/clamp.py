"""The black clamp as a candidate, by the exact likelihood: its statistics are almost those of another gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hsnoise.criticism.fingerprint import Bench
from hsnoise.criticism.ranking import Candidate, Evidence
from hsnoise.effects import BlackClamp
from hsnoise.fit import fit, without_likelihood
from hsnoise.fitting.result import FitResult, Method
from hsnoise.simulation.gaussian import Gaussian

CLAMP = BlackClamp.name
DRAWS = 40


def clamp_by_likelihood(
    fitted: FitResult, bench: Bench, evidence: Evidence
) -> tuple[Candidate, Evidence, Gaussian] | None:
    """The capture refitted with a clamp: candidate, evidence and distribution with it.

    None if it is no better, or cannot be done.

    It can be done for a maximum-likelihood fit of darks at several exposures, without other effects in the model.
    """
    model = bench.model
    if not isinstance(fitted, FitResult) or fitted.method != Method.ML or CLAMP in model:
        return None
    if without_likelihood(model) or np.ptp(fitted.summary.exposure_s) == 0:
        return None
    try:
        clamped = fit(fitted.summary, model=model.add(BlackClamp(0.0)))
    except RuntimeError:  # it did not converge: no evidence for a clamp
        return None
    parameters = len(clamped.names) - len(fitted.names)
    score = clamped.log_likelihood - fitted.log_likelihood - parameters
    if not score > 0 or not np.any(np.asarray(clamped.params[CLAMP].rate)):
        return None
    simulator = replace(bench.simulator, model=clamped.params, kept={})
    own = simulator.reference(clamped.params, DRAWS)
    z = own.z(simulator.measured.values)
    misfit = max(own.distribution.normal_scores(z, own.groups).values())
    candidate = Candidate(CLAMP, clamped.params[CLAMP], float(score), evidence.p_value(score), misfit)
    return candidate, replace(evidence, z=z), own.distribution
