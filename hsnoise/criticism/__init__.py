"""Does the model describe the sensor, and if not, which effect is missing: compare, diagnose, improve; budget, inspect.

May import all but `report` and the command line.
"""

from __future__ import annotations

from hsnoise.criticism.closing import ClosedModel, closed
from hsnoise.criticism.compare import Comparison, compare
from hsnoise.criticism.diagnose import Diagnosis, diagnose
from hsnoise.criticism.improve import improve
from hsnoise.criticism.outcomes import Ended, Verdict
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.resume import write_story
from hsnoise.criticism.story import Step, Story

__all__ = [
    "Candidate",
    "ClosedModel",
    "Comparison",
    "Diagnosis",
    "Ended",
    "Step",
    "Story",
    "Verdict",
    "closed",
    "compare",
    "diagnose",
    "improve",
    "write_story",
]
