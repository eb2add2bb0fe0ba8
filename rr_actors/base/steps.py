"""Steps: a clean-up whose steps all run, even if some of them raise; their errors are raised at the end."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from rr_actors.base.reporting.log import Log


class Steps:
    """The steps of one clean-up; call end() or report() after the last. A step's error has a note with its name."""

    def __init__(self) -> None:
        self._errors: list[Exception] = []
        self._interruption: BaseException | None = None  # KeyboardInterrupt, SystemExit: no error of the clean-up

    def take(self, what: str, do: Callable[..., object], *args: Any) -> None:
        """Run a step, and keep its error."""
        try:
            do(*args)
        except Exception as error:
            self._keep(what, error)
        except BaseException as error:
            self._interruption = self._interruption or error

    async def take_async(self, what: str, step: Awaitable[object]) -> None:
        """Await a step, and keep its error. A cancellation is raised at once, and the caller decides what follows."""
        try:
            await step
        except Exception as error:
            self._keep(what, error)

    def _keep(self, what: str, error: Exception) -> None:
        error.add_note(f"while {what}")
        self._errors.append(error)

    def end(self, text: str) -> None:
        """Raise the errors of the steps.

        Raises:
            Exception: the error, if one step failed.
            ExceptionGroup: the errors of several steps, with `text`.
            BaseException: an interruption; the errors are its cause then.
        """
        errors = self._errors
        error = None if not errors else errors[0] if len(errors) == 1 else ExceptionGroup(text, errors)
        if self._interruption is not None:
            raise self._interruption from error
        if error is not None:
            raise error

    def report(self, logger: Log, text: str) -> None:
        """Log the errors of the steps, if no caller could handle them; raise an interruption."""
        for error in self._errors:
            logger.error("%s: %s", text, "; ".join(error.__notes__), exc_info=error)
        if self._interruption is not None:
            raise self._interruption
