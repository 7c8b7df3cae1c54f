"""What is built once for the tests of a process."""

import pytest
from truths import small_box


@pytest.fixture(scope="session")
def target():
    return small_box.target()


@pytest.fixture(scope="session")
def solid():
    return small_box.solid()
