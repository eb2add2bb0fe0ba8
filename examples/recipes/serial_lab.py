"""A laboratory: a manager owns the serial lines of the instruments, and opens them again after its own crash.

A pseudo-terminal and a thread stand in for an instrument at /dev/ttyUSB0.
"""

from __future__ import annotations

import os
import pty
import tempfile
import threading
import tty

import rr_actors as rr


class Instruments(rr.Manager):
    def __init__(self) -> None:
        self.lines: dict[str, int] = {}  # by the id of the resource: a device may have two for a while
        self.lock = threading.Lock()  # a load and a message may come at once

    @rr.server("instrument")
    def open_line(self, device: str) -> str:
        me = rr.current().resource_id
        self.lines[me] = os.open(device, os.O_RDWR | os.O_NOCTTY)
        return self.ask(me, "*IDN?")

    @open_line.recover
    def open_again(self, device: str, name: str) -> str:
        return self.open_line(device)  # if it raises, the holders hear FATAL

    @open_line.unload
    def close_line(self, device: str, name: str) -> None:
        line = self.lines.pop(rr.current().resource_id, None)
        if line is not None:  # after a crash in this callback the kernel has closed it
            os.close(line)

    def on_receive(self, message: tuple[str, str]) -> str:
        return self.ask(*message)

    def ask(self, resource_id: str, command: str) -> str:
        with self.lock:
            os.write(self.lines[resource_id], f"{command}\n".encode())
            return os.read(self.lines[resource_id], 100).decode().strip()


def instrument() -> str:
    """Start an instrument; the name of its line."""
    inside, outside = pty.openpty()
    tty.setraw(outside)

    def answer() -> None:
        while command := os.read(inside, 100).strip():
            os.write(inside, b"multimeter 7\n" if command == b"*IDN?" else b"1.25 V\n")

    threading.Thread(target=answer, daemon=True).start()
    return os.ttyname(outside)


def main() -> None:
    device, children = instrument(), [rr.ChildSpec(Instruments, id="instruments")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        first, second = (system.open_registrar(name) for name in ("plotter", "logger"))
        meter = first.load("instruments/instrument", device)
        print(f"{meter.response}: {system.ref('instruments').ask((meter.resource_id, 'READ?'))}")
        system.ref("instruments").kill()
        shared = second.load("instruments/instrument", device)  # waits for the new manager, and shares the line
        print(f"after kill -9: {system.ref('instruments').ask((meter.resource_id, 'READ?'))}, {meter.state}")
        print(f"one line for both: {shared.resource_id == meter.resource_id}")


if __name__ == "__main__":
    main()
