"""Fixtures that several test modules share."""

import pytest


@pytest.fixture(params=["cpu"])
def device(request) -> str:
    """Every device that the renderer supports."""
    return request.param
