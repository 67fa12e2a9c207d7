"""A sealed scenario: a riddle that only the virtual robot reads, and that nobody changes unnoticed."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.cli.virtual import virtual
from openant_tools.comms.clock import VirtualControl
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.virtual.process import virtual_robot
from openant_tools.virtual.scenario import load_scenario
from openant_tools.virtual.seal import KEY_VARIABLE, commitment_of, open_sealed, read_key

PLAIN = """
# the knee is the one
seed = 7
[robot]
kit = "lite"
setup = "stand"
[clock]
mode = "stepped"
[camera]
present = false
[[effect]]
effect = "weak_joint"
joints = ["knee_fl"]
parameters = { scale = 0.5 }
[[fault]]
cause = "bad_servo"
where = "hip_rr"
fraction = 0.2
"""


@pytest.fixture
def sealed(tmp_path: Path) -> tuple[Path, Path]:
    """A sealed scenario and its key, made by the command."""
    plain, key, out = tmp_path / "plain.toml", tmp_path / "key", tmp_path / "sealed.toml"
    plain.write_text(PLAIN)
    done = CliRunner().invoke(virtual, ["seal", str(plain), "--key-file", str(key), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert tomllib.loads(out.read_text())["sealed"]["commitment"] in done.output
    return out, key


def test_the_file_tells_nothing_but_kit_setup_and_clock(sealed: tuple[Path, Path]) -> None:
    text = sealed[0].read_text()
    table = tomllib.loads(text)
    assert {key: value for key, value in table.items() if key != "sealed"} == {
        "robot": {"kit": "lite", "setup": "stand"},
        "clock": {"mode": "stepped"},
    }
    assert not any(word in text for word in ("knee", "weak", "bad_servo", "seed"))
    assert sealed[1].stat().st_mode & 0o077 == 0


def test_the_key_opens_it_by_option_and_by_environment(
    sealed: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, key = sealed
    for scenario in (load_scenario(out, key), (monkeypatch.setenv(KEY_VARIABLE, str(key)), load_scenario(out))[1]):
        assert scenario.sealed
        assert [fault.cause for fault in scenario.faults] == ["bad_servo"]
        strength = {servo.joint: servo.motor.strength for servo in scenario.world.servos if servo.motor}
        assert strength["knee_fl"] == 0.5
        assert strength["knee_fr"] == 1.0


def test_the_commitment_proves_the_plain_text_and_no_one_can_guess_it(sealed: tuple[Path, Path]) -> None:
    table = tomllib.loads(sealed[0].read_text())
    assert open_sealed(table, read_key(sealed[1]), "x") == PLAIN
    assert commitment_of(b"", PLAIN) != table["sealed"]["commitment"]


def test_without_its_key_it_stays_shut(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    out, key = sealed
    with pytest.raises(BadInput, match=f"is sealed → name its key by --key-file or {KEY_VARIABLE}"):
        load_scenario(out)
    other = tmp_path / "other"
    other.write_bytes(bytes(44))
    with pytest.raises(BadInput, match="this is no key of a sealed scenario"):
        load_scenario(out, other)
    with pytest.raises(BadInput, match="No such file"):
        load_scenario(out, tmp_path / "none")
    plain, second = tmp_path / "plain.toml", tmp_path / "second.toml"
    CliRunner().invoke(virtual, ["seal", str(plain), "--key-file", str(tmp_path / "new"), "--out", str(second)])
    with pytest.raises(BadInput, match="the seal does not open: another key, or the file was changed"):
        load_scenario(second, key)


@given(st.integers(min_value=0), st.integers(1, 255))
@settings(max_examples=50)
def test_no_changed_byte_goes_unnoticed(at: int, change: int) -> None:
    from openant_tools.virtual import seal as seals

    folder = Path(os.environ.get("TMPDIR", "/tmp"))
    path, key = folder / f"openant-seal-{os.getpid()}.toml", bytes(range(32))
    seals.seal(PLAIN, key, path)
    data = bytearray(path.read_bytes())
    path.unlink()
    begin = data.index(b"\n") + 1  # the comment says what it likes
    data[begin + at % (len(data) - begin)] ^= change
    try:
        table = tomllib.loads(data.decode())
        assert open_sealed(table, key, "x") == PLAIN
        assert {k: v for k, v in table.items() if k != "sealed"} == {
            "robot": {"kit": "lite", "setup": "stand"}, "clock": {"mode": "stepped"},
        }  # fmt: skip
    except (BadInput, ValueError, KeyError):
        pass


def test_a_bad_scenario_is_not_sealed_and_makes_no_key(tmp_path: Path) -> None:
    plain, key = tmp_path / "plain.toml", tmp_path / "key"
    plain.write_text(PLAIN.replace("weak_joint", "weak_jiont"))
    done = CliRunner().invoke(virtual, ["seal", str(plain), "--key-file", str(key), "--out", str(tmp_path / "out")])
    assert isinstance(done.exception, BadInput)
    assert "did you mean 'weak_joint'" in str(done.exception)
    assert not key.exists()
    assert not (tmp_path / "out").exists()


def test_a_sealed_robot_runs_and_keeps_its_truth(sealed: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    out, key = sealed
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    with virtual_robot(str(out)) as robot:
        control = VirtualControl(str(robot["control"]))
        assert control.ask("now")["stepped"]
        with pytest.raises(HardwareFault, match="sealed: it keeps its truth to itself"):
            control.ask("state")
        control.close()
        json.dumps(dict(robot))
