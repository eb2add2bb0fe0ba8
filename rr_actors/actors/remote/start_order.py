"""The start order: what the on_start of an actor cannot wait for, as it starts only after that actor."""

from __future__ import annotations

from rr_actors.actors.messaging import ask_cycles
from rr_actors.wire.name_service import Directory, Presence, Turn, actor_key, registrar_key


def why_too_early(directory: Directory, path: str, wait: str) -> str:
    """Say why the actor at `path` cannot come before the on_start that runs this code returns; "" if it can.

    Args:
        wait: the verb for what on_start should do later: "load", "ask".
    """
    asker = ask_cycles.starting()
    if asker is None:
        return ""
    mine, theirs = asker.name.split("/"), path.split("/")
    same = next((at for at, parts in enumerate(zip(mine, theirs, strict=False)) if parts[0] != parts[1]), 0)
    if not same:  # in other trees, or one is above the other
        return ""
    now, due = (directory.lookup(actor_key("/".join(parts[: same + 1]))) for parts in (mine, theirs))
    if now is None or now.turn is not Turn.NOW or due is None or due.turn is not Turn.DUE:
        return ""
    above, first, later = "/".join(mine[:same]), theirs[same], mine[same]
    return (
        f"{path} starts after {asker.name}, whose on_start has not returned: put {first!r} before {later!r} in the "
        f"list of {above}, or {wait} after on_start, in a thread"
    )


def why_registrar_too_early(directory: Directory, name: str) -> str:
    """Say as why_too_early() why a manager, whose registrar has this name, cannot come before this on_start returns."""
    asker = ask_cycles.starting()
    entry = None if asker is None else directory.lookup(registrar_key(name))
    if asker is None or entry is None or entry.status is not Presence.STARTING:
        return ""
    top = asker.name.partition("/")[0]
    paths = [path for path in directory.actor_paths(top) if path.endswith(f"/{name}")]
    return why_too_early(directory, paths[0], "load") if len(paths) == 1 else ""
