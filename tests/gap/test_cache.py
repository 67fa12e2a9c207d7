"""What is kept of recordings: nobody else's, made anew where it was altered, and never code."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from plants import pendulum, run_of, sweep, write

from openant_tools.errors import BadInput
from openant_tools.gap.assess import Assessment, assess
from openant_tools.gap.cache import CACHE_VARIABLE, cache_folder
from openant_tools.gap.experiment import Experiment


class Touches:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


ATTACKS: dict[str, Callable[[Path, Path], object]] = {
    "cut": lambda path, ran: os.truncate(path, path.stat().st_size // 2),
    "emptied": lambda path, ran: os.truncate(path, 0),
    "an array of objects": lambda path, ran: np.savez(path, templates=np.array([Touches(ran)], object)),
    "a pickle": lambda path, ran: path.write_bytes(pickle.dumps(Touches(ran))),
}


@pytest.mark.slow
def test_what_was_altered_is_made_anew_and_runs_no_code(
    tmp_path: Path, few_causes: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr("openant_tools.gap.assess.MEASURE", 12)
    monkeypatch.setattr("openant_tools.gap.assess.OTHERS", 4)
    monkeypatch.setattr("openant_tools.gap.assess.PARTS", 1)  # few templates take no longer than one
    t, runs = np.arange(0.0, 1.2, 0.02), []
    for size in (0.6, 0.9):
        command = sweep(t, 1, size)
        columns = {"cmd.joint": command[:, 0], "pos.joint": 0.9 * command[:, 0]}
        runs.append(run_of(columns, t, ["joint"], f"sweep-{size}"))
    made = Experiment.of(runs, write(tmp_path / "given.xml", pendulum()), ["joint"])

    def said() -> Assessment:
        return assess(made.protocol, jobs=1)

    first = said()
    whole, ran = {place: place.read_bytes() for place in cache_folder().iterdir()}, tmp_path / "code ran"
    for attack, spoil in ATTACKS.items():
        for place in whole:
            spoil(place, ran)
        assert said().fit == first.fit, attack
        assert {place: place.read_bytes() for place in cache_folder().iterdir()} == whole, attack
    assert not ran.exists()


def test_the_cache_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    (tmp_path / "gap").mkdir(mode=0o777)
    assert cache_folder().stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(
        BadInput, match=r"the cache belongs to another user .* → name a folder of your own by OPENANT_CACHE"
    ):
        cache_folder()
