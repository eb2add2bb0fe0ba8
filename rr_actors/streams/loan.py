"""Loan: an array to fill, which a stream publishes without a copy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, cast

from rr_actors.base import pickling
from rr_actors.base.errors import MissingDependency, UsageError, shown
from rr_actors.wire.segments import Parcel


class Lender(Protocol):
    """The publisher that a loan is of."""

    @property
    def name(self) -> str:
        """The stream's name."""
        ...

    def lend(self, value: pickling.Large) -> tuple[Parcel, memoryview] | None:
        """Return memory that the readers share, for a value with one buffer; None: nobody reads, or there is none."""
        ...

    def publish_lent(self, value: pickling.Large, parcel: Parcel, limit_s: float | None) -> int:
        """Send a value whose memory has been filled."""
        ...

    def publish(self, value: object, *, timeout_s: float | None = None) -> int:
        """Send a value."""
        ...


class Loan:
    """An array to fill, which a stream publishes: Publisher.loan() makes it. It is a context manager, for one block."""

    def __init__(self, publisher: Lender, shape: int | Sequence[int], dtype: object, limit_s: float | None) -> None:
        what = f"stream {publisher.name!r}: loan()"
        try:
            import numpy  # most programs do without; it is not among the package's requirements
        except ImportError:
            text = f"{what} makes arrays of numpy, which is not installed. Install it with: pip install numpy"
            raise MissingDependency(text, module="numpy", install="pip install numpy") from None
        try:
            array = numpy.empty(shape, cast(Any, dtype))
        except (TypeError, ValueError, MemoryError) as error:
            raise UsageError(f"{what}: no array of shape {shown(shape)} and dtype {shown(dtype)}: {error}") from error
        if array.dtype.hasobject:
            raise UsageError(f"{what}: an array of dtype {shown(dtype)} has Python objects: publish() it")
        self._publisher = publisher
        self._what = what
        self._limit_s = limit_s
        self._array: Any = array
        self._lent: tuple[pickling.Large, Parcel] | None = None
        self._entered = False

    def __enter__(self) -> Any:
        if self._entered:
            raise UsageError(f"{self._what}: a loan is for one block: make another for the next frame")
        self._entered = True
        value = pickling.dumps_around(self._array, self._what)
        if len(value.buffers) == 1 and (lent := self._publisher.lend(value)) is not None:
            parcel, memory = lent
            self._array = pickling.loads_large(memoryview(value.parts[0]), [memory])
            self._lent = pickling.Large(self._array, self._what, value.parts, (memory,)), parcel
        return self._array

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        array, lent = self._array, self._lent
        self._array = self._lent = None
        array.flags.writeable = False
        if error is None and lent is not None:
            self._publisher.publish_lent(*lent, self._limit_s)
        elif error is None:
            self._publisher.publish(array, timeout_s=self._limit_s)
