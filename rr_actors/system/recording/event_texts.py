"""What events say, for people: the same words in lines, on pages and in pictures."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rr_actors.base.names import named


def ago(seconds: float) -> str:
    """Return a time span for people: "5 s", "3 min", "2 h 10 min", "4 days"."""
    minutes = round(seconds / 60)  # rounded before it is divided: else there would be "1 h 60 min"
    if round(seconds) < 60:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 2 * 24 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{seconds / 86_400:.0f} days"


def clock(at: float) -> str:
    """Return a time for people, to the millisecond, with its day if that is not today."""
    then = time.localtime(at)
    is_today = time.strftime("%Y-%m-%d", then) == time.strftime("%Y-%m-%d", time.localtime(time.time()))
    return time.strftime("%H:%M:%S" if is_today else "%Y-%m-%d %H:%M:%S", then) + f".{int(at % 1 * 1000):03}"


def child_text(facts: Mapping[str, Any]) -> str:
    """Say how something happened to a child: "killed: SIGKILL, after 12 s"."""
    reason, detail = str(facts.get("reason", "")), str(facts.get("detail", ""))
    up_s, ready_s, delay_s = facts.get("up_s"), facts.get("ready_s"), facts.get("delay_s")
    parts = (
        ": ".join(dict.fromkeys(filter(None, (reason, detail)))),
        "" if up_s is None else f"after {ago(up_s)}",
        f"pid {facts['pid']}" if facts.get("pid") and not reason else "",
        f"ready in {ready_s:.2f} s" if ready_s and not reason else "",
        f"starts again in {delay_s:.1f} s" if delay_s else "",
    )
    return ", ".join(filter(None, parts))


def subject_and_how(facts: Mapping[str, Any]) -> tuple[str, str]:
    """Say what an event is about, and how it happened: ("root/cameras", "killed: SIGKILL, after 12 s")."""
    if path := facts.get("path", ""):
        return path, child_text(facts)
    if server := facts.get("server", ""):
        return named(server, facts.get("title") or facts.get("request", "")), facts.get("detail", "")
    return str(facts.get("to", "")), f"{facts.get('message', '')}: {facts.get('why', '')}".strip(": ")


def event_text(at: float, event: str, facts: Mapping[str, Any]) -> str:
    """Say what happened: "12:46:53.020  exited  root/cameras  killed: SIGKILL"."""
    return "  ".join(filter(None, (clock(at), event, *subject_and_how(facts))))
