"""What all tests share."""

from __future__ import annotations

import os

import pytest

# Each worker has its share of the cores, and so have the processes that it starts: threads of matrix products that wait for
# one another by spinning cost a fit five times its time where another worker has the other core. Read when numpy is
# imported, which no plugin does before this.
_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _WORKERS > 1:
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // _WORKERS)))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes minutes, so that at the end no worker waits for another."""
    items.sort(key=lambda item: item.get_closest_marker("minutes") is None)
