"""What tests of the diagnosis share."""

from __future__ import annotations

from pathlib import Path

import pytest

from openant_tools.gap import assess, ensemble
from openant_tools.gap.cache import CACHE_VARIABLE
from openant_tools.gap.population import applicable

#: what is wrong with a robot that is late, and something else
FEW = ("action_delay", "stiffness_error")


@pytest.fixture
def few_causes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two causes to choose from, and few healthy robots: for what does not depend on how many there are."""
    # What is kept of a recording is kept under its name, whatever it was compared with.
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "few"))
    monkeypatch.setattr(assess, "MEASURE", 24)
    monkeypatch.setattr(assess, "OTHERS", 8)
    monkeypatch.setattr(ensemble, "applicable", lambda given: [one for one in applicable(given) if one.name in FEW])
