"""Steps: a clean-up of which every step is tried, whatever the others raise; what they raised is raised at its end."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from typing import Any


class Steps:
    """The steps of one clean-up; end() it, or report() it. What a step raises has a note of what it was about."""

    def __init__(self) -> None:
        self._errors: list[Exception] = []
        self._interruption: BaseException | None = None  # KeyboardInterrupt, SystemExit: no error of the clean-up

    def take(self, what: str, do: Callable[..., object], *args: Any) -> None:
        """Do a step."""
        try:
            do(*args)
        except Exception as error:
            self._keep(what, error)
        except BaseException as error:
            self._interruption = self._interruption or error

    async def take_async(self, what: str, step: Awaitable[object]) -> None:
        """Do a step that is awaited. Cancelled, the steps end here: what then has to be done is the caller's to say."""
        try:
            await step
        except Exception as error:
            self._keep(what, error)

    def _keep(self, what: str, error: Exception) -> None:
        error.add_note(f"while {what}")
        self._errors.append(error)

    def end(self, text: str) -> None:
        """Raise what the steps raised.

        Raises:
            Exception: what one of them raised, if it was one.
            ExceptionGroup: with `text`, of what several raised.
            BaseException: an interruption; the others are its cause then.
        """
        errors = self._errors
        error = None if not errors else errors[0] if len(errors) == 1 else ExceptionGroup(text, errors)
        if self._interruption is not None:
            raise self._interruption from error
        if error is not None:
            raise error

    def report(self, logger: logging.Logger, text: str) -> None:
        """Log what the steps raised, where nobody could do anything about it.

        Raises:
            BaseException: an interruption.
        """
        for error in self._errors:
            logger.error("%s: %s", text, "; ".join(error.__notes__), exc_info=error)
        if self._interruption is not None:
            raise self._interruption
