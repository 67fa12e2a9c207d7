"""`make api` makes a page a module from docstrings, and stops at what cannot be resolved; here of a few, there of all."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT


def test_pages_of_the_api_are_made_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("pdoc")
    modules = ("openant_tools.sysid", "openant_tools.recording.pictures", "openant_env.ant")
    command = [sys.executable, "benchmarks/api_pages.py", str(tmp_path), *modules]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    page = (tmp_path / "openant_tools" / "sysid.html").read_text(encoding="utf-8")
    for name in ("fit", "judge", "Identification"):
        assert f'id="{name}"' in page
