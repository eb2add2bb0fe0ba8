"""Dependencies: what a load callback loads belongs to what is being loaded, and goes with it; a failure leaves nothing.

python examples/dependencies.py
"""

from __future__ import annotations

import tempfile

import rr_actors as rr


class Parts(rr.Manager):
    def __init__(self, gone: list[str]) -> None:
        self.gone = gone

    @rr.server("part")
    def load_part(self, request: str) -> str:
        if request not in ("arm", "lidar"):
            raise ValueError(f"no part called {request!r}")
        return request

    @load_part.unload
    def unload_part(self, request: str, response: str) -> None:
        self.gone.append(request)


class Robots(Parts):  # a manager inherits servers, too
    @rr.server("robot")
    def load_robot(self, request: list[str]) -> list[str]:
        return [self.registrar.load("parts/part", name).response for name in request]

    @load_robot.unload
    def unload_robot(self, request: list[str], response: list[str]) -> None:
        self.gone.append("robot")


def main() -> None:
    gone: list[str] = []
    kinds = {"parts": Parts, "robots": Robots}
    children = [rr.ChildSpec(kind, id=id, args=(gone,), placement="thread") for id, kind in kinds.items()]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        app, robots = system.open_registrar("app"), system.registrar("robots")
        robot = app.load("robots/robot", ["arm", "lidar"])
        print("robot stands on:", ", ".join(part.request for part in robots.children(robot)))
        try:
            app.load("robots/robot", ["arm", "warp drive"])
        except rr.LoadFailed as error:
            print("a robot with a broken part:", type(error).__name__)
            for number, frame in enumerate(error.trace, 1):
                print(f"  {number}. {frame}")
        print("nothing of it is left:", [query.id for query in app.queries()] == [robot.id])
        robot.unload()
    print("unloaded:", ", ".join(gone))


if __name__ == "__main__":
    main()
