"""Soaks of the virtual robot's bus, by bytes through the engine and by transactions: the log, its resumption, its cause."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builder import COARSE, finished
from click.testing import CliRunner

from openant_tools.blind.soak_virtual import swinging_soak
from openant_tools.cli.comms import comms
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.dropouts.diagnose import diagnose_dropouts
from openant_tools.comms.dropouts.log import read_log
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.comms.soak import soak as soak_bus
from openant_tools.comms.step_timing import step_timing
from openant_tools.comms.thinning import Thinning
from openant_tools.errors import BadInput
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run, write_table
from openant_tools.recording.telemetry import Cycle, RecordedAnswer
from openant_tools.virtual.process import virtual_robot
from openant_tools.virtual.scenario import parse_scenario

#: cause → settings of the virtual robot's fault; each shows within seconds
SHORT: dict[str, dict[str, Any]] = {
    "bad_servo": {"where": ["hip_fr"], "fraction": 0.15},
    "bad_cable": {"where": ["hip_fl"], "fraction": 0.15},
    "line_noise": {"byte_error": 0.001},
    "return_delay": {"delay_s": 0.0005},
    "latency_timer": {"timer_s": 0.016},
}


def scenario_text(cause: str, **settings: Any) -> str:
    lines = [f"{name} = {value!r}" for name, value in settings.items()]
    return "\n".join(
        ["[clock]", 'mode = "stepped"', "[camera]", "present = false", "[[fault]]", f'cause = "{cause}"', *lines]
    )


@pytest.mark.parametrize("cause", list(SHORT))
def test_transactions_show_the_fault(cause: str) -> None:
    scenario = parse_scenario({"camera": {"present": False}, "fault": [{"cause": cause, **SHORT[cause]}]})
    run = swinging_soak(scenario, 24.0, 20.0, "soak")
    assert len(run.t) == 480
    found = diagnose_dropouts([run])
    assert found.verdict == cause, found.as_json()["causes"][:2]


def test_a_healthy_robot_shows_none() -> None:
    found = diagnose_dropouts([swinging_soak(parse_scenario({"camera": {"present": False}}), 24.0, 20.0, "soak")])
    assert found.verdict == "none"


def test_bytes_show_the_fault_and_are_kept_around_each_loss(tmp_path: Path) -> None:
    """The same through the engine, a pseudo-terminal and every packet."""
    (tmp_path / "cable.toml").write_text(scenario_text("bad_cable", **SHORT["bad_cable"]))
    out = tmp_path / "soak.mcap"
    ask = ["soak", "--virtual", str(tmp_path / "cable.toml"), "--out", str(out), "--minutes", "0.15", "--yes"]
    done = CliRunner().invoke(comms, ask)
    assert done.exit_code == 0, done.output
    recording = read_recording(out)
    raw = [event for event in recording.events if event["kind"] == "bytes"]
    assert any(event["asked"].startswith("fffffd00fe") for event in raw)
    counts = [event for event in recording.events if event["kind"] == "counts"]
    assert sum(event["cycles"] for event in counts) > 800
    found = diagnose_dropouts([recording.run])
    assert found.verdict == "bad_cable", found.as_json()["causes"][:2]
    # There already: not overwritten, but gone on with.
    again = CliRunner().invoke(comms, ask)
    assert isinstance(again.exception, BadInput)
    assert "--resume" in str(again.exception)
    longer = CliRunner().invoke(comms, [*ask[:-3], "--minutes", "0.2", "--yes", "--resume"])
    assert longer.exit_code == 0, longer.output
    assert read_recording(out).run.duration_s > recording.run.duration_s + 1.0


#: cause → settings of the fault, when it begins and ends (s after the soak does): seen through every packet, its CRC, the
#: driver's deadlines, and the guards that stop the motion and let it go on. A wire that breaks at an angle takes longer than
#: seconds to be told from a bad servo.
BYTES: dict[str, tuple[dict[str, Any], float, float]] = {
    "power_connector": ({"openings_per_rad": 0.3, "open_s": 0.1}, 0.0, 99.0),
    "bad_servo": ({"where": ["hip_fr"], "fraction": 0.15}, 0.0, 99.0),
    "line_noise": ({"byte_error": 0.001}, 0.0, 99.0),
    "return_delay": ({"delay_s": 0.0005}, 0.0, 99.0),
    "latency_timer": ({"timer_s": 0.016}, 0.0, 99.0),
    "host_stall": ({"every_s": 1.3, "for_s": 0.15}, 0.0, 99.0),
    "usb_unplug": ({}, 3.0, 5.0),
    "duplicate_id": ({"where": ["knee_rr"], "of": "hip_fl"}, 3.0, 99.0),
    "write_read_gap": ({"gap_s": 0.001}, 0.0, 99.0),
}


@pytest.fixture(scope="module")
def stepped_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mapping[str, str | None]]:
    """A healthy robot, whose mechanics take longer steps than by themselves: it is the bus that is looked at."""
    scenario = tmp_path_factory.mktemp("healthy") / "healthy.toml"
    scenario.write_text(COARSE)
    with virtual_robot(str(scenario), clock="stepped", camera=False) as found:
        yield found


@pytest.mark.parametrize("cause", list(BYTES))
def test_bytes_show_each_fault(cause: str, stepped_robot: Mapping[str, str | None], tmp_path: Path) -> None:
    bus, control_path = stepped_robot["bus"], stepped_robot["control"]
    assert bus is not None
    assert control_path is not None
    control = VirtualControl(control_path)
    settings, begins, ends = BYTES[cause]
    now = float(control.ask("now")["t"])
    control.ask("fault", cause=cause, on=True, **settings, from_s=now + begins, to_s=now + ends)
    try:
        config = config_of_unknown_robot(bus, control_path, rate_hz=30.0)
        soaked = finished(soak_bus(config, tmp_path / "soak.mcap", 7.0, thin_s=None))
    finally:
        control.ask("fault", cause=cause, on=False, **{key: settings[key] for key in ("where",) if key in settings})
        control.close()
    assert soaked.seconds >= 7.0
    run = read_recording(soaked.path).run
    found = diagnose_dropouts([run])
    assert found.verdict == cause, found.as_json()["causes"][:2]
    if cause == "usb_unplug":
        assert (run.column("ok.hip_rr") == 0).sum() > 40, "that the port is gone stands in the recording, row by row"
        assert set(run.columns["err.hip_rr"].tolist()) == {"", "port"}
    if cause == "host_stall":
        assert found.measures.losses == "no", "a host that wakes late finds what came meanwhile"
        assert run.column("wake").max() > 0.1


def _cycle(t: float, err: str = "", wake: float = 0.0, volt: int = 120) -> Cycle:
    return Cycle(t, [None], None, wake, [RecordedAnswer(None if err else {"volt": volt}, not err, err)], [False])


def test_thinning_keeps_what_is_strange_with_what_was_around_it() -> None:
    thinning, kept = Thinning(1.0, ("knee",)), list[float]()
    for k in range(1000):
        t = k * 0.01
        err = "crc" if k == 450 else ""
        kept += [one.t for one in thinning.take(_cycle(t, err, 0.05 if k == 700 else 0.0, 100 if k == 850 else 120))]
    assert kept == sorted(kept)
    for strange in (4.5, 7.0, 8.5):
        around = [t for t in kept if abs(t - strange) <= 0.29]
        assert len(around) >= 55
    assert len([t for t in kept if t < 4.0]) == 4
    assert thinning.rest(10.0)["lost"] == {"knee crc": 1}


def test_a_thinned_log_counts_what_was_left_out() -> None:
    t = np.arange(0, 60, 0.1)
    ok = np.ones(len(t))
    ok[300] = 0
    run = Run(
        "thin", Facts(("knee",), extra={"rate_hz": 100.0, "thinned_s": 0.1}), t, {"ok.knee": ok, "rtt.knee": t * 0}
    )
    log = read_log([run])
    assert log.answers[0] == pytest.approx(5991, abs=2)
    assert log.period_s == 0.01


def test_no_table_is_overwritten_and_no_port_is_asked_without_bytes(tmp_path: Path) -> None:
    def refused(*options: str) -> str:
        return str(CliRunner().invoke(comms, ["soak", "--transactions", *options]).exception)

    assert "name it soak.parquet" in refused("--virtual", "default", "--out", str(tmp_path / "soak.mcap"))
    assert "only a virtual robot" in refused("--out", str(tmp_path / "soak.parquet"))
    (tmp_path / "there.parquet").write_text("")
    assert "name another file" in refused("--virtual", "default", "--out", str(tmp_path / "there.parquet"))


# ---- step timing ----


def steps(*, apart: bool) -> Run:
    """Forty steps of 120 ms: command, 100 ms of waiting, 3 ms of reading, 2 of observing, the rest deciding."""
    begin = 1.0 + 0.12 * np.arange(41)
    t = begin - 0.02
    columns = {
        "cmd.knee": np.sin(np.arange(41.0)), "pos.knee": np.zeros(41), "rtt.knee": np.full(41, 3e-3), "cmd_t": begin,
    }  # fmt: skip
    if apart:
        columns |= {"obs_t": t + 5e-3, "act_t": begin - 1e-3}
    return Run("steps", Facts(("knee",), extra={"baud": 1_000_000}), t, columns)


def test_a_step_is_taken_apart() -> None:
    found = step_timing(steps(apart=True))
    mean = {part.name: part.mean for part in found.parts}
    assert found.steps == 40
    assert mean["wait"] == pytest.approx(0.1)
    assert mean["read"] == pytest.approx(3e-3)
    assert mean["observe"] == pytest.approx(2e-3)
    assert mean["decide"] == pytest.approx(14e-3)
    assert sum(mean.values()) == pytest.approx(found.step.mean) == pytest.approx(0.12)
    assert found.action_to_observation.mean == pytest.approx(0.103)
    assert found.computing_share == pytest.approx(16 / 120)


def test_without_the_agents_times_observing_and_deciding_are_one() -> None:
    found = step_timing(steps(apart=False))
    assert [part.name for part in found.parts] == ["command", "wait", "read", "observe and decide"]
    assert not found.told_apart


def test_a_loop_faster_than_the_agent_repeats_its_command() -> None:
    """Twelve cycles of the engine to a step: the read that counts is the last one before the next command."""
    n = 12 * 20
    t = 0.01 * np.arange(n) + 0.8e-3
    cmd = np.repeat(np.arange(20.0), 12) / 20
    run = Run("loop", Facts(("knee",)), t, {"cmd.knee": cmd, "rtt.knee": np.full(n, 3e-3), "cmd_t": t - 0.2e-3})
    found = step_timing(run)
    assert found.step.mean == pytest.approx(0.12)
    assert found.action_to_observation.mean == pytest.approx(0.1132, abs=1e-4)


def test_what_a_loop_reads_while_the_agent_thinks_is_not_what_it_saw() -> None:
    """As recordings of the environment have it: a row each 10 ms, the agent's times in the rows of its commands."""
    n = 12 * 20
    t = 0.01 * np.arange(n)
    cmd_t = np.repeat(t[::12], 12) + 1e-3
    obs_t, act_t = np.full(n, np.nan), np.full(n, np.nan)
    # The read two cycles before the command is observed after 4 ms, and thought about for 12.
    obs_t[12::12], act_t[12::12] = t[10:-12:12] + 4e-3, t[10:-12:12] + 16e-3
    cmd = np.repeat(np.arange(20.0), 12) / 20
    columns = {"cmd.knee": cmd, "rtt.knee": np.full(n, 3e-3), "cmd_t": cmd_t, "obs_t": obs_t, "act_t": act_t}
    found = step_timing(Run("env", Facts(("knee",)), t, columns))
    mean = {part.name: part.mean for part in found.parts}
    assert found.told_apart
    assert mean == pytest.approx({"command": 5e-3, "wait": 99e-3, "read": 3e-3, "observe": 1e-3, "decide": 12e-3})


def test_timing_says_what_it_cannot_use(tmp_path: Path) -> None:
    still = steps(apart=False)
    still.columns["cmd.knee"][:] = 0.0  # type: ignore[index]
    with pytest.raises(BadInput, match="only 1 different commands"):
        step_timing(still)
    write_table(steps(apart=True), tmp_path / "walk.parquet")
    picture = tmp_path / "timing.png"
    done = CliRunner().invoke(
        comms, ["timing", str(tmp_path / "walk.parquet"), "--json", str(tmp_path / "t.json"), "--picture", str(picture)]
    )
    assert done.exit_code == 0, done.output
    assert "13.3 % of the step" in done.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert read_run(tmp_path / "walk.parquet").name == "walk"
