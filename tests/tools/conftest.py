"""Fixtures for tests of web pages: a browser for each process of tests, a tab for each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support_browser import Chromium, Tab


@pytest.fixture(scope="session")
def chromium() -> Iterator[Chromium]:
    """A browser."""
    browser = Chromium()
    browser.open()
    yield browser
    browser.close()


@pytest.fixture
def tab(chromium: Chromium) -> Iterator[Tab]:
    """A tab in a browser of its own."""
    with chromium.tab() as tab:
        yield tab
