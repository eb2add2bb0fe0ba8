"""`python -m rr_actors`: the command `rr-actors`."""

from __future__ import annotations

from rr_actors.tools.cli import main

main()
