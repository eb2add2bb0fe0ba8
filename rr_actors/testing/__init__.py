"""Testing: a clock moved by hand, and a simulated world that the real core of the registrar runs in.

`python -m rr_actors.testing` runs as many simulated worlds as you ask for; docs/consistency.md says what they check.
"""

from rr_actors.testing.clock import ManualClock
from rr_actors.testing.ledger import Violation
from rr_actors.testing.simulation import Outcome, replay, report, run, shrink

__all__ = ["ManualClock", "Outcome", "Violation", "replay", "report", "run", "shrink"]
