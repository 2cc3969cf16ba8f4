"""One browser for all tests of a page."""

import pytest
from browser import CHROMIUM, Browser


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    made = Browser(tmp_path_factory.mktemp("chromium"))
    yield made
    made.close()
