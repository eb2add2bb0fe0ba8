"""A simulated world that the real core of the registrar runs in.

`python -m simulation` runs as many simulated worlds as you ask for; docs/consistency.md says what they check.
"""

from simulation.oracle import Violation
from simulation.runner import Outcome, replay, report, run, shrink

__all__ = ["Outcome", "Violation", "replay", "report", "run", "shrink"]
