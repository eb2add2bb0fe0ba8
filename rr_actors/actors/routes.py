"""Routes: by which way a provider answers: by the direct line that the question came by, the consumer's link, or both.

Both is for what both have asked. A thread that leaves a line closes it and has the link ask, too; its end is read with
what is in it or some time after, so a question may be answered to a line that nobody reads any more.
"""

from __future__ import annotations

from typing import Any

from rr_actors.messages import Load, Loaded, LoadRefused, Message, Unload, Unloaded, UnloadRefused


class Routes:
    """Those of one provider. On the loop, but for line_of and answered.

    Loads and unloads apart: the answer to a Load that comes late, or twice, is not that to an Unload of the same query.
    """

    def __init__(self) -> None:
        self._load_lines: dict[str, Any] = {}  # query -> the line that its Load came by, which is not answered
        self._unload_lines: dict[str, Any] = {}
        self._load_links: dict[
            str, str
        ] = {}  # query -> the consumer by whose link its Load came, which is not answered
        self._unload_links: dict[str, str] = {}

    @property
    def open_by_link(self) -> int:
        """How many questions of links are not answered yet."""
        return len(self._load_links) + len(self._unload_links)

    def asked_by_link(self, consumer: str, question: Load | Unload) -> None:
        """A consumer's link has asked."""
        links = self._load_links if type(question) is Load else self._unload_links
        links[question.query_id] = consumer

    def asked_by_line(self, line: Any, question: Load | Unload) -> None:
        """A direct line has asked."""
        lines = self._load_lines if type(question) is Load else self._unload_lines
        lines[question.query_id] = line

    def way_of(self, message: Message) -> tuple[Any, bool]:
        """The line that a message to a consumer goes by, or None, and whether it goes by the link; once for each."""
        if isinstance(message, (Loaded, LoadRefused)):
            asked = self._load_links.pop(message.query_id, None) is not None
            line = self._load_lines.pop(message.query_id, None)
        elif isinstance(message, (Unloaded, UnloadRefused)):
            asked = self._unload_links.pop(message.query_id, None) is not None
            line = self._unload_lines.pop(message.query_id, None)
            self._load_links.pop(message.query_id, None)  # a Load that was withdrawn is not answered
        else:
            return None, True
        # A refusal has to come before the statuses that follow it.
        return line, asked or line is None or type(message) is UnloadRefused

    def line_of(self, answer: Message) -> Any:
        """The line that an answer goes by, and by nothing else; None if there is none. From any thread."""
        if isinstance(answer, (Loaded, LoadRefused)):
            return None if answer.query_id in self._load_links else self._load_lines.get(answer.query_id)
        if isinstance(answer, Unloaded):
            return None if answer.query_id in self._unload_links else self._unload_lines.get(answer.query_id)
        return None

    def answered(self, answer: Message) -> None:
        """It goes by that line, without way_of. From any thread."""
        if isinstance(answer, (Loaded, LoadRefused)):
            self._load_lines.pop(answer.query_id, None)
        elif isinstance(answer, Unloaded):
            self._unload_lines.pop(answer.query_id, None)
            self._load_links.pop(answer.query_id, None)  # a Load that was withdrawn is not answered

    def line_lost(self, line: Any) -> None:
        """A line is no more: what it waits for is answered by the link."""
        for lines in (self._load_lines, self._unload_lines):
            for query_id in [query_id for query_id, route in list(lines.items()) if route is line]:
                del lines[query_id]

    def lines_of(self, consumer: str) -> list[Any]:
        """The lines of a consumer's threads that wait for an answer."""
        lines = [*self._load_lines.values(), *self._unload_lines.values()]
        return [line for line in lines if line.hello.origin == consumer]

    def link_lost(self, consumer: str) -> None:
        """A consumer's link is no more: what is still open is asked again over the next."""
        for links in (self._load_links, self._unload_links):
            for query_id in [query_id for query_id, origin in links.items() if origin == consumer]:
                del links[query_id]

    def clear(self) -> list[Any]:
        """Forget everything; returns the lines that wait for an answer."""
        lines = [*self._load_lines.values(), *self._unload_lines.values()]
        self.__init__()
        return lines
