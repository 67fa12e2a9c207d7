"""What the engine refuses: every field of every message, by name, with torque as it was and the engine alive."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openant_tools.comms import messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.restart import MotionStopped
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.errors import BadInput, OpenAntError
from openant_tools.recording.run import Facts
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.virtual.process import virtual_robot

HOME = np.array(home_angles())
NAN, INF = math.nan, math.inf


def at_home(joint: int, value: float) -> np.ndarray:
    angles = HOME.copy()
    angles[joint] = value
    return angles


class Standing:
    """An engine whose robot holds its home pose, and the virtual robot's own view of it."""

    def __init__(self, engine: EngineProcess, control: VirtualControl) -> None:
        self.engine, self._control = engine, control

    def state(self) -> tuple[list[bool], np.ndarray]:
        """Torque and angle of every servo."""
        state = self._control.ask("state")
        return list(state["torque_enable"].values()), np.array(list(state["angle"].values()))

    def refuses(self, command: Any, *words: str) -> None:
        """In words, as a refusal and not as a stop; torque stays on, nothing moves, and the engine answers."""
        with pytest.raises(OpenAntError) as refused:
            self.engine.ask(command, 20.0)
        assert not isinstance(refused.value, MotionStopped)
        for word in words:
            assert word in str(refused.value), str(refused.value)
        assert "Traceback" not in str(refused.value)


@pytest.fixture(scope="module")
def standing() -> Iterator[Standing]:
    with virtual_robot("default", clock="stepped", camera=False) as robot:
        control = VirtualControl(str(robot["control"]))
        with EngineProcess(config_of_unknown_robot(str(robot["bus"]), robot["control"])) as engine:
            engine.ask(messages.Torque(True))
            engine.ask(messages.Ramp(HOME))
            yield Standing(engine, control)
        control.close()


def test_what_cannot_be_is_refused_by_name_and_nothing_moves(standing: Standing) -> None:
    _, before = standing.state()
    refusals: list[tuple[Any, tuple[str, ...]]] = []
    for make, name in ((lambda a: messages.Goal(a, 0.1), "Goal.target"), (messages.Ramp, "Ramp.target")):
        refusals += [
            (make(at_home(1, NAN)), (name, "nan", JOINT_NAMES[1])),
            (make(at_home(2, INF)), (name, "inf", JOINT_NAMES[2])),
            (make(at_home(3, -INF)), (name, "-inf", JOINT_NAMES[3])),
            (make(at_home(3, 9.0)), (name, "515.66°", JOINT_NAMES[3], "outside its limits")),
            (make(at_home(0, 0.7854 + 1e-4)), (name, JOINT_NAMES[0], "outside its limits")),
            (make(np.zeros(1)), (name, "shape (1,)", "8 joints")),
            (make(np.float64(0.0)), (name, "shape ()")),
            (make(np.zeros((1, 8))), (name, "shape (1, 8)")),
            (make(np.zeros(9)), (name, "shape (9,)")),
            (make(np.zeros(0)), (name, "shape (0,)")),
            (make(HOME.astype(complex)), (name, "complex")),
            (make(np.array(["0.1"] * 8)), (name, "no numbers")),
            (make(np.ones(8, bool)), (name, "no numbers")),
            (make(None), (name, "None")),
            (make([[1.0], [1.0, 2.0]]), (name,)),
        ]
    for seconds in (NAN, INF, -INF, -1.0, 1e300, 10**400, "1", None, True, 1j):
        for make, name in (
            (lambda s: messages.Goal(HOME, s), "Goal.seconds"),
            (messages.Hold, "Hold.seconds"),
            (messages.LetPass, "LetPass.seconds"),
        ):
            refusals.append((make(seconds), (name,)))
    rows = np.repeat(HOME[None, :], 5, axis=0)
    bad = rows.copy()
    bad[3, 4] = NAN
    refusals += [
        (messages.Play(bad), ("Play.commands", "nan", JOINT_NAMES[4], "row 3")),
        (messages.Play(rows[:0]), ("Play.commands", "shape (0, 8)")),
        (messages.Play(HOME), ("Play.commands", "shape (8,)")),
        (messages.Play(rows, limp=np.zeros(8, bool)), ("Play.limp", "shape (8,)")),
        (messages.Play(rows, limp=np.zeros((5, 8))), ("Play.limp", "float64")),
        (messages.Play(rows, name=7), ("Play.name", "7")),  # type: ignore[arg-type]
        (messages.Torque("off"), ("Torque.on", "'off'")),  # type: ignore[arg-type]
        (messages.Torque(True, restart="please"), ("Torque.restart", "please")),  # type: ignore[arg-type]
        (messages.Goal(HOME, 0.1, measured=3), ("Goal.measured", "3")),  # type: ignore[arg-type]
        (messages.Goal(HOME, 0.1, agent=(0.0, NAN)), ("Goal.agent", "nan")),
        (messages.Goal(HOME, 0.1, agent=(0.0,)), ("Goal.agent",)),  # type: ignore[arg-type]
        (messages.ReadRegister("present_mood"), ("present_mood",)),
        (messages.ReadRegister(None), ("ReadRegister.register", "None")),  # type: ignore[arg-type]
        (messages.WriteRegister("wing", "goal_pwm", 1), ("wing",)),
        (messages.WriteRegister("hip_rr", "goal_pwm", 1.5), ("WriteRegister.counts", "1.5", "hip_rr")),  # type: ignore[arg-type]
        (messages.WriteRegister("hip_rr", "goal_pwm", 10**9), ("goal_pwm", "1000000000")),
        (messages.WriteRegister("hip_rr", "torque_enable", 0), ("torque_enable", "hip_rr", "Torque")),
        (messages.WriteRegister("hip_rr", "bus_watchdog", 0), ("bus_watchdog", "hip_rr")),
        (messages.WriteRegister("hip_rr", "goal_position", 0), ("goal_position", "within their limits")),
        (messages.WriteRegister("hip_rr", "shutdown", 0), ("shutdown",)),
        (messages.Record("", Facts(JOINT_NAMES)), ("Record.path",)),
        (messages.Record("a\0b", Facts(JOINT_NAMES)), ("Record.path",)),
        (messages.Record("x", None), ("Record.facts", "None")),  # type: ignore[arg-type]
        (messages.Record("x", Facts(JOINT_NAMES), thin_s=NAN), ("Record.thin_s", "nan")),
        ("go", ("no message str",)),
        (messages.Notice("go"), ("no message Notice",)),
        (lambda: None, ("cannot be sent",)),
    ]
    for command, words in refusals:
        standing.refuses(command, *words)
    on, after = standing.state()
    assert all(on)
    assert np.abs(after - before).max() < 0.01
    assert not Path("x").exists()
    assert standing.engine.ask(messages.Statistics())["cycles"] > 0


def test_bytes_that_are_no_message_are_told_and_the_engine_lives(standing: Standing) -> None:
    for data in (b"", b"\x80", b"no pickle", b"\x80\x04K\x07.", b"\x80\x04cos\nnothing_there\n."):
        standing.engine._connection.send_bytes(data)
    with pytest.raises(BadInput, match="LetPass cannot be sent to the engine"):
        standing.engine.ask(messages.LetPass(lambda: 1.0))  # type: ignore[arg-type]
    assert standing.engine.ask(messages.Statistics())["cycles"] > 0
    told = [event.text for event in standing.engine.events() if isinstance(event, messages.Notice)]
    assert sum("was refused" in text for text in told) == 5
    assert all(standing.state()[0])


def test_rounding_at_a_limit_is_no_reason_and_a_refused_goal_leaves_the_one_before_in_force(standing: Standing) -> None:
    low, high = standing.engine.config.limits_rad[JOINT_NAMES[0]]
    for angle in (float(np.float32(high)), high + 1e-9, low - 1e-9):
        end = standing.engine.ask(messages.Goal(at_home(0, angle), 0.6))
        assert end[0] == pytest.approx(angle, abs=0.06)
    standing.engine.ask(messages.Goal(HOME.tolist(), 0.6))  # type: ignore[arg-type]
    moving = standing.engine.start(messages.Goal(at_home(0, 0.3), 0.6))
    standing.refuses(messages.Goal(at_home(0, 2.0), 0.6), "114.59°")
    assert standing.engine.wait(moving)[0] == pytest.approx(0.3, abs=0.06)
    standing.engine.ask(messages.Ramp(HOME))


def test_random_messages_never_harm_the_engine(standing: Standing) -> None:
    """Fields of any kind in any message: refused or done, and in the end it still stands where it stood."""
    chance = np.random.default_rng(1)
    stopped: list[MotionStopped] = []
    for _ in range(150):
        try:
            standing.engine.ask(random_message(chance), 20.0)
        except MotionStopped as error:
            stopped.append(error)
        except OpenAntError:
            pass
    assert not stopped
    assert all(standing.state()[0])
    standing.engine.ask(messages.Ramp(HOME))
    assert np.abs(standing.engine.ask(messages.Hold(0.3)) - HOME).max() < 0.06


VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 0.05, NAN, INF, 1e308, 10**400, "", "hip_rr", "goal_pwm", b"\0", [], [0.0] * 8, (1, 2), {}, object,
    np.zeros(8), np.zeros((3, 8)), np.full(8, 3.0), np.full((2, 8), INF), np.zeros((2, 2, 2)), np.array(0.1), HOME,
    np.array([None] * 8), np.float32(0.1), np.int64(3), "x" * 5000, 2j,
)  # fmt: skip


def random_message(chance: np.random.Generator) -> Any:
    """One that switches nothing off and records nothing, with any value in any field."""
    kinds = (messages.Ramp, messages.Play, messages.Hold, messages.Goal, messages.LetPass, messages.ReadRegister,
             messages.WriteRegister)  # fmt: skip
    kind: Any = kinds[chance.integers(len(kinds))]
    fields = [VALUES[chance.integers(len(VALUES))] for _ in kind.__dataclass_fields__]
    command = object.__new__(kind)
    for name, value in zip(kind.__dataclass_fields__, fields, strict=True):
        object.__setattr__(command, name, value)
    return command
