"""Where things lie beside the tests."""

from __future__ import annotations

from pathlib import Path

__all__ = ["DATA", "ROOT", "SHARED", "TESTS"]

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
DATA = TESTS / "data"
#: facts and recordings of other people; tests that read it skip where it is absent
SHARED = ROOT.parent / "shared"
