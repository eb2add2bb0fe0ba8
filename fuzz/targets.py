"""All targets, by name."""

from __future__ import annotations

from fuzz.catalogs import CATALOG
from fuzz.consoles import CONSOLE
from fuzz.files import CHILD, READERS, RECORDED, RELIABILITY
from fuzz.journals import JOURNAL
from fuzz.peers import PEER
from fuzz.requests import REQUESTS
from fuzz.streams import CONTROL, FRAMES, HANDSHAKE
from fuzz.target import Target

TARGETS: dict[str, Target] = {
    "frames": FRAMES,
    "handshake": HANDSHAKE,
    "control": CONTROL,
    "peer": PEER,
    "console": CONSOLE,
    "requests": REQUESTS,
    **READERS,
    "reliability.json": RELIABILITY,
    "child": CHILD,
    "recorded": RECORDED,
    "catalog": CATALOG,
    "journal": JOURNAL,
}
