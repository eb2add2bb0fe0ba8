"""The process of a web page: a program of its own, `rr-actors web`, that lives no longer than the system it shows."""

from __future__ import annotations

import importlib.machinery
import subprocess
import time
from typing import Self

from rr_actors.base.checks import missing_library
from rr_actors.base.errors import Unavailable, shown
from rr_actors.runtime import interpreter
from rr_actors.runtime.processes.lifeline import is_readable, kill_group

_LIBRARIES = ("nicegui", "typer", "rich")
"""The libraries of the program. They are looked for and not imported here: only the page's process needs them."""
_START_S = 60.0
"""Seconds that the page may take until it can be opened: a busy machine imports slowly."""
_END_S = 5.0
"""Seconds that the program may take until it has ended, once it has closed its output."""


class WebPage:
    """A web page that System.serve_web() serves. It ends with the system, or with stop(), or a `with` block.

    Attributes:
        url: its address, with the token that opens it.
    """

    def __init__(self, state_dir: str, host: str, port: int) -> None:
        for library in _LIBRARIES:
            if importlib.machinery.PathFinder.find_spec(library) is None:
                raise missing_library(library, "serve_web", "web")
        where = ["--state", state_dir, "--host", host, "--port", str(port), "--child"]
        self._program = subprocess.Popen(
            [interpreter.python("serve_web"), "-m", "rr_actors", "web", *where],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            process_group=0,
        )
        try:
            self.url = self._address()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the page's process at once. Browsers say that they have lost the page. A second stop does nothing."""
        program = self._program
        if program.returncode is None:
            kill_group(program.pid)
            program.wait()
        self._close_pipes()

    def forget(self) -> None:
        """Leave the page to the parent: this is a fork of the process that serves it."""
        self._close_pipes()
        self._program.returncode = 0

    def _close_pipes(self) -> None:
        for pipe in (self._program.stdin, self._program.stdout):
            if pipe is not None:
                pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        return f"<WebPage {'stopped' if self._program.returncode is not None else self.url.partition('?')[0]}>"

    def _address(self) -> str:
        """Return the address that the program prints when the page can be opened."""
        output = self._program.stdout
        assert output is not None
        until = time.monotonic() + _START_S
        printed = b""
        while b"\n" not in printed and is_readable(output.fileno(), until - time.monotonic()):
            if not (got := output.read(4096)):  # it has closed its output
                break
            printed += got
        line, ended, _ = printed.decode(errors="replace").partition("\n")
        if not ended or not line.startswith("http"):
            how = f"its first line is no address: {shown(line)}" if line else self._end()
            raise Unavailable(f"serve_web: the page did not start: {how}; its error output says why")
        return line.strip()

    def _end(self) -> str:
        """Say how the program, which prints nothing, has ended, if it has."""
        try:
            return f"it has ended with exit code {self._program.wait(_END_S)}"
        except subprocess.TimeoutExpired:
            return "it runs, and prints nothing"
