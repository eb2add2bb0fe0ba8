"""A program whose tree has given up does not end as if all had gone well."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.base.errors import RestartIntensityExceeded, SupervisionError
from support import LIMIT_S

GIVES_UP = """
import sys
import rr_actors as rr

class Ends(rr.Actor):
    def on_receive(self, message):
        raise ValueError("a defect")

if __name__ == "__main__":
    child = rr.ChildSpec(Ends, id="ends", placement="thread")
    with rr.System(rr.Supervisor([child], id="root", max_restarts=0), state_dir=sys.argv[1]) as system:
        system.ref("ends").tell("now")
        assert system.wait(10)
"""


class Ends(rr.Actor):
    def on_receive(self, message: object) -> None:
        raise ValueError(message)


def tree(restart: str = "permanent") -> rr.Supervisor:
    child = rr.ChildSpec(Ends, id="ends", placement="thread", restart=restart)  # type: ignore[arg-type]
    return rr.Supervisor([child], id="root", max_restarts=0)


def give_up(system: rr.System) -> None:
    system.ref("ends").tell("a defect")
    assert system.wait(LIMIT_S)


def test_leaving_the_block_of_a_tree_that_has_given_up_raises_why(state_dir: Path) -> None:
    with pytest.raises(SupervisionError, match=r"root supervisor has ended: .*restarts? needed") as caught:  # noqa: SIM117
        with rr.System(tree(), state_dir=state_dir) as system:
            give_up(system)

    assert isinstance(caught.value.__cause__, RestartIntensityExceeded)


def test_leaving_the_async_block_of_a_tree_that_has_given_up_raises_why(state_dir: Path) -> None:
    async def program() -> None:
        async with rr.System(tree(), state_dir=state_dir) as system:
            await asyncio.to_thread(give_up, system)

    with pytest.raises(SupervisionError, match="root supervisor has ended"):
        asyncio.run(program())


def test_an_error_of_the_block_is_not_replaced(state_dir: Path) -> None:
    def block() -> None:
        with rr.System(tree(), state_dir=state_dir) as system:
            give_up(system)
            raise LookupError("of the block")

    with pytest.raises(LookupError, match="of the block"):
        block()


def test_a_tree_that_ends_in_order_raises_nothing(state_dir: Path) -> None:
    child = rr.ChildSpec(Ends, id="ends", placement="thread", restart="temporary", significant=True)
    with rr.System(rr.Supervisor([child], id="root", auto_shutdown="any"), state_dir=state_dir) as system:
        system.ref("ends").stop()
        assert system.wait(LIMIT_S)


def test_a_program_that_has_stopped_the_system_itself_knows_of_the_end(state_dir: Path) -> None:
    with rr.System(tree(), state_dir=state_dir) as system:
        give_up(system)
        assert system.ended is not None
        system.stop()


def test_the_program_ends_with_an_exit_code_that_says_so(tmp_path: Path) -> None:
    script = tmp_path / "gives_up.py"
    script.write_text(GIVES_UP)

    ended = subprocess.run(
        [sys.executable, str(script), str(tmp_path / "state")], capture_output=True, text=True, timeout=60, check=False
    )

    assert ended.returncode == 1
    assert "SupervisionError" in ended.stderr
