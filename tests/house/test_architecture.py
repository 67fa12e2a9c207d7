"""What docs/architecture.md draws of the packages is what they import."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib

from places import ROOT


def test_the_picture_of_the_rooms_is_up_to_date() -> None:
    asked = subprocess.run(
        [sys.executable, "benchmarks/rooms.py", "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert asked.returncode == 0, asked.stderr


def test_every_import_contract_has_its_reason_beside_it() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    contracts = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    reasons = re.findall(r"^# (.+)\n\[\[tool\.importlinter\.contracts\]\]", text, re.MULTILINE)
    assert len(reasons) == len(contracts)


def test_every_module_says_what_it_is_in_its_first_line() -> None:
    modules = [
        path for room in ("openant_tools", "openant_env", "openant_agents") for path in (ROOT / room).rglob("*.py")
    ]
    silent = [path for path in modules if not re.match(r'r?"""\S', path.read_text(encoding="utf-8"))]
    assert silent == []
