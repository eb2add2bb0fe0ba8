"""What threads load and let go directly (direct_lines.py), as long as their registrar's loop does not know of it.

A load that is under way is known to its thread alone. What it got is noted for the loop, which takes it up some
milliseconds later: until then the note is all there is of the query in this process, in memory and on disk. So a thread
that lets go of such a brief hold takes the note back, and exchanges Unload and Unloaded with the provider itself; the
loop, the catalog and the disk never hear of the query. A crash meanwhile is as one before the unload: the provider has
it still, and reconciling brings it back, or the provider has not, and nobody is left who knew of it.

If something comes in that may be about a query under way, the loop is told of that before (own_up_to_all).
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from rr_actors.registrar.model.commands import Ask, Got, LettingGo


class UnderWay:
    """The direct loads and unloads of one registrar. From any thread, but for what says otherwise.

    Args:
        note: gives the loop a command, which it takes up before whatever comes in next.
    """

    def __init__(self, note: Callable[[Ask | Got | LettingGo], None]) -> None:
        self._note = note
        self._lock = threading.Lock()  # who owns up for a thread, and that thread, do not both
        self._loading: dict[str, Ask] = {}
        self._noted: dict[str, Got] = {}  # who takes one out decides: the loop takes it up, or a thread lets it go
        self._taken_back: dict[str, bool] = {}  # by a thread: these notes mean nothing any more
        self._letting_go: dict[str, Got] = {}

    def __len__(self) -> int:
        return len(self._loading) + len(self._letting_go)

    @property
    def loads(self) -> int:
        """How many loads there are."""
        return len(self._loading)

    @property
    def unloads(self) -> int:
        """How many unloads there are."""
        return len(self._letting_go)

    # -- loads ---------------------------------------------------------------------------------------------------

    def load(self, ask: Ask) -> None:
        """A thread begins to load."""
        self._loading[ask.query_id] = ask

    def got(self, got: Got) -> None:
        """It has got it."""
        query_id = got.ask.query_id
        with self._lock:
            if query_id in self._loading:
                self._noted[query_id] = got  # the loop knows nothing of it: it may be let go so
            self._note(got)  # before it is taken from those that are loading: there is no moment it is unknown
            self._loading.pop(query_id, None)

    def refused(self, query_id: str) -> bool:
        """Its provider has refused it; False if the loop knows of it by now, and may have sent it again."""
        with self._lock:
            return self._loading.pop(query_id, None) is not None

    def leave(self, ask: Ask) -> None:
        """Its thread gives it to the loop, unanswered."""
        with self._lock:
            if ask.query_id in self._loading:
                self._note(ask)
                self._loading.pop(ask.query_id, None)

    def take_up(self, got: Got) -> bool:
        """Whether what is noted still holds. On the loop, for each note, and again if it was put back."""
        query_id = got.ask.query_id
        if self._noted.pop(query_id, None) is not None or not self._taken_back:
            return True
        with self._lock:  # a thread may be about to see that it is too late, as this was taken up and put back before
            return self._taken_back.pop(query_id, None) is None

    # -- unloads of brief holds ----------------------------------------------------------------------------------

    def provider_of(self, query_id: str) -> str | None:
        """Where a brief hold is; None if the query is none."""
        got = self._noted.get(query_id)
        return None if got is None else got.ask.registrar

    def let_go(self, query_id: str) -> bool:
        """A thread begins to let go of a brief hold; False if it is none any more."""
        if query_id not in self._noted:
            return False
        with self._lock:
            self._taken_back[query_id] = True  # first: the loop finds the one or the other
            got = self._noted.pop(query_id, None)
            if got is None:
                self._taken_back.pop(query_id, None)
                return False
            self._letting_go[query_id] = got
            return True

    def gone(self, query_id: str) -> bool:
        """Its provider has let it go; False if the loop knows of it by now, and has to be told."""
        if query_id not in self._letting_go:
            return False
        with self._lock:
            return self._letting_go.pop(query_id, None) is not None

    # -- owning up -----------------------------------------------------------------------------------------------

    def own_up(self, query_id: str) -> None:
        """Make an unload known to the loop, if it is not: the query was held, and is owed."""
        with self._lock:
            got = self._letting_go.get(query_id)
            if got is not None:
                self._note(LettingGo(query_id, got))
                del self._letting_go[query_id]

    def own_up_to_all(self) -> None:
        """Make everything known that is under way."""
        for query_id in list(self._letting_go):
            self.own_up(query_id)
        for ask in list(self._loading.values()):
            self.leave(ask)
