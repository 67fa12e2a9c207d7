"""What lost the communication: tables written here by hand, one fault each, as other people's logs have them."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from openant_tools.blind.soak_tables import soak_table
from openant_tools.blind.soaks import SoakAnswer, SoakMix, draw_soaks
from openant_tools.cli.comms import comms
from openant_tools.comms.dropouts import diagnose, measures
from openant_tools.comms.dropouts.causes import CAUSES, separating_test
from openant_tools.comms.dropouts.diagnose import diagnose_dropouts, judge
from openant_tools.comms.dropouts.log import read_log
from openant_tools.comms.dropouts.measures import Measures, measure
from openant_tools.comms.dropouts.outcome import dropout_effects, dropouts_finding
from openant_tools.comms.dropouts.report import dropouts_report
from openant_tools.errors import BadInput
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run, write_table

LEGS = ("rr", "fr", "fl", "rl")
JOINTS = tuple(f"{kind}_{leg}" for leg in LEGS for kind in ("hip", "knee"))
RATE = 25.0


class Log:
    """A healthy walk of two minutes; tests spoil it."""

    def __init__(self, seconds: float = 120.0, seed: int = 0) -> None:
        self.chance = np.random.default_rng(seed)
        self.n = int(seconds * RATE)
        self.t = np.arange(self.n) / RATE
        n, j = self.n, len(JOINTS)
        hz = self.chance.uniform(0.3, 1.3, j)
        self.pos = 0.4 * np.sin(2 * np.pi * hz * self.t[:, None] + np.arange(j))
        self.load = 0.1 + 0.3 * np.abs(self.pos) + self.chance.normal(0, 0.01, (n, j))
        self.volt = np.round(12.0 - 0.1 * self.load.sum(axis=1, keepdims=True) + self.chance.normal(0, 0.03, (n, j)), 1)
        self.rtt = 0.6e-3 + 0.38e-3 * np.arange(j) + self.chance.normal(0, 2e-5, (n, j)) + 1e-4
        self.tick = np.floor((self.t[:, None] * 1e3 + np.linspace(100, 20_000, j)) % 32768)
        self.wake = self.chance.exponential(2e-4, n)
        self.cmd_t = self.t - 1e-3
        self.err = np.full((n, j), "", dtype=object)
        self.extra: dict[str, object] = {"baud": 1_000_000, "chain": [[f"hip_{leg}", f"knee_{leg}"] for leg in LEGS]}

    def lose(self, rows: np.ndarray, joints: list[int] | slice, word: str = "timeout") -> None:
        for k in range(len(JOINTS))[joints] if isinstance(joints, slice) else joints:
            self.err[rows, k] = word

    def run(self, without: tuple[str, ...] = (), joints: tuple[str, ...] = JOINTS) -> Run:
        columns: dict[str, np.ndarray] = {"wake": self.wake, "cmd_t": self.cmd_t}
        gone = self.err != ""
        for name in joints:
            k = JOINTS.index(name)
            for signal, values in (
                ("pos", self.pos), ("load", self.load), ("volt", self.volt), ("rtt", self.rtt), ("tick", self.tick),
            ):  # fmt: skip
                hidden = gone[:, k] & ~((signal == "rtt") & (self.err[:, k] == "late"))
                columns[f"{signal}.{name}"] = np.where(hidden, np.nan, values[:, k])
            columns[f"err.{name}"] = self.err[:, k]
            columns[f"ok.{name}"] = np.where(gone[:, k], 0.0, 1.0)
        kept = {name: values for name, values in columns.items() if name.partition(".")[0] not in without}
        # Rows that a late loop catches up with follow each other at once.
        t = self.t + self.wake + 1e-9 * np.arange(self.n)
        return Run("log", Facts(joints=joints, extra=dict(self.extra)), t, kept)


def verdict(run: Run) -> str:
    return diagnose_dropouts([run]).verdict


def loose_plug(log: Log) -> None:
    for at in (11.0, 38.0, 52.0, 90.0, 101.0):
        first, back = int(at * RATE), int((at + 0.42) * RATE)
        log.volt[first - 1] -= 1.8
        log.lose(np.arange(first, back), slice(None))
        log.tick[back:] = np.floor((log.t[back:, None] - at) * 1e3 % 32768)


def weak_supply(log: Log) -> None:
    total = log.load.sum(axis=1)
    log.volt = np.round(np.repeat((12.0 - 3.5 * (total - total.min()))[:, None], len(JOINTS), axis=1), 1)
    log.lose(np.flatnonzero(total > np.quantile(total, 0.97)), slice(None))


def broken_wire(log: Log) -> None:
    log.lose(np.flatnonzero(log.pos[:, 5] > 0.3), [5])


def bad_servo(log: Log) -> None:
    hit = log.chance.random(log.n) < 0.02
    log.lose(np.flatnonzero(hit), [2], "crc")
    log.lose(np.flatnonzero(log.chance.random(log.n) < 0.02), [2])


def bad_cable(log: Log) -> None:
    log.lose(np.flatnonzero(log.chance.random(log.n) < 0.03), [4, 5])


def noise(log: Log) -> None:
    for k in range(len(JOINTS)):
        log.lose(np.flatnonzero(log.chance.random(log.n) < 0.01), [k], "crc")


def slow_servos(log: Log) -> None:
    log.rtt += 0.5e-3 * np.arange(1, len(JOINTS) + 1)


def slow_adapter(log: Log) -> None:
    log.rtt = np.repeat(16e-3 + log.chance.normal(0, 1e-4, (log.n, 1)), len(JOINTS), axis=1)


def sleepy_host(log: Log) -> None:
    for at in np.arange(3, 118, 7.3):
        log.wake[int(at * RATE)] = 0.3
    log.wake = np.maximum(log.wake, np.r_[0, log.wake[:-1] - 1 / RATE])
    for _ in range(20):
        log.wake = np.maximum(log.wake, np.r_[0, log.wake[:-1] - 1 / RATE])


def unplugged(log: Log) -> None:
    log.lose(np.arange(2000, 2400), slice(None), "port")


def twins(log: Log) -> None:
    log.lose(np.arange(log.n), [6])
    log.lose(np.flatnonzero(log.chance.random(log.n) < 0.9), [1], "crc")


def hasty(log: Log) -> None:
    gap = log.chance.uniform(0.02e-3, 1e-3, log.n)
    log.cmd_t = log.t + log.wake - gap
    log.lose(np.flatnonzero(gap < 0.2e-3), slice(None))


FAULTS = {
    "power_connector": loose_plug, "supply_weak": weak_supply, "broken_wire": broken_wire, "bad_servo": bad_servo,
    "bad_cable": bad_cable, "line_noise": noise, "return_delay": slow_servos, "latency_timer": slow_adapter,
    "host_stall": sleepy_host, "usb_unplug": unplugged, "duplicate_id": twins, "write_read_gap": hasty,
}  # fmt: skip


def test_every_cause_of_the_formats_is_known() -> None:
    assert set(FAULTS) == set(CAUSES)


@pytest.mark.parametrize("cause", list(FAULTS))
def test_each_fault_gets_its_name(cause: str) -> None:
    log = Log()
    FAULTS[cause](log)
    found = diagnose_dropouts([log.run()])
    assert found.verdict == cause, found.as_json()["causes"][:3]
    best = found.suspects[0]
    assert best.evidence
    assert best.remedy
    assert found.next_test


@pytest.mark.parametrize(
    "cause", ["power_connector", "bad_servo", "bad_cable", "line_noise", "usb_unplug", "duplicate_id"]
)
def test_a_log_of_answers_and_words_alone_is_enough(cause: str) -> None:
    log = Log()
    FAULTS[cause](log)
    without = ("rtt", "load", "wake", "cmd_t") + (("volt", "tick") if cause != "power_connector" else ())
    assert verdict(log.run(without)) == cause


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_log_is_called_healthy(seed: int) -> None:
    log = Log(seed=seed)
    log.lose(np.array([500, 2500]), [seed])  # what any bus loses now and then
    log.wake[[700, 2100]] = 0.012
    found = diagnose_dropouts([log.run()])
    assert found.verdict == "none"
    assert found.next_test == ""
    assert found.suspects[0].probability < 0.5


def test_a_report_names_causes_in_words_and_counts_answers() -> None:
    log = Log()
    bad_cable(log)
    found = diagnose_dropouts([log.run()])
    page = html.unescape(dropouts_report(found).html()).replace("\u00a0", " ")
    assert all(cause.words in page for cause in CAUSES.values())
    assert not [name for name in CAUSES if re.search(rf">{name}<", page)]
    assert f"{int(found.measures.log.lost.sum())} of {int(found.measures.log.answers.sum())} answers" in page


def test_losses_are_seen_where_only_measurements_tell() -> None:
    log = Log()
    bad_cable(log)
    found = diagnose_dropouts([log.run(without=("ok", "err"))])
    assert found.verdict == "bad_cable"
    assert found.suspects[0].where == ("hip_fl",)


def test_some_of_the_joints_do() -> None:
    log = Log()
    bad_servo(log)
    found = diagnose_dropouts([log.run(joints=JOINTS[:4])])
    assert (found.verdict, found.suspects[0].where) == ("bad_servo", ("hip_fr",))


def test_places_are_named() -> None:
    for cause, where in (("broken_wire", ("knee_fl",)), ("bad_servo", ("hip_fr",)), ("bad_cable", ("hip_fl",)),
                         ("duplicate_id", ("knee_rr", "hip_rl"))):  # fmt: skip
        log = Log()
        FAULTS[cause](log)
        assert diagnose_dropouts([log.run()]).suspects[0].where == where


@pytest.mark.parametrize("cause", ["broken_wire", "bad_servo", "bad_cable", "duplicate_id", "return_delay"])
def test_whatever_is_to_be_done_at_a_servo_names_the_servo(cause: str) -> None:
    """By joint and id, in the remedy, its own test, and each test that tells it from another cause."""
    log = Log()
    log.extra["ids"] = {joint: 10 + k for k, joint in enumerate(JOINTS)}
    FAULTS[cause](log)
    found = diagnose_dropouts([log.run()])
    best = found.suspects[0]
    for joint in (joint for joint in best.where if joint in JOINTS):
        who = f"{joint} (id {log.extra['ids'][joint]})"  # type: ignore[index]
        assert who in best.remedy
        assert who in best.next_test
        assert who in dropouts_finding(found, []).next_action
    everything = [one for suspect in found.suspects for one in (suspect.remedy, suspect.next_test)]
    places = {suspect.cause: ", ".join(suspect.where) for suspect in found.suspects}
    everything += [separating_test(one, other, places) for one in CAUSES for other in CAUSES if one != other]
    assert not [words for words in everything if re.search(r"[{}]|\b(this|these) (servo|joint)|servo concerned", words)]


def test_what_cannot_be_told_apart_is_said_with_the_test_that_would() -> None:
    log = Log()
    log.extra["chain"] = [list(JOINTS)]
    log.lose(np.flatnonzero(log.chance.random(log.n) < 0.02), [7])
    found = diagnose_dropouts([log.run(without=("volt", "tick", "rtt"))])
    first_two = {one.cause for one in found.suspects[:2]}
    assert first_two == {"bad_servo", "bad_cable"}


def test_silence_behind_a_silent_servo_is_not_its_fault() -> None:
    """In a sync read everyone waits for the one before: behind a bad servo all are silent."""
    log = Log()
    hit = np.flatnonzero(log.chance.random(log.n) < 0.03)
    log.lose(hit[::2], [2, 3, 4, 5, 6, 7])
    log.lose(hit[1::2], [2], "crc")
    found = diagnose_dropouts([log.run()])
    assert (found.verdict, found.suspects[0].where) == ("bad_servo", ("hip_fr",))


def test_noise_grows_with_the_baud_rate() -> None:
    runs = []
    for baud, share in ((1_000_000, 0.02), (500_000, 0.002)):
        log = Log(seed=baud)
        log.extra["baud"] = baud
        for k in range(len(JOINTS)):
            log.lose(np.flatnonzero(log.chance.random(log.n) < share), [k], "crc")
        runs.append(replace(log.run(), name=str(baud)))
    found = diagnose_dropouts(runs)
    assert found.verdict == "line_noise"
    assert any("baud" in why.words for why in found.suspects[0].evidence)


def test_a_log_that_tells_nothing_of_the_bus_is_refused() -> None:
    run = Run("a", Facts(joints=("knee",)), np.arange(10) * 0.1, {"cmd.knee": np.zeros(10)})
    with pytest.raises(BadInput, match=r"nothing here tells of the bus → needed is one of ok\.J"):
        read_log([run])


def test_odd_facts_do_no_harm() -> None:
    log = Log(seconds=20)
    log.extra = {"baud": "fast", "chain": list(JOINTS), "latency_timer_ms": True, "return_delay_s": None}
    assert verdict(log.run()) == "none"
    one_row = log.run().between(0.0, 0.01)
    assert verdict(one_row) == "none"


def test_the_command_prints_writes_and_says_by_its_exit_code(tmp_path: Path) -> None:
    log = Log()
    loose_plug(log)
    write_table(log.run(), tmp_path / "log.csv")
    done = CliRunner().invoke(
        comms,
        ["diagnose", str(tmp_path / "log.csv"), "--json", str(tmp_path / "out.json"), "--effects",
         str(tmp_path / "bus.effects.toml"), "--report", str(tmp_path / "report")],
    )  # fmt: skip
    assert done.exit_code == 1, done.output
    assert "screw the supply's wires" in done.output
    said = json.loads((tmp_path / "out.json").read_text())
    assert said["verdict"] == "power_connector"
    assert {"cause", "where", "probability", "evidence", "next_test"} <= set(said["causes"][0])
    assert len(said["causes"]) == len(CAUSES)
    assert "command_dropout" in (tmp_path / "bus.effects.toml").read_text()
    assert (tmp_path / "report" / "report.html").exists()
    healthy = Log()
    write_table(healthy.run(), tmp_path / "healthy.csv")
    assert CliRunner().invoke(comms, ["diagnose", str(tmp_path / "healthy.csv")]).exit_code == 0


def test_the_finding_carries_numbers_and_the_gap_its_effect() -> None:
    log = Log()
    bad_cable(log)
    found = diagnose_dropouts([log.run()])
    finding = dropouts_finding(found, ["recordings/soak.mcap"])
    assert not finding.ok
    assert "replace the cable" in finding.next_action
    share = next(one for one in finding.evidence if one.name == "share lost")
    assert share.low is not None
    assert share.value is not None
    assert share.high is not None
    assert share.low < share.value < share.high
    [effect] = dropout_effects(found)
    assert effect["joints"] == ["hip_fl", "knee_fl"]
    assert effect["parameters"]["fraction"] == pytest.approx(0.015, rel=0.3)
    slow = Log()
    slow_servos(slow)
    assert dropout_effects(diagnose_dropouts([slow.run()])) == []


def test_answers_of_a_set_come_back_as_they_were_drawn() -> None:
    drawn = draw_soaks(30, 5, SoakMix())
    assert [SoakAnswer.of(json.loads(json.dumps(one.as_table()))) for one in drawn] == drawn
    assert sum(one.cause == "none" for one in drawn) == 10


def test_a_blind_set_is_made_judged_and_scored(tmp_path: Path) -> None:
    runner, folder, key = CliRunner(), str(tmp_path / "set"), str(tmp_path / "key")
    make = ["blind", "make", "--out", folder, "--soaks", "4", "--seed", "3", "--virtual", "0", "--key-file", key]
    done = runner.invoke(comms, make)
    assert done.exit_code == 0, done.output
    assert "cause" not in (tmp_path / "set" / "answers.sealed.toml").read_text()
    facts = [read_run(path, need=()).facts for path in sorted((tmp_path / "set").glob("*.parquet"))]
    assert all("cause" not in one.extra and one.notes is None for one in facts)
    unjudged = runner.invoke(comms, ["blind", "score", folder, "--key-file", key])
    assert isinstance(unjudged.exception, BadInput)
    assert "blind run SET" in str(unjudged.exception)
    assert runner.invoke(comms, ["blind", "run", folder]).exit_code == 0
    locked = runner.invoke(comms, ["blind", "score", folder])
    assert "the answers are sealed" in str(locked.exception)
    scored = runner.invoke(comms, ["blind", "score", folder, "--key-file", key, "--docs", str(tmp_path / "page.md")])
    assert scored.exit_code in (0, 1), scored.output
    assert "right cause first" in scored.output
    assert "## Every failure" in (tmp_path / "page.md").read_text()


def test_no_verdict_hangs_on_a_number_that_was_set_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth less or a quarter more of it, and at most one of 24 soaks that tables draw is judged otherwise."""
    mix = SoakMix(healthy=0.25, virtual=0.0, healthy_s=(60.0, 90.0), faulty_s=(60.0, 90.0))
    drawn = [one for one in draw_soaks(60, 7, mix) if one.rate_hz < 60.0][:24]
    logs = [read_log([soak_table(one, "soak")]) for one in drawn]

    def measured() -> list[Measures]:
        return [measure(log) for log in logs]

    as_it_is = measured()
    first = [judge(one).verdict for one in as_it_is]
    assert sum(said == one.cause for said, one in zip(first, drawn, strict=True)) >= 22
    by_hand = [(diagnose, name) for name in ("FLOOR", "TEMPER", "NAMED", "ENOUGH")]
    by_hand += [(measures, name) for name in ("DIP_V", "SAG_V", "STALL_S", "RESET_MS")]
    for module, name in by_hand:
        for times in (0.8, 1.25):
            with monkeypatch.context() as patch:
                patch.setattr(module, name, times * getattr(module, name))
                # Numbers of the judgement are none of what is measured.
                found = [judge(one).verdict for one in (as_it_is if module is diagnose else measured())]
                assert sum(said != was for said, was in zip(found, first, strict=True)) <= 1, (name, times)
