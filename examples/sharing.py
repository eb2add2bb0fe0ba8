"""Sharing: two consumers ask for the same thing and share it; it is closed when the last of them has let go.

python examples/sharing.py
"""

from __future__ import annotations

import tempfile

import rr_actors as rr


def main() -> None:
    opened: list[str] = []
    closed: list[str] = []

    def load(request: str) -> str:
        opened.append(request)
        return f"/camera/{request}"

    def unload(request: str, response: str) -> None:
        closed.append(request)

    with tempfile.TemporaryDirectory() as state, rr.System(state_dir=state) as system:
        cameras = system.open_registrar("cameras")
        cameras.register_server("camera", load, unload)

        mapper = system.open_registrar("mapper")
        guard = system.open_registrar("guard")
        first = mapper.load("cameras/camera", "front")
        second = guard.load("cameras/camera", "front")

        (resource,) = cameras.resources()
        same = first.resource_id == second.resource_id == resource.id
        print(f"two holders, one camera: {same}, opened {len(opened)} time")
        print("held by:", ", ".join(sorted(resource.holders)))

        first.unload()
        print("first leaves: camera", "closed" if closed else "stays open")
        second.unload()
        print("last leaves: camera", "closed" if closed else "stays open")


if __name__ == "__main__":
    main()
