"""The ten questions of the lab's last page. docs/let-it-crash.md has the same ones, with the same answers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Asked:
    """A question, and what the page offers.

    Attributes:
        text: the question.
        choices: the answers that can be chosen; the first one is right.
        why: the answer as the docs give it.
        experiment: the name of an experiment that shows it; "" if none does.
    """

    text: str
    choices: tuple[str, str, str]
    why: str
    experiment: str = ""

    @property
    def shown(self) -> list[str]:
        """The choices in the order of the page, which does not say which one is right."""
        return sorted(self.choices)

    def verdict(self, choice: str) -> str:
        """Return what the page says to a choice."""
        return f"{'Right' if choice == self.choices[0] else 'Not quite'}. {self.why}"


QUESTIONS = (
    Asked(
        "A worker raises in one message of a million. Should it catch the exception and go on?",
        ("only if it knows what the exception means", "yes, always", "no, never"),
        "Only if it knows what the exception means, and its own state is still right. Otherwise it ends, and starts "
        "again from a state that is known.",
        "poisoned_actor",
    ),
    Asked(
        "A driver, a map that reads the driver, and a viewer that reads the map: which strategy?",
        ("rest_for_one", "one_for_one", "one_for_all"),
        "`rest_for_one`, with the driver first. A viewer that ends starts again alone. If the driver ends, the map and "
        "the viewer start again, too.",
        "four_strategies",
    ),
    Asked(
        "`max_restarts=3, max_seconds=5`. A child ends at 0, 2, 4 and 6 seconds. Does its supervisor give up?",
        ("no", "yes, at 4 s", "yes, at 6 s"),
        "No. At 6 s the window has the restarts at 2, 4 and 6: that is three, and three are allowed. An end at 4.5 s "
        "would have been the fourth within 5 s.",
        "restart_storm",
    ),
    Asked(
        "A transient child is killed with SIGKILL. Does it start again? And one that stops itself?",
        ("the killed one does, the other not", "both do", "neither does"),
        "After the kill, yes: that is no normal end. After its own stop, no.",
    ),
    Asked(
        "A manager counts its loads in an attribute, and has three cameras loaded. It is killed. What is left?",
        ("the cameras, but not the count", "the count and the cameras", "neither"),
        "The three cameras, their holders and its place in the tree. The count is 0 again.",
        "kill_in_a_load",
    ),
    Asked(
        "A supervisor has given up. What does the supervisor above it do?",
        ("it starts that supervisor again", "it gives up, too", "nothing"),
        "To it, a child has ended. It starts that supervisor again with all children below, and counts this in a "
        "window of its own.",
        "escalation_levels",
    ),
    Asked(
        "An actor ends by a message that it cannot handle. Does the new one get the message again?",
        ("no", "yes, once", "yes, until it is handled"),
        "No. The one who asked gets `ActorUnavailable`, and decides whether to ask again.",
        "poisoned_actor",
    ),
    Asked(
        "Two consumers hold the same camera, and one releases it. Is the camera closed?",
        ("no", "yes, for both", "it is closed and opened again"),
        "No. The last release closes it.",
        "sharing_and_parts",
    ),
    Asked(
        "A camera has a lens as a part. The lens becomes FATAL. Who hears of it?",
        ("the camera's manager first, then the holders", "the holders of the camera alone", "nobody: they must ask"),
        "The manager of the camera. If its status callback does not replace the lens, the holders of the camera hear "
        "FATAL, too.",
        "handled_status",
    ),
    Asked(
        "A manager is killed while its load callback runs. What does the consumer see?",
        ("it waits a little longer", "an error at once", "an empty response"),
        "It waits a little longer: the callback runs again in the new process. If the process dies in three attempts, "
        "the load fails.",
        "kill_in_a_load",
    ),
)
"""All questions, in the order of the docs."""
