"""What all tests share."""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Generator, Iterator

import pytest
from hypothesis import settings

from openant_tools.opengl import load_no_window_library

# Each worker has its share of the cores, and so have the processes that it starts: threads of matrix products that wait for
# one another by spinning cost a fit five times its time where another worker has the other core. Read when numpy is
# imported, which no plugin does before this. Where its share is one core, joblib works in the worker itself.
_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _WORKERS > 1:
    for _limit in ("OMP_NUM_THREADS", "LOKY_MAX_CPU_COUNT"):
        os.environ.setdefault(_limit, str(max(1, (os.cpu_count() or 1) // _WORKERS)))

# The log of what the tests run is none of the user's.
os.environ.setdefault("XDG_STATE_HOME", tempfile.mkdtemp(prefix="openant-state-"))

# What the tests start by the hundred compiles our modules once, not each time; and MuJoCo loads no window library.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
load_no_window_library()

# How long an example takes says what else the machine does. `--hypothesis-profile thorough` looks farther.
settings.register_profile("ours", deadline=None, max_examples=50)
settings.register_profile("thorough", deadline=None, max_examples=1000)
settings.load_profile("ours")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported while tests are collected lives as long as their process: nobody looks among it for garbage.

    It is half a million objects; to search them meanwhile and at the end takes each worker four seconds.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--long", action="store_true", help="run what takes minutes, too, and the blocks of docs/ that are marked long"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what takes minutes, or begin with it, so that at the end no worker waits for another."""
    if config.getoption("--long"):
        items.sort(key=lambda item: item.get_closest_marker("minutes") is None)
        return
    for item in items:
        if item.get_closest_marker("minutes") is not None:
            item.add_marker(pytest.mark.skip(reason="takes minutes: run it with --long"))


@pytest.fixture
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for hands here: readings while a virtual hand moves something end with its motion, motions are short.

    What is counted over and over again to find what is rare, and is not there, is counted less often.
    """
    from openant_tools.bringup import comms_step, identification
    from openant_tools.calib import arena, centre, comms_health, inventory, legs, motions, sweep
    from openant_tools.comms import bench, soak
    from openant_tools.thermal import step as thermal_step

    monkeypatch.setattr(comms_health, "CYCLES", 100)
    monkeypatch.setattr(comms_health, "FAST_S", 0.3)
    monkeypatch.setattr(bench, "TRIES", 10)
    monkeypatch.setattr(inventory, "SWEEP_READS", 30)
    monkeypatch.setattr(soak, "MOVE_S", 4.0)
    monkeypatch.setattr(soak, "REST_S", 1.0)
    monkeypatch.setattr(sweep, "SPEED_RAD_S", 0.7)
    monkeypatch.setattr(centre, "SLOW_RAD_S", 0.8)
    monkeypatch.setattr(legs, "READ_S", 2.5)
    monkeypatch.setattr(motions, "SECONDS", dict.fromkeys(motions.LIBRARY, 1.5))
    monkeypatch.setattr(identification, "RECORD_S", 5.0)
    monkeypatch.setattr(arena, "WIGGLE_S", 3.0)
    monkeypatch.setattr(comms_step, "DEFAULT_MIN", 0.1)
    monkeypatch.setattr(thermal_step, "DEFAULT_MIN", 0.3)
    monkeypatch.setattr(thermal_step, "SHORTEST_MIN", 0.3)


@pytest.fixture(scope="module")
def half_rate() -> Iterator[None]:
    """50 Hz instead of 100: as often as a slow sweep has to look to tell friction."""
    from builder import engine_rate

    with engine_rate(50.0):
        yield


@pytest.fixture
def sweeping() -> Iterator[None]:
    """The same for a test whose module needs less."""
    from builder import engine_rate

    with engine_rate(50.0):
        yield


@pytest.fixture(scope="module")
def quarter_rate() -> Iterator[None]:
    """25 Hz: enough where what counts is what is asked, said and written."""
    from builder import engine_rate

    with engine_rate(25.0):
        yield
