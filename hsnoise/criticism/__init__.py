"""Does the model describe the sensor, and if not, which effect is missing: compare, diagnose, improve; budget, inspect.

May import all but `report` and the command line.
"""

from __future__ import annotations

from hsnoise.criticism.compare import Comparison, compare
from hsnoise.criticism.diagnose import Diagnosis, diagnose
from hsnoise.criticism.improve import improve
from hsnoise.criticism.outcomes import Ended, Verdict
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.story import Step, Story

__all__ = [
    "Candidate",
    "Comparison",
    "Diagnosis",
    "Ended",
    "Step",
    "Story",
    "Verdict",
    "compare",
    "diagnose",
    "improve",
]
