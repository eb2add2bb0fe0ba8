"""The configuration of gunicorn for gunicorn_app.py: a system begins and ends with its worker."""

from __future__ import annotations

from typing import Any

import gunicorn_app


def post_worker_init(worker: Any) -> None:
    gunicorn_app.start()


def worker_exit(server: Any, worker: Any) -> None:
    gunicorn_app.stop()
