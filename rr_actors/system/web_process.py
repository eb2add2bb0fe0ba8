"""The process of a web page: a program of its own, `rr-actors web`, that lives no longer than the system it shows."""

from __future__ import annotations

import importlib.machinery
import re
import subprocess
import time
from collections.abc import Sequence
from typing import Self, cast

from rr_actors.base.checks import missing_library
from rr_actors.base.errors import Unavailable, UsageError, shown
from rr_actors.runtime import interpreter
from rr_actors.runtime.processes.lifeline import is_readable, kill_group

_LIBRARIES = ("nicegui", "typer", "rich")
"""The libraries of the program. They are looked for and not imported here: only the page's process needs them."""
_START_S = 60.0
"""Seconds that the page may take until it can be opened: a busy machine imports slowly."""
_END_S = 5.0
"""Seconds that the program may take until it has ended, once it has closed its output."""


_PREFIX = re.compile(r"(/[\w.~@:+,=!$'()*%-]+)*/?", re.ASCII)
_NAME = re.compile(r"[\w.-]+(:\d+)?", re.ASCII)


def check_proxy(where: str, prefix: object, hosts: object) -> None:
    """Check what is said of a proxy between browsers and a page. "{port}" in the prefix is the port of the page.

    Raises:
        UsageError: the prefix is no path, or a host has no name.
    """
    if not isinstance(prefix, str) or not _PREFIX.fullmatch(prefix.replace("{port}", "1")):
        raise UsageError(f'{where}: prefix: expected a path, such as "/user/me/proxy/8123", got {shown(prefix)}')
    if isinstance(hosts, str) or not isinstance(hosts, Sequence):
        raise UsageError(f"{where}: hosts: expected a list of names, got {shown(hosts)}")
    for name in cast("Sequence[object]", hosts):
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            expected = 'the name of a host, such as "hub.example.org" or "hub.example.org:8443"'
            raise UsageError(f"{where}: host name: expected {expected}, got {shown(name)}")


class WebPage:
    """A web page that System.serve_web() serves. It ends with the system, or with stop(), or a `with` block.

    Attributes:
        url: its address, with the token that opens it.
    """

    def __init__(self, state_dir: str, host: str, port: int, prefix: str = "", hosts: Sequence[str] = ()) -> None:
        for library in _LIBRARIES:
            if importlib.machinery.PathFinder.find_spec(library) is None:
                raise missing_library(library, "serve_web", "web")
        where = ["--state", state_dir, "--host", host, "--port", str(port), "--child"]
        where += ["--prefix", prefix, *(word for name in hosts for word in ("--host-name", name))]
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
