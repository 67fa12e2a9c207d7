"""What all tests share."""

from __future__ import annotations

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes minutes, so that at the end no worker waits for another."""
    items.sort(key=lambda item: item.get_closest_marker("minutes") is None)
