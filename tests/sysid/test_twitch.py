"""Contacts that let a robot travel by twitching are found out."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from openant_tools.cli.sysid_twitch import twitch
from openant_tools.robot.mjcf import nominal_model_path


@pytest.mark.parametrize("kit", ["standard", "lite"])
def test_the_nominal_robots_stay(kit: str) -> None:
    ran = CliRunner().invoke(twitch, ["--model", str(nominal_model_path(kit)), "--seconds", "3"], standalone_mode=False)
    assert ran.return_value == 0, ran.output
    assert "below 5 mm/s it stays" in ran.output


def test_hard_contacts_let_it_travel_and_softer_ones_are_named(tmp_path: Path) -> None:
    text = nominal_model_path("standard").read_text()
    hard = text.replace('solref="0.02 1.5" solimp="0.7 0.9 0.02"', 'solref="0.005 0.3" solimp="0.95 0.99 0.001"')
    assert hard != text
    model = tmp_path / "hard.xml"
    model.write_text(hard)
    ran = CliRunner().invoke(twitch, ["--model", str(model), "--seconds", "4"], standalone_mode=False)
    assert ran.return_value == 1, ran.output
    assert 'with solref="0.02 1.5" solimp="0.7 0.9 0.02" on floor and feet it moves' in ran.output
    assert "so set these" in ran.output
