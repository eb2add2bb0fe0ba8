"""A laboratory without rr_actors: a process of multiprocessing's own manager has the lines. Nobody starts it again."""

from __future__ import annotations

import os
import pty
import signal
import threading
import tty
from functools import cache
from multiprocessing.managers import BaseManager
from typing import Any


class Line:
    def __init__(self, device: str) -> None:
        self.file = os.open(device, os.O_RDWR | os.O_NOCTTY)
        self.lock = threading.Lock()

    def ask(self, command: str) -> str:
        with self.lock:
            os.write(self.file, f"{command}\n".encode())
            return os.read(self.file, 100).decode().strip()

    def pid(self) -> int:
        return os.getpid()


@cache
def open_line(device: str) -> Line:
    return Line(device)  # never closed: nobody counts the holders


class Lines(BaseManager):
    pass


Lines.register("line", open_line)


def instrument() -> str:
    inside, outside = pty.openpty()
    tty.setraw(outside)

    def answer() -> None:
        while command := os.read(inside, 100).strip():
            os.write(inside, b"multimeter 7\n" if command == b"*IDN?" else b"1.25 V\n")

    threading.Thread(target=answer, daemon=True).start()
    return os.ttyname(outside)


def main() -> None:
    lines: Any = Lines()
    lines.start()
    line = lines.line(instrument())
    print(f"{line.ask('*IDN?')}: {line.ask('READ?')}")
    os.kill(line.pid(), signal.SIGKILL)
    try:
        line.ask("READ?")
    except (EOFError, OSError) as error:
        print(f"after kill -9: {type(error).__name__} in every program that has a line")


if __name__ == "__main__":
    main()
