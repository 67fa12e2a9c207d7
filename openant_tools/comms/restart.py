"""What goes on by itself after a stop, and what does not: the one table that every face asks before torque comes on again.

Motion begins by the builder's word. A stop ends it; it begins again by itself only where `RULES` says so for that face,
so often within so long, and only if the condition holds that stands there. Everything else ends motion for good: it
takes a new command or an answered question. `docs/restart.md` is made from this table.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from openant_tools.errors import HardwareFault
from openant_tools.numbers import exact

__all__ = [
    "POSE_RAD",
    "RULES",
    "Face",
    "Interlock",
    "MotionStopped",
    "Restart",
    "RestartRule",
    "StopCause",
    "longest_wait_s",
    "restart_page",
    "unattended_words",
]

#: Who goes on by itself at all; any other command ends with the first stop.
Face = Literal["comms soak", "openant_env"]
FACES: tuple[Face, ...] = ("comms soak", "openant_env")
#: rad between where a joint was seen last after a stop and where it is when servos answer anew, that are the same pose: a
#: leg sinks by itself, hands move it farther
POSE_RAD = 0.35


class StopCause(StrEnum):
    """Why motion ended: what faces decide by, whatever the words are."""

    STORAGE = "storage"
    LIMITS = "limits"
    OVERLOAD = "overload"
    VOLTAGE = "voltage"
    HEAT = "heat"
    HARDWARE_ERROR = "hardware_error"
    SILENCE = "silence"
    STALL = "stall"
    PORT = "port"
    GUARDIAN = "guardian"
    NOT_FOLLOWING = "not_following"
    BY_HAND = "by_hand"
    TAG = "tag"
    IMU = "imu"
    FALL = "fall"
    WINDING = "winding"
    CABLE = "cable"
    #: nobody has said why: the safe reading is the worst
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class RestartRule:
    """One row: whether motion may begin again by itself after this.

    Attributes:
        what: the cause in a builder's words.
        faces: who may; none where motion ends for good.
        times, within_s: so often at most within so many s.
        condition: what must hold first.
        each_joint: counted for each servo by itself.
    """

    cause: StopCause
    what: str
    faces: tuple[Face, ...] = ()
    times: int = 0
    within_s: float = 0.0
    condition: str = ""
    each_joint: bool = False


#: from here on a condition is the environment's own
_HERE = "; in openant_env: "
_SAME = "the same servos answer anew, every joint that was seen since is where it was seen last"

RULES: Mapping[StopCause, RestartRule] = {
    rule.cause: rule
    for rule in (
        RestartRule(StopCause.STORAGE, "the disk is full, or a recording, checkpoint or log cannot be written"),
        RestartRule(StopCause.LIMITS, "a joint is measured outside its limits"),
        RestartRule(StopCause.OVERLOAD, "a servo pushes near its stall for longer than it may"),
        RestartRule(StopCause.VOLTAGE, "the supply leaves the range of a servo"),
        RestartRule(StopCause.NOT_FOLLOWING, "a joint stands where its command does not explain it"),
        RestartRule(StopCause.PORT, "the bus adapter is gone, or its line never falls silent"),
        RestartRule(StopCause.GUARDIAN, "the guardian process has died"),
        RestartRule(StopCause.FALL, "the robot lies on its back or side"),
        RestartRule(StopCause.CABLE, "the cable is wound up by two turns, or by less and turning back does not help"),
        RestartRule(StopCause.BY_HAND, "the stop key, or a pause by hand"),
        RestartRule(StopCause.UNKNOWN, "anything that is not in this table"),
        RestartRule(
            StopCause.HARDWARE_ERROR, "a servo has shut itself down", ("openant_env",), 1, 3600.0,
            "it was started anew; one that reports an error again within that time ends motion for good", each_joint=True,
        ),
        RestartRule(
            StopCause.SILENCE, "servos are silent, or their answers are broken", FACES, 12, 600.0,
            f"all answer again{_HERE}{_SAME}",
        ),
        RestartRule(
            StopCause.STALL, "this computer stood still, and the servos' Bus Watchdog stopped the motion", FACES, 3, 600.0,
            f"all answer again{_HERE}{_SAME}",
        ),
        RestartRule(
            StopCause.HEAT, "a servo comes near its temperature limit", ("openant_env",), 10, 3600.0,
            "it has rested, torque off, until it is 15 °C cooler",
        ),
        RestartRule(
            StopCause.WINDING, "the cable is wound up by a turn and a half", ("openant_env",), 30, 3600.0,
            "it has turned itself back on the spot, in the camera's view",
        ),
        RestartRule(
            StopCause.TAG, "the camera does not see the robot", ("openant_env",), 20, 600.0,
            "it is seen again; meanwhile it lies, torque off",
        ),
        RestartRule(
            StopCause.IMU, "the IMU sends nothing", ("openant_env",), 20, 600.0,
            "it sends again; meanwhile the robot lies, torque off",
        ),
    )
}  # fmt: skip


class MotionStopped(HardwareFault):
    """A motion that the engine has ended; torque is off.

    Attributes:
        cause: why, for faces to decide by.
    """

    exit_code = 1

    def __init__(
        self, what: str, *, where: str | None = None, remedy: str | None = None, cause: StopCause = StopCause.UNKNOWN
    ) -> None:
        super().__init__(what, where=where, remedy=remedy)
        self.cause = cause


@dataclass(frozen=True)
class Restart:
    """Why torque may come on again after a stop: what an engine wants to be told, and keeps with the recording.

    Attributes:
        cause: of the stop, or None where the builder has said that motion may go on.
        count, times: which of how many restarts by itself this is.
    """

    cause: StopCause | None = None
    count: int = 0
    times: int = 0

    def __str__(self) -> str:
        if self.cause is None:
            return "motion begins again by the builder's word"
        return f"motion begins again by itself after {self.cause.value}, {self.count} of {self.times}"


@dataclass
class Interlock:
    """The table over time, for one face and one word of the builder.

    Attributes:
        ended: why motion has ended for good; "" while it has not.
    """

    face: Face
    ended: str = ""
    _at: dict[tuple[StopCause, str], deque[float]] = field(default_factory=dict)

    def stopped(self, cause: StopCause, why: str, now: float, joint: str | None = None) -> Restart | None:
        """What follows from a stop at `now` (s): the restart that is allowed once its condition holds, or None for good."""
        rule = RULES[cause]
        if self.face not in rule.faces:
            self.ended = why
            return None
        at = self._at.setdefault((cause, (joint or "") if rule.each_joint else ""), deque())
        while at and now - at[0] > rule.within_s:
            at.popleft()
        if len(at) >= rule.times:
            again = f"the {_ordinal(len(at) + 1)} time within {_span(rule.within_s)}"
            self.ended = f"{why} ({again})"
            return None
        at.append(now)
        return Restart(cause, len(at), rule.times)

    def end(self, why: str) -> None:
        """Motion has ended for good, since a condition of the table does not hold."""
        self.ended = why

    def word(self) -> Restart:
        """The builder has said that motion may go on: nothing that was counts any more."""
        self.ended = ""
        self._at.clear()
        return Restart()


def _ordinal(n: int) -> str:
    return {1: "first", 2: "second", 3: "third"}.get(n, f"{n}th")


def _span(seconds: float) -> str:
    return exact(seconds / 3600, "h") if seconds >= 3600 else exact(seconds / 60, "min")


def longest_wait_s(cause: StopCause | None) -> float:
    """s for which a robot that nobody looks after waits for what must hold first: the time in which its restarts are counted.

    Args:
        cause: of the stop; None, or one that nothing begins again after: the longest of the table.
    """
    within = 0.0 if cause is None else RULES[cause].within_s
    return within or max(rule.within_s for rule in RULES.values())


def unattended_words() -> list[str]:
    """Lines for whoever gives the word and goes: what a walking robot does alone, how often, and what ends it."""
    alone = [rule for rule in RULES.values() if "openant_env" in rule.faces]
    ends = [rule.what for rule in RULES.values() if "openant_env" not in rule.faces]
    return [
        "Unattended, it goes on by itself after",
        *(f"  {rule.what}: {_often(rule)}, once {rule.condition.rpartition(_HERE)[2]}" for rule in alone),
        "and waits no longer for that than the time named. All else ends the run, torque off and saved:",
        *(f"  {what}" for what in ends),
        "The same command is your word that it may go on.",
    ]


def _often(rule: RestartRule) -> str:
    return f"{rule.times}× in {_span(rule.within_s)}" + (", each servo" if rule.each_joint else "")


def restart_page() -> str:
    """`docs/restart.md`, as Markdown."""
    rows = []
    for rule in RULES.values():
        if rule.faces:
            rows.append(
                f"| {rule.what} | `{rule.cause.value}` | {', '.join(rule.faces)} | {_often(rule)} | {rule.condition} |"
            )
        else:
            rows.append(
                f"| {rule.what} | `{rule.cause.value}` | **nobody** | – | a new command, or an answered question |"
            )
    return _PAGE.format(rows="\n".join(rows))


_PAGE = """\
# What goes on by itself, and what does not

<!-- made from openant_tools/comms/restart.py by `python -m openant_tools.comms.restart > docs/restart.md` -->

Motion begins by your word: a command that asks first, or `--yes`. Whatever stops it switches torque off. Only what stands
here with a name in the third column begins again by itself, and only so often; it is said, and stands in the recording as an
event (`stopped`, `restart`). Everything else has ended for good. Single lost answers stop nothing and are counted.

| what happened | cause | goes on by itself | how often | once |
|---|---|---|---|---|
{rows}

- **Every other command** (`sysid record`, `thermal soak`, `calib`, `check`, `bringup` …) ends with the first stop: torque off,
  the recording kept as far as it got, exit code 1. `bringup` ends that step, and the whole walk where motion has ended for good.
- **`comms soak`** goes on listening, torque off, after a stop that ends motion for good, since it is the losses that are
  wanted; exit code 1. A full disk ends it.
- **`openant_env`** truncates the step (`info["stop_cause"]` is the cause, `info["void"]` where its action was not carried
  out). While motion may go on, `reset()` waits for the condition and goes on. Where it has ended for good `reset()` raises
  one line. Your word is `reset(options={{"resume": True}})`, `env.unwrapped.resume()`, or the environment made anew; in
  `openant train` and `openant eval` the space bar where a terminal is attached, else the same command again.
- **`openant train … --unattended`** tells this table before it asks for your word, and asks nothing afterwards. It waits for a
  condition no longer than the time in which its restarts are counted. Where a person is needed the run ends: torque off, saved,
  exit code 1, one line with what is needed; the same command is your word, and goes on. A virtual robot is no exception then.
- **A cable that winds up** is turned back before it is too late: at a turn and a half the step is truncated, and `reset()` turns
  the robot on the spot, with a gait of its own, until nothing is wound up or half a minute has passed.
- **A virtual robot** has nobody beside it: one that fell, wound up its cable or left the picture is put back by its
  environment, which is the word.
- **In the engine** `messages.Torque(True)` after a stop is refused unless it brings the `Restart` that the table or the
  builder gave.
"""


if __name__ == "__main__":
    print(restart_page(), end="")
