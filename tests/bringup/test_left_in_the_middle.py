"""Steps that record: left in the middle, they go on with what is missing, and nobody is asked again what was answered."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builder import Builder, Robot, coarsen, robot

from openant_tools.bringup.comms_step import comms_step
from openant_tools.bringup.identification import identification
from openant_tools.bringup.passport import write_passport
from openant_tools.bringup.walk import WALK, do, standing
from openant_tools.cli.face import CommandFace
from openant_tools.comms.soak import soaked_seconds
from openant_tools.errors import HardwareFault
from openant_tools.procedure import by_time
from openant_tools.procedure.finding import Finding, keep
from openant_tools.procedure.step import Answer, Ask, Bench, Declined, Event, Intent, Live, Procedure, Progress, Step
from openant_tools.procedure.unfinished import Unfinished, unfinished
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.recording.telemetry import Cycle, RecordedAnswer, ServoChannel
from openant_tools.recording.writer import RecordingWriter
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import NOMINAL_MODEL, create_robot
from openant_tools.sysid.bench.steps import floor_friction
from openant_tools.thermal.step import thermal_soak

pytestmark = pytest.mark.usefixtures("quarter_rate")

#: steps that read or compute only: done again they ask nothing that was answered, and take a minute
AT_ONCE = ("connect", "estop", "inventory", "gap", "passport")


def left(
    there: Robot, step: Callable[[Bench], Procedure], name: str, leave: Callable[[Event], bool], **answers: float
) -> Unfinished:
    """Leave a step once an event is so; how far it is then."""

    def before(event: Event) -> None:
        if leave(event):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        there.do(step(there.bench), there.builder(before=before, answers=answers))
    assert not any(there.torque())
    note = unfinished(there.folder, name, virtual=True)
    assert note is not None
    return note


def asked(builder: Builder) -> list[str]:
    return [event.question for event in builder.events if isinstance(event, Ask)]


@pytest.mark.parametrize(
    "step", [step for step in WALK.values() if step.name not in AT_ONCE], ids=lambda step: step.name
)
def test_every_step_with_parts_notes_them(step: Step) -> None:
    """What notes them is seen in each room's own tests; here that no step was forgotten."""
    module = Path(__file__).parents[2] / (step.procedure.partition(":")[0].replace(".", "/") + ".py")
    assert f'Parts(bench, "{step.name}"' in module.read_text()


def test_a_watch_over_the_bus_goes_on_with_its_next_minute(
    tmp_path: Path, brisk: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In minutes of 20 s."""
    monkeypatch.setattr(by_time, "PART_S", 20)
    with robot(tmp_path / "ant") as there:
        note = left(
            there, comms_step, "comms", lambda event: isinstance(event, Progress) and (event.share or 0) > 0.68 and "lost" in event.words,
            **{"how long": 0.5},
        )  # fmt: skip
        assert (note.words, note.next) == ("1 of 2", "minute 2")
        (soak,) = there.folder.recordings.iterdir()
        before = soaked_seconds(soak)
        finding, builder = there.do(comms_step(there.bench))
    assert finding.ok, finding
    assert not asked(builder)
    assert "swing all legs gently on the stand until it was 0.5 min in all" in builder.said
    assert 18 < before < 25
    assert list(there.folder.recordings.iterdir()) == [soak]
    assert soaked_seconds(soak) == pytest.approx(30, abs=1)
    assert unfinished(there.folder, "comms", virtual=True) is None


class Refusing(Builder):
    """Says No to whatever would move."""

    def answer(self, event: Event) -> Answer:
        return False if isinstance(event, Intent) else super().answer(event)


@pytest.mark.parametrize("step", [thermal_soak, comms_step])
def test_a_finished_soak_stays_whatever_becomes_of_the_next(
    step: Callable[[Bench], Procedure], tmp_path: Path, brisk: None
) -> None:
    """A No, a port that is not there, Ctrl-C in the middle of the next; that one, whole, has a name of its own."""

    def leave(event: Event) -> None:
        if isinstance(event, Progress) and (
            ("holding" in event.words and (event.share or 0) > 0.4) or "lost" in event.words
        ):
            raise KeyboardInterrupt

    with robot(tmp_path / "ant", clock={"mode": "stepped", "doze": step is thermal_soak}) as there:
        first, _ = there.do(step(there.bench))
        (whole,) = kept = there.recorded()
        with pytest.raises(Declined):
            there.do(step(there.bench), Refusing(there.control))
        with pytest.raises(HardwareFault):
            there.do(step(replace(there.bench, bus="/dev/ttyUSB9", control=None)))
        assert there.recorded() == kept
        with pytest.raises(KeyboardInterrupt):
            there.do(step(there.bench), there.builder(before=leave))
        assert len(there.recorded()) == 2
        assert there.recorded().items() >= kept.items()
        kept = there.recorded()
        last, _ = there.do(step(there.bench))
        assert there.recorded()[whole] == kept[whole]
    assert whole in str(first)
    assert whole not in str(last)
    assert any(name in str(last) for name in there.recorded())


def test_a_pause_does_not_count_as_soaking(tmp_path: Path) -> None:
    path = tmp_path / "soak.mcap"
    channel = ServoChannel("knee_fl", "XL430-W250-T", 11, 1, 0.0, {"pos": 0.0015})
    with RecordingWriter(path, facts=Facts(("knee_fl",)), channels=[channel], clock=lambda: 0.0) as writer:
        for t in (0.0, 10.0, 3610.0, 3620.0):
            if t == 3610.0:
                writer.event("resumed", pause_s=3600.0)
            writer.cycle(Cycle(t, [None], None, None, [RecordedAnswer({"pos": 1}, True)], [False]))
    assert read_recording(path).run.duration_s == 3620.0
    assert soaked_seconds(path) == pytest.approx(20.0)


def test_motions_that_were_recorded_are_not_played_again_unless_the_robot_is_another(
    tmp_path: Path, brisk: None
) -> None:
    with robot(tmp_path / "ant", motor={"coulomb_nm": 0.09}) as there:
        coarsen(there.folder.path / NOMINAL_MODEL)
        note = left(
            there,
            identification,
            "identify",
            lambda event: isinstance(event, Progress) and "recording 3 of 3" in event.words,
        )
        assert (note.words, note.next) == ("2 of 4", "the same again")
        recorded = {
            path.name: path.read_bytes() for path in there.folder.recordings.iterdir() if "out-2" not in path.name
        }
        limit = there.folder.config().motors["knee_rr"].max_rad
        there.folder.update({"motors.knee_rr.max_rad": 1.0}, provenance=Provenance("measured", "a test"))
        intents = list[str]()

        def granted(event: Event) -> bool:
            intents.extend([event.words] if isinstance(event, Intent) else [])
            return bool(intents)

        left(
            there,
            identification,
            "identify",
            granted,
        )
        assert intents[0].endswith("3 × 5 s, then adjust the simulation to the recordings")
        there.folder.update({"motors.knee_rr.max_rad": limit}, provenance=Provenance("measured", "a test"))
        finding, builder = there.do(identification(there.bench))
    assert finding.step == "identify"
    assert [event.words.split(", ")[2] for event in builder.events if isinstance(event, Intent)] == ["1 × 5 s"]
    assert {name: (there.folder.recordings / name).read_bytes() for name in recorded} == recorded
    assert [name for name in there.recorded() if "out-2-cut-short" in name], "what was cut short is kept, too"
    assert unfinished(there.folder, "identify", virtual=True) is None


def test_slides_that_were_read_stay_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def sliding(builder: Builder, event: Event) -> Answer:
        return True if isinstance(event, Live) and event.values["plate"] > 0.3 else shown(builder, event)

    shown = Builder.answer
    monkeypatch.setattr(Builder, "answer", sliding)
    with robot(tmp_path / "ant") as there:
        note = left(
            there, floor_friction, "floor-friction",
            lambda event: "Trial 2" in getattr(event, "words", ""), **{"How often": 3.0},
        )  # fmt: skip
        assert (note.words, note.next) == ("1 of 3", "trial 2")
        finding, builder = there.do(floor_friction(there.bench))
    assert not asked(builder)
    assert "Trial 2 of 3" in builder.said
    assert "Trial 1 of 3" not in builder.said
    assert np.isfinite(finding.parameters[0].value or np.nan)


def test_what_was_done_on_a_virtual_robot_is_not_done_on_the_real_one(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "my-ant")
    found = Finding("connect", True, "the bus answers", (), "", "openant calib connect")
    keep(found, folder, virtual=True)
    assert Bench(folder, control="control").virtual
    assert not Bench(folder, bus="/dev/ttyUSB0").virtual
    assert standing(folder)["connect"].state == "ok"
    assert standing(folder, real=True)["connect"].state == "todo"
    assert "on a virtual robot" in next(folder.findings.glob("connect-*.md")).read_text()
    assert "virtual robot" in write_passport(folder)[1].read_text()
    keep(replace(found, date=found.date + datetime.timedelta(seconds=1)), folder)
    assert standing(folder, real=True)["connect"].state == "ok"
    assert "virtual robot" not in write_passport(folder)[1].read_text()


def test_walk_and_passport_count_the_same_steps_and_a_virtual_trial_takes_nothing_back(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "my-ant")
    then, later = datetime.datetime(2026, 11, 20, 9, 30, tzinfo=datetime.UTC), datetime.timedelta(seconds=1)
    found = Finding("connect", True, "the bus answers", (), "", "openant calib connect", date=then)
    keep(found, folder)
    keep(replace(found, date=found.date + later), folder, virtual=True)
    keep(replace(found, step="estop", date=found.date + 2 * later), folder, virtual=True)
    for bench, steps in ((Bench(folder), 2), (Bench(folder, control="control"), 3)):
        passport = do(WALK["passport"], bench, CommandFace(yes=True))
        counted = sum(one.state == "ok" for one in standing(folder, real=not bench.virtual).values())
        assert counted == steps
        assert f"{counted} of {len(WALK)} steps" in passport.what
        assert f"{counted} of {len(WALK)} steps" in folder.passport.with_suffix(".md").read_text()
    real = standing(folder, real=True)
    assert (real["connect"].state, real["connect"].virtual) == ("ok", False), "found on the robot itself before"
    assert (real["estop"].state, real["estop"].virtual) == ("todo", True)
