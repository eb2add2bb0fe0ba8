"""The one door to the inside, for tests that look at the engine below the public names: its rows, lines and commits."""

from __future__ import annotations

from typing import Any

import rr_actors as rr
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.system.console.console_server import Console


def actor_of(registrar: rr.Registrar) -> RegistrarActor:
    """Return the actor of a registrar."""
    return registrar._actor  # pyright: ignore[reportPrivateUsage]


def node_of(owner: Any) -> Node:
    """Return the node that a system, or a subscriber of it, runs on. It runs."""
    node = owner._node
    assert node is not None
    return node


def console_of(system: rr.System) -> Console:
    """Return the console of a system. It runs."""
    console = system._console  # pyright: ignore[reportPrivateUsage]
    assert console is not None
    return console
