"""The web server: a process of its own, which reaches a system only by its console."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import contextlib
import errno
import math
import os
import signal
import socket
import sys
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from fastapi.responses import PlainTextResponse
from nicegui import app, background_tasks, binding, ui

from rr_actors.base.errors import RrError, UsageError
from rr_actors.runtime.processes import lifeline
from rr_actors.system.console import console_questions as questions
from rr_actors.system.recording.figures import prometheus_text
from rr_actors.system.web_process import check_proxy
from rr_actors.tools.tables.resource_table import RESOURCES
from rr_actors.tools.tables.sheets import SHEETS
from rr_actors.tools.web.frame.names_found import add_names
from rr_actors.tools.web.lab.lab_pages import add_lab
from rr_actors.tools.web.list_page import ListPage
from rr_actors.tools.web.page_parts import address_of
from rr_actors.tools.web.row_grid import add_rows
from rr_actors.tools.web.sequence_page import Recorder, SequencePage, end_unseen
from rr_actors.tools.web.timeline_page import TimelinePage
from rr_actors.tools.web.watch import Watch
from rr_actors.tools.web.web_access import Access, Keys, is_loopback
from rr_actors.tools.web.web_pages import FiguresPage, OverviewPage, ResourcesPage, TreePage

_CLOSE_S = 1
_LOOK_S = 20.0
_AWAY_S = 15.0
_LAB_AWAY_S = 3.0
"""How long a page may lose its connection, on a busy machine say, and go on as it was. Later it is loaded anew.

A browser that is slow may leave a ping unanswered for 0.4 times as long. A run of the lab ends with its page: sooner.
"""


def serve(
    state_dir: str | os.PathLike[str] | None,
    *,
    lab: Sequence[Path],
    host: str,
    port: int,
    prefix: str = "",
    names: Collection[str] = (),
    is_child: bool,
    say: Callable[[str], None],
) -> None:
    """Serve the pages until a signal ends this process.

    Args:
        state_dir: the directory of the system that is shown; None for the one that runs.
        lab: serve the experiments of these folders in place of a system.
        port: the port, or 0 for a free one.
        prefix: the path before all paths, by which browsers reach this server through a proxy.
        names: of the hosts that they reach it at through a proxy.
        is_child: end when the other end of the standard input is closed, also by a crash.
        say: called with the address, once it can be opened.

    Raises:
        NotRunning: no system runs in the directory, or none at all.
        UsageError: several systems run, and no state directory was given; or the address cannot be used, or the prefix
            or a name is none; or a folder has no experiments.
    """
    check_proxy("web", prefix, names)
    if is_child:
        lifeline.hold(sys.stdin.fileno(), os.getppid())
    listening = _listen(host, port)
    port = listening.getsockname()[1]
    prefix = prefix.replace("{port}", str(port)).rstrip("/")
    keys = Keys()
    if lab:
        folders = list(dict.fromkeys(folder.expanduser().absolute() for folder in lab))
        add_lab(folders, takes_code=is_loopback(host) and not names)
    else:
        watch = Watch(state_dir)
        recorder = Recorder(watch)
        pages = {
            "Overview": partial(OverviewPage, watch),
            "Tree": partial(TreePage, watch),
            "Timeline": partial(TimelinePage, watch),
            "Resources": partial(ResourcesPage, watch),
            **{sheet.name.capitalize(): partial(ListPage, watch, sheet) for sheet in SHEETS if sheet.note},
            "Figures": partial(FiguresPage, watch),
            "Sequence": partial(SequencePage, watch, recorder),
        }
        watch.pages = tuple(pages)
        for name, page in pages.items():
            ui.page(address_of(name), title=f"rr-actors: {name.lower()}")(page)
        add_rows(watch, RESOURCES)
        add_names(watch, {name: address_of(name) for name in pages})
        _add_metrics(watch)
        app.on_startup(watch.start)
        app.on_startup(partial(_begin_to_look, recorder))
        app.on_shutdown(recorder.close)
        app.on_shutdown(watch.stop)
    shown = f"[{host}]" if ":" in host else host
    name = next(iter(names), f"{shown}:{port}")
    server = f"{'http' if is_loopback(name.partition(':')[0]) or not names else 'https'}://{name}"
    app.on_startup(lambda: say(f"{server}{prefix}/{'lab' if lab else ''}?token={keys.token}"))
    served = FastAPI(openapi_url=None)
    binding.MAX_PROPAGATION_TIME = math.inf  # it prints a warning where the machine is busy
    ui.run_with(
        served,
        title="rr-actors",
        favicon="🎭",
        dark=None,
        language="en-US",
        show_welcome_message=False,
        reconnect_timeout=_LAB_AWAY_S if lab else _AWAY_S,
    )
    config = uvicorn.Config(
        Access(served, keys, host, port, prefix, names),
        log_level="warning",
        timeout_graceful_shutdown=_CLOSE_S,
        server_header=False,
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # uvicorn closes all, then raises the signal again
    with contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])


def _begin_to_look(recorder: Recorder) -> None:
    background_tasks.create(end_unseen(recorder))


def _add_metrics(watch: Watch) -> None:
    """Add /metrics to the web server for Prometheus, which shows the token in a header."""

    @app.get("/metrics", response_class=PlainTextResponse)
    def _() -> PlainTextResponse:
        try:
            figures = watch.link.ask(questions.ListFigures(), _LOOK_S).figures
        except RrError as error:
            return PlainTextResponse(f"{error}\n", 503)
        return PlainTextResponse(prometheus_text(figures), media_type="text/plain; version=0.0.4")


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as error:
        other = "--port" if error.errno in (errno.EADDRINUSE, errno.EACCES) else "--host"
        raise UsageError(f"{host}:{port}: cannot be listened at ({error.strerror}); choose another {other}") from error
