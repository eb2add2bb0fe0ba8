"""The decisions of a recording as cells of tables."""

from __future__ import annotations

from collections.abc import Sequence

from rr_actors.registrar.decisions.decided import Decided
from rr_actors.system.recording.event_texts import clock
from rr_actors.system.rewound.decision_texts import changes_text, effects_text, items_text, outcome_of
from rr_actors.system.rewound.replaying import Replay, ReplayStep

REGISTRAR_HEADS = ("registrar", "from", "to", "decisions", "same", "different", "not decided again")
STEP_HEADS = ("step", "time", "outcome", "what", "changes", "effects")
_STYLES = {"different": "red", "not decided again": "dim"}


def registrar_cells(registrar: str, steps: Sequence[ReplayStep]) -> tuple[str, ...]:
    """Return the cells of a registrar, below REGISTRAR_HEADS; without those steps that have all that it knew."""
    decided = [step for step in steps if isinstance(step.what, Decided)]
    outcomes = [outcome_of(step) for step in decided]
    counts = (len(decided), outcomes.count("same"), outcomes.count("different"), outcomes.count("not decided again"))
    return registrar, clock(steps[0].at), clock(steps[-1].at), *(str(count) if count else "-" for count in counts)


def step_cells(step: ReplayStep) -> tuple[str, ...]:
    """Return the cells of a step, below STEP_HEADS."""
    words = items_text(step), changes_text(step), effects_text(step)
    return str(step.number), clock(step.at), outcome_of(step), *words


def style_of_step(step: ReplayStep) -> str:
    """Return Rich's words for the colour of a step."""
    return _STYLES.get(outcome_of(step), "")


def caveats_of(replay: Replay) -> list[str]:
    """Return sentences about what was not decided again."""
    said = list(replay.notes)
    if replay.not_decided and replay.differences:
        said.append("after a difference, no decision of that registrar is decided again until the recording has all "
                    "that it knows once more")  # fmt: skip
    return said
