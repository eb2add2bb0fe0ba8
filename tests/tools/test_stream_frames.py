"""Frames as pictures: PNGs of what is published, small ones too, and no more often than is allowed."""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Callable
from typing import Any

import numpy
import pytest

import rr_actors as rr
from rr_actors.tools.terminal.stream_frames import Thumbnails, png
from support import eventually

Start = Callable[..., rr.System]


def pixels(data: bytes) -> Any:
    """The array that a PNG shows."""
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    assert bits == 8
    depth = {0: 1, 2: 3, 6: 4}[colour]
    (length,) = struct.unpack_from(">I", data, 33)
    lines = numpy.frombuffer(zlib.decompress(data[41 : 41 + length]), "u1").reshape(height, 1 + width * depth)
    assert not lines[:, 0].any()  # no filter
    shape = (height, width) if depth == 1 else (height, width, depth)
    return lines[:, 1:].reshape(shape)


def picture(*shape: int) -> Any:
    return numpy.random.default_rng(7).integers(0, 256, shape, "u1")


@pytest.mark.parametrize("side", [0, 1, 4, 7, 240])
@pytest.mark.parametrize("shape", [(1, 1), (7, 3), (3, 16, 3), (9, 8, 4), (700, 2, 3)])
def test_a_png_has_each_pixel_or_each_nth(shape: tuple[int, ...], side: int) -> None:
    value = picture(*shape)
    step = -(-max(shape[:2]) // side) if side else 1

    found = pixels(png(value, side))

    assert (found == value[::step, ::step]).all()
    assert not side or max(found.shape[:2]) <= side


def test_arrays_that_lie_otherwise_in_memory_are_pictures_too() -> None:
    value = picture(8, 6, 3)
    assert (pixels(png(value[:, ::-1])) == value[:, ::-1]).all()
    assert (pixels(png(numpy.asfortranarray(value), 3)) == value[::3, ::3]).all()


@pytest.mark.parametrize(
    "value", ["<script>", b"abc", 7, None, numpy.zeros((2, 3)), numpy.zeros((2, 3, 2), "u1"), numpy.zeros((0, 3), "u1")]
)
def test_other_values_are_no_pictures(value: object) -> None:
    with pytest.raises((TypeError, ValueError)):
        png(value)


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> rr.Stream:
        self.images = rr.current().open_stream("images")
        return self.images.stream

    def publish(self, value: object) -> int:
        return self.images.publish(value)


def test_the_newest_picture_is_small_and_read_seldom_and_other_values_have_none(start: Start) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras"))
    stream = system.open_registrar("app").load(Cameras.open_camera, "front").response
    cameras, thumbnails = system.ref("cameras").proxy(), Thumbnails()

    def newest_after(value: object) -> bytes:
        """What is seen when the value is published again and again."""
        seen: list[bytes] = []
        looks = threading.Thread(target=lambda: seen.append(thumbnails.newest(stream)))
        looks.start()
        while looks.is_alive():
            cameras.publish(value).get()
        looks.join()
        return seen[0]

    red = numpy.zeros((480, 640, 3), "u1")
    red[..., 0] = 200
    assert (pixels(eventually(lambda: newest_after(red))) == red[::3, ::3]).all()
    assert pixels(thumbnails.newest(stream)).shape == (160, 214, 3)  # at once: nobody publishes
    eventually(lambda: newest_after("<img src=x onerror=alert(1)>") == b"")


def test_of_a_stream_that_is_not_open_there_is_no_picture() -> None:
    assert Thumbnails().newest(rr.Stream("0" * 32, "images")) == b""
