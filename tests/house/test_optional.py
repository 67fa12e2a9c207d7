"""The base installation: what works without OpenCV and pyarrow, and what is said where one of them is needed."""

from __future__ import annotations

import importlib.metadata
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from openant_tools.optional import opencv
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_table, write_table

WITHOUT = "import sys; sys.modules.update(cv2=None, pyarrow=None); from openant_tools.cli import main; main()"


def bare(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """A command in a Python that has neither."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, *map(str, words)], capture_output=True, text=True, timeout=120
    )


def table(path: Path) -> Run:
    t = np.arange(50) * 0.01
    columns = {"cmd.j": np.sin(t), "pos.j": np.where(np.arange(50) % 7, np.sin(t - 0.02), np.nan)}
    run = Run("sway", Facts(joints=("j",)), t, columns)
    write_table(run, path)
    return run


def test_recordings_and_csv_need_no_pyarrow_and_parquet_says_what_it_needs(tmp_path: Path) -> None:
    run = table(tmp_path / "sway.csv")
    table(tmp_path / "whole.parquet")
    assert bare("rec", "import", tmp_path / "sway.csv", "--out", tmp_path / "sway.mcap").returncode == 0
    assert bare("rec", "export", tmp_path / "sway.mcap", "--to", "csv", "--out", tmp_path / "out").returncode == 0
    back = read_table(tmp_path / "out" / "sway.csv")
    assert np.allclose(back.columns["pos.j"], run.columns["pos.j"], atol=1e-3, equal_nan=True)
    for words in (("export", tmp_path / "sway.mcap", "--out", tmp_path / "out"), ("info", tmp_path / "whole.parquet")):
        refused = bare("rec", *words)
        assert refused.returncode == 2
        assert refused.stderr == (
            "openant: this needs pyarrow, which is not installed → pip install 'openant-tools[parquet]'\n"
        )
    assert not (tmp_path / "out" / "sway.parquet").exists()


def test_without_opencv_the_virtual_robot_has_no_camera_and_what_needs_one_says_so(tmp_path: Path) -> None:
    ready = tmp_path / "robot.json"
    robot = subprocess.Popen(
        [sys.executable, "-c", WITHOUT, "virtual", "start", "--ready-file", str(ready)],
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60.0
        while not ready.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert json.loads(ready.read_text())["camera"] is None
        assert bare("config", "new", "--robot", tmp_path / "ant").returncode == 0
        arena = bare("calib", "arena", "--robot", tmp_path / "ant", "--virtual", ready, "--yes")
    finally:
        os.kill(robot.pid, signal.SIGTERM)
        said = robot.communicate(timeout=30)[1]
    assert "no camera: OpenCV is not installed → pip install 'openant-tools[camera]'" in said
    assert arena.returncode == 2
    assert "this needs OpenCV, which is not installed → pip install 'openant-tools[camera]'" in arena.stderr
    assert "this needs OpenCV" in bare("config", "check", "--robot", tmp_path / "ant").stderr


def test_two_opencv_in_one_environment_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    one = opencv()
    assert one.version is not None
    assert f"OpenCV {one.version}" in one.words
    both = [
        SimpleNamespace(metadata={"Name": name}, version="4.11.0.86")
        for name in ("opencv-python", "opencv-contrib-python-headless", "numpy")
    ]
    monkeypatch.setattr(importlib.metadata, "distributions", lambda: both)
    assert opencv().words.endswith(
        "opencv-contrib-python-headless 4.11.0.86 and opencv-python 4.11.0.86 lie over each other → "
        "pip uninstall opencv-contrib-python-headless opencv-python, then install the one that you want"
    )
