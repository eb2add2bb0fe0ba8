"""Simulated worlds, each a seed and a history, in which the protocol once broke, or would if it were broken so.

Found by chance, and shrunk; chance meets them too seldom to be waited for. The names are those in support_mutations.py.
"""

from __future__ import annotations

from rr_actors.testing.world import Step

# A Load that had been decided for a link went over the next one, to a provider that had been restarted twice: its load
# had been refused, and was run again when the consumer died.
DECIDED_FOR_A_LINK_BEFORE: list[Step] = [
    ("register", "r2", "s0"),
    ("serve", "r2"),
    ("load", "q2", "r0", "r2", "s0", b"q", False),
    ("wake", "r0", 1000000),
    ("dial", "r0", "r2"),
    ("net", "r0", "r2", 0),
    ("wake", "r2", 1000000),
    ("net", "r0", "r2", 1),
    ("wake", "r0", 1000000),
    ("net", "r0", "r2", 0),
    ("wake", "r2", 1000000),
    ("crash", "r2", "down"),
    ("net", "r0", "r2", 1),
    ("up", "r2"),
    ("serve", "r2"),
    ("register", "r2", "s0"),
    ("dial", "r0", "r2"),
    ("net", "r0", "r2", 0),
    ("wake", "r2", 1000000),
    ("call", "r2", "load", "q2", 2, "raise"),
    ("net", "r0", "r2", 1),
    ("wake", "r2", 1000000),
    ("crash", "r2", "stopped"),
    ("net", "r0", "r2", 1),
    ("up", "r2"),
    ("serve", "r2"),
    ("register", "r2", "s0"),
    ("net", "r0", "r2", 1),
    ("dial", "r0", "r2"),
    ("net", "r0", "r2", 0),
    ("wake", "r0", 3),
    ("net", "r0", "r2", 0),
    ("net", "r0", "r2", 0),
    ("crash", "r0", "down"),
    ("wake", "r2", 1000000),
    ("call", "r2", "load", "q2.3", 1, "ok"),
    ("wake", "r2", 1000000),
]


# A thread gave its load up while the disk was full. When there was space, the load was found to be held, and then let
# go: who had given it up was told the first.
GIVEN_UP_WITH_A_FULL_DISK: list[Step] = [
    ("load", "q1", "r0", "r0", "s0", b"q", True),
    ("register", "r0", "s0"),
    ("wake", "r0", 1000000),
    ("dial", "r0", "r0"),
    ("serve", "r0"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000),
    ("load", "q3", "app", "r0", "s0", b"q", False),
    ("net", "r0", "r0", 1),
    ("wake", "app", 1000000),
    ("dial", "app", "r0"),
    ("net", "app", "r0", 0),
    ("wake", "r0", 1000000),
    ("net", "app", "r0", 1),
    ("wake", "app", 1000000),
    ("net", "app", "r0", 0),
    ("wake", "r0", 1000000),
    ("call", "r0", "load", "q3", 1, "ok"),
    ("cut", "r0", "r0", 1, 0),
    ("net", "r0", "r0", 1),
    ("load", "q99", "r0", "r0", "s0", b"q", True),
    ("line", "q99", 0, ""),
    ("dial", "r0", "r0"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000),
    ("load", "q103", "app", "r0", "s0", b"q", True),
    ("net", "r0", "r0", 1),
    ("line", "q103", 0, ""),
    ("tire", "r0", "q99", "error"),
]


# Somebody tired of an unload that was owed, in a wake-up whose commit failed.
OVERDUE_WITH_A_FULL_DISK: list[Step] = [
    ("register", "r0", "s0"),
    ("load", "q1", "r0", "r0", "s0", b"p", False),
    ("wake", "r0", 1000000),
    ("dial", "r0", "r0"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000),
    ("net", "r0", "r0", 1),
    ("wake", "r0", 1000000),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000),
    ("call", "r0", "load", "q1", 1, "ok"),
    ("wake", "r0", 1000000),
    ("net", "r0", "r0", 1),
    ("wake", "r0", 1000000),
    ("unload", "r0", "q1"),
    ("wake", "r0", 1000000),
    ("late", "r0", "q1"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000, "error", 2),
]


# A thread's line broke when the provider had read its Load, which came once more by the link.
ASKED_BY_BOTH_WAYS: list[Step] = [
    ("register", "r2", "s0"),
    ("serve", "r2"),
    ("load", "q9", "r2", "r2", "s1", b"q", True),
    ("wake", "r2", 1000000),
    ("dial", "r2", "r2"),
    ("net", "r2", "r2", 0),
    ("wake", "r2", 1000000),
    ("net", "r2", "r2", 1),
    ("wake", "r2", 1000000),
    ("load", "q15", "r2", "r2", "s0", b"p", True),
    ("line", "q15", 0, ""),
    ("snap", "q15"),
    ("load", "q18", "r0", "r2", "s0", b"q", False),
]


# A link broke while a load ran, and the Load came once more by the next; its resource had become FATAL meanwhile.
LOADED_BY_TWO_LINKS: list[Step] = [
    ("serve", "r2"),
    ("register", "r2", "s0"),
    ("serve", "r1"),
    ("load", "q2", "r1", "r2", "s0", b"p", False),
    ("load", "q3", "r2", "r1", "s1", b"p", False),
    ("wake", "r2", 1000000),
    ("dial", "r2", "r1"),
    ("net", "r2", "r1", 0),
    ("wake", "r1", 1000000),
    ("dial", "r1", "r2"),
    ("net", "r1", "r2", 0),
    ("wake", "r2", 1000000),
    ("net", "r2", "r1", 1),
    ("net", "r1", "r2", 1),
    ("wake", "r1", 1000000),
    ("net", "r1", "r2", 0),
    ("wake", "r2", 1000000),
    ("call", "r2", "load", "q2", 1, "sub", "r1", "s0", b"q"),
    ("own", "r2", "status", "q2", "FATAL"),
    ("cut", "r1", "r2", 0, 2),
]

# A thread let go of a brief hold by its line, tired, and left the line; the Unload came once more by the link.
UNLOADED_BY_BOTH_WAYS: list[Step] = [
    ("serve", "r0"),
    ("load", "q1", "r0", "r0", "s0", b"q", False),
    ("register", "r0", "s1"),
    ("wake", "r0", 1000000),
    ("dial", "r0", "r0"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1),
    ("net", "r0", "r0", 1),
    ("wake", "r0", 1000000),
    ("load", "q6", "r0", "r0", "s1", b"q", True),
    ("line", "q6", 0, ""),
    ("wake", "r0", 1000000),
    ("call", "r0", "load", "q6", 1, "ok"),
    ("wake", "r0", 1000000),
    ("line", "q6", 1, ""),
    ("brief", "r0", "q6"),
    ("late", "r0", "q6", ""),
    ("wake", "r0", 1),
    ("net", "r0", "r0", 0),
    ("line", "q6", 0, "error"),
]


# A thread lets go of what its registrar has just taken up: that it is held waits to be written when it is owed.
HELD_BY_APP: list[Step] = [
    ("serve", "app"),
    ("serve", "r0"),
    ("register", "r0", "s1"),
    ("load", "q0", "app", "r0", "s1", b"p", False),
    ("wake", "app", 1000000),
    ("dial", "app", "r0"),
    ("net", "app", "r0", 0),
    ("wake", "r0", 1000000),
    ("net", "app", "r0", 1),
    ("wake", "app", 1000000),
    ("load", "q1", "app", "r0", "s1", b"q", True),
    ("line", "q1", 0, ""),
    ("wake", "r0", 1000000),
    ("call", "r0", "load", "q1", 1, "ok"),
    ("wake", "r0", 1000000),
    ("line", "q1", 1, ""),
    ("wake", "app", 1000000),
]
LET_GO_BY_APP: list[Step] = [
    ("owe", "app", "q1", ""),
    ("line", "q1", 0, ""),
    ("wake", "r0", 1000000),
    ("call", "r0", "unload", "q1", 1, "ok"),
    ("wake", "r0", 1000000),
    ("line", "q1", 1, ""),
]
OWED_BEFORE_HELD_WAS_WRITTEN: list[Step] = [*HELD_BY_APP, *LET_GO_BY_APP, ("save", "app"), ("crash", "app", "down")]

# The same, and a status of it waits to be taken up.
OWED_BEFORE_A_STATUS: list[Step] = [
    *HELD_BY_APP,
    ("save", "app"),
    ("own", "r0", "status", "q1", "WARNING"),
    ("wake", "r0", 1000000),
    ("net", "app", "r0", 1),
    *LET_GO_BY_APP,
    ("wake", "app", 1),
    ("save", "app"),
    ("crash", "app", "down"),
]

# A list of before a query was let go by line came after the answer of the line; the query was from before a crash.
LISTED_BEFORE_IT_WAS_LET_GO: list[Step] = [
    ("crash", "r0", "down"),
    ("up", "r0"),
    ("load", "q5", "r0", "r0", "s0", b"q", False),
    ("wake", "r0", 1000000),
    ("register", "r0", "s0"),
    ("wake", "r0", 1),
    ("dial", "r0", "r0"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1),
    ("net", "r0", "r0", 1),
    ("wake", "r0", 1000000),
    ("load", "q8", "r0", "r0", "s0", b"q", False),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000),
    ("call", "r0", "load", "q5.2", 1, "ok"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1000000),
    ("crash", "r0", "down"),
    ("up", "r0"),
    ("serve", "r0"),
    ("dial", "r0", "r0"),
    ("net", "r0", "r0", 0),
    ("wake", "r0", 1),
    ("net", "r0", "r0", 1),
    ("wake", "r0", 1000000),
    ("owe", "r0", "q8", ""),
    ("cut", "r0", "r0", 1, 2),
    ("net", "r0", "r0", 1),
    ("dial", "r0", "r0"),
    ("net", "r0", "r0", 0),
    ("line", "q8", 0, ""),
    ("wake", "r0", 1000000),
    ("line", "q8", 1, ""),
    ("cut", "r0", "r0", 1, 2),
]

# A response of a resource that was taken away, heard on a link that broke, was kept for the next of the same query.
UPDATED_BEFORE_IT_WAS_TAKEN_AWAY: list[Step] = [
    ("serve", "r0"),
    ("register", "r0", "s1"),
    ("load", "q1", "app", "r0", "s1", b"p", True),
    ("wake", "app", 1),
    ("dial", "app", "r0"),
    ("net", "app", "r0", 0),
    ("wake", "r0", 1000000),
    ("net", "app", "r0", 1),
    ("load", "q2", "r0", "r0", "s1", b"q", True),
    ("wake", "r0", 1000000),
    ("dial", "r0", "r0"),
    ("wake", "app", 1000000),
    ("net", "r0", "r0", 0),
    ("net", "app", "r0", 0),
    ("wake", "r0", 1000000),
    ("net", "r0", "r0", 1),
    ("call", "r0", "load", "q1", 1, "ok"),
    ("wake", "r0", 1000000),
    ("load", "q5", "app", "r0", "s1", b"p", True),
    ("line", "q5", 0, ""),
    ("own", "r0", "response", "q1"),
    ("load", "q14", "r0", "r0", "s1", b"q", True),
    ("own", "r0", "force", "q1"),
    ("snap", "q14"),
    ("line", "q14", 1, ""),
    ("cut", "app", "r0", 2, 0),
    ("net", "app", "r0", 1),
    ("crash", "r0", "down"),
    ("up", "r0"),
    ("register", "r0", "s1"),
    ("serve", "r0"),
    ("dial", "app", "r0"),
    ("net", "app", "r0", 0),
    ("wake", "r0", 1000000),
    ("net", "app", "r0", 1),
    ("wake", "app", 1000000),
    ("net", "app", "r0", 0),
    ("cut", "app", "r0", 0, 2),
]


DIRECTED_WORLDS: dict[str, tuple[int, list[Step]]] = {
    "what was decided for a link sent over the next": (765765286147, DECIDED_FOR_A_LINK_BEFORE),
    "a load told to be held that was given up": (1384620891981, GIVEN_UP_WITH_A_FULL_DISK),
    "a release that is owed said to be refused": (1099511627785, OVERDUE_WITH_A_FULL_DISK),
    "what came by both ways answered by one": (1099511628097, ASKED_BY_BOTH_WAYS),
    "no dedupe of query ids": (322, LOADED_BY_TWO_LINKS),
    "a response of the resource before": (5212514472870, UPDATED_BEFORE_IT_WAS_TAKEN_AWAY),
    "an unload on a line that was left, and by the link": (2199023255949, UNLOADED_BY_BOTH_WAYS),
    "let go by line, and an older row written over that": (2199023255949, OWED_BEFORE_HELD_WAS_WRITTEN),
    "let go by line, whatever waits to be taken up": (2199023255949, OWED_BEFORE_A_STATUS),
    "what is from before a crash let go by line": (7628463471197, LISTED_BEFORE_IT_WAS_LET_GO),
}
