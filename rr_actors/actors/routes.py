"""Routes: by which way a provider answers: by the direct line that the question came by, the consumer's link, or both.

Both is for what the link has asked after the line. A thread that leaves a line closes it, and its end is read with what
is in it or directly after: what comes from a line that has been left is answered by the link.
"""

from __future__ import annotations

from typing import Any

from rr_actors.messages import Load, Loaded, LoadRefused, Message, Unload, Unloaded, UnloadRefused


class Routes:
    """Those of one provider. On the loop.

    Loads and unloads apart: the answer to a Load that comes late, or twice, is not that to an Unload of the same query.
    """

    def __init__(self) -> None:
        self._loads: dict[str, Any] = {}  # query -> the line that its Load came by, which is not answered
        self._unloads: dict[str, Any] = {}
        self._twice: set[tuple[str, bool]] = set()  # what the link has asked too; whether it is a Load

    def asked_by_link(self, question: Load | Unload) -> None:
        """A consumer's link has asked."""
        is_load = type(question) is Load
        if question.query_id in (self._loads if is_load else self._unloads):
            self._twice.add((question.query_id, is_load))

    def asked_by_line(self, line: Any, question: Load | Unload) -> None:
        """A direct line has asked."""
        (self._loads if type(question) is Load else self._unloads)[question.query_id] = line

    def way_of(self, message: Message) -> tuple[Any, bool]:
        """The line that a message to a consumer goes by, or None, and whether it goes by the link; once for each."""
        if isinstance(message, (Loaded, LoadRefused)):
            lines = self._loads
        elif isinstance(message, (Unloaded, UnloadRefused)):
            lines = self._unloads
        else:
            return None, True
        line = lines.pop(message.query_id, None)
        if line is None:
            return None, True
        by_link = type(message) is UnloadRefused  # which has to come before the statuses that follow it
        if self._twice and (key := (message.query_id, lines is self._loads)) in self._twice:
            self._twice.discard(key)
            by_link = True
        return line, by_link

    def line_lost(self, line: Any) -> None:
        """A line is no more: what it waits for is answered by the link."""
        for lines in (self._loads, self._unloads):
            for query_id in [query_id for query_id, route in lines.items() if route is line]:
                del lines[query_id]
                self._twice.discard((query_id, lines is self._loads))

    def clear(self) -> list[Any]:
        """Forget everything; returns the lines that wait for an answer."""
        lines = [*self._loads.values(), *self._unloads.values()]
        self.__init__()
        return lines
