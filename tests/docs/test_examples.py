"""The notebooks of examples/ run, cell by cell, in a folder of their own; what takes minutes is cut to seconds.

`examples/identify.ipynb` is played by tests/sysid/test_library.py, `examples/sb3.py` by tests/env/test_other_toolkits.py. TorchRL is too
large to be installed for one script: `make ecosystem` runs `examples/torchrl_ant.py`.
"""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import pytest
from places import ROOT

from openant_tools.cli import main

EXAMPLES = ROOT / "examples"


def openant(*words: object) -> str:
    """As the notebooks have it, but within this process."""
    printed, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(told), pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code in (0, None), told.getvalue()
    return printed.getvalue()


def play(name: str, place: Path, cuts: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What stands in a notebook's memory after all of its cells; `cuts` are made in them before."""
    monkeypatch.chdir(place)
    matplotlib.use("Agg")
    plt.close("all")  # of the notebook before
    cells = json.loads((EXAMPLES / name).read_text(encoding="utf-8"))["cells"]
    text = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    for cut in cuts:
        assert any(cut in cell for cell in text), f"{cut} stands in no cell any more"
    seen: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(text):
        for long, short in cuts.items():
            cell = cell.replace(long, short)
        exec(compile(cell, f"{name}, code cell {number}", "exec"), seen)
        if "openant" in seen:
            seen["openant"] = openant
    return seen


def test_the_notebook_finds_the_delay_that_its_servo_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pytestconfig: pytest.Config
) -> None:
    if not pytestconfig.getoption("--long"):
        pytest.skip("half a minute: make docs-check, and a row of make ecosystem")
    seen = play("diagnose.ipynb", tmp_path, {}, monkeypatch)
    # a delay of 30 ms it is; whether of commands or of measurements, one joint's positions hardly tell
    assert seen["found"]["verdict"] in ("action_delay", "ambiguous")
    assert seen["found"]["effects"][0]["effect"] == "action_delay"
    delay = next(iter(seen["found"]["effects"][0]["parameters"].values()))
    assert delay["value"] == pytest.approx(0.03, abs=0.005)
    assert (tmp_path / "servo" / "improved.xml").is_file()


def test_the_notebook_trains_and_ranks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    cuts = {'"--steps", 3000': '"--steps", 1250', '"--seconds", 10': '"--seconds", 2', '"--starts", 3': '"--starts", 1'}
    cuts |= {'"--seconds",\n    10': '"--seconds",\n    2', '"--starts",\n    3': '"--starts",\n    1'}
    seen = play("train_and_rank.ipynb", tmp_path, cuts, monkeypatch)
    real = json.loads((tmp_path / "walkers" / "real.json").read_text(encoding="utf-8"))
    assert set(real["policies"]) == {"sarsa-0", "sarsa-1", "sarsa-2"}
    assert len(seen["plt"].gca().lines) == 3
