"""What became of a training run on a robot, from the run's own recordings, curve and log: one page.

Speed over robot time with every intervention; deadlines met and missed, and why; how old observations were; what a virtual
robot took of this computer; temperatures against limits; answers lost; and what the robot did while nobody looked.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from openant_tools.bringup.run_log import LogLine, read_log, whole_rows
from openant_tools.comms.lateness import LATE_S
from openant_tools.errors import BadInput
from openant_tools.files import read_json, read_text, reading
from openant_tools.numbers import column, number, percent
from openant_tools.recording.reader import Recording, read_recording
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, Table, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["DONE", "JointHeat", "Steps", "TrainingRecord", "read_training", "training_report"]

Array = NDArray[np.float64]
T = TypeVar("T")

#: s of robot time over which a run's speed is told, and of one point of its curve
LAST_S, WINDOW_S = 600.0, 120.0
#: share of an engine's cycle by which a step may be too long before it counts as late (openant_env.hardware)
LATE_SHARE = 0.5
#: steps without a new action, after which a robot does not walk any more
PAUSE_STEPS = 3.0
#: share of late steps that is worth a warning
LATE_STEPS = 0.02
#: s of one mark of the temperature
HEAT_EVERY_S = 20.0
#: what the robot did, and in which colour that is drawn
DONE: Mapping[str, str] = {
    "walking": plots.GREEN, "standing up, turning back, lying down": plots.SKY, "torque off, watched": plots.ORANGE,
    "not connected": plots.VERMILLION,
}  # fmt: skip
_WALKING, _MOVING, _LYING, _GONE = DONE


@dataclass(frozen=True)
class Steps:
    """Steps of an agent on a robot in real time.

    Attributes:
        at: (steps,) s since 1970, when its command left. period: (steps,) s, until the next one.
        late: (steps,) whether it was longer than it may be.
        joints, imu, position: (steps,) s, how old these were when the action that ended it was chosen.
        reasons: why steps were late → how many.
    """

    at: Array
    period: Array
    late: NDArray[np.bool_]
    joints: Array
    imu: Array
    position: Array
    reasons: Mapping[str, int]

    @classmethod
    def together(cls, parts: Sequence[Steps]) -> Steps:
        def joined(name: str, kind: type = float) -> Any:
            return np.concatenate([np.empty(0, kind), *(getattr(part, name) for part in parts)])

        reasons: Counter[str] = Counter()
        for part in parts:
            reasons.update(part.reasons)
        names = ("at", "period", "joints", "imu", "position")
        return cls(**{name: joined(name) for name in names}, late=joined("late", bool), reasons=reasons)

    @property
    def late_share(self) -> float:
        """NaN where there are none, as in stepped time."""
        return float(self.late.mean()) if len(self.late) else math.nan


@dataclass(frozen=True)
class JointHeat:
    """One servo's temperature.

    Attributes:
        at: (marks,) s since 1970. hottest: (marks,) °C, since the mark before.
        limit_c: where it shuts down; NaN where nobody knows.
        forecast: what was said beforehand, in words; "" where nothing was.
    """

    joint: str
    at: Array
    hottest: Array
    limit_c: float
    forecast: str = ""


@dataclass(frozen=True)
class TrainingRecord:
    """What the files of a run tell.

    Attributes:
        curve: (points, 2) s of robot time, m/s over the last 120 s.
        interventions: (s of robot time, why).
        done: (from, to, what) s since 1970, in order; what is one of `DONE`.
        answers, lost: of the servos, and by cause those that did not come.
        processors: of this computer that a virtual robot took, on average; NaN of a real one, and in stepped time.
        of_processors: that this computer has.
        recordings: that were read. unreadable: those that could not be, and rows of other files.
    """

    run: Path
    facts: Mapping[str, Any]
    curve: Array
    interventions: Sequence[tuple[float, str]]
    log: Sequence[LogLine]
    steps: Steps
    heat: Sequence[JointHeat]
    done: Sequence[tuple[float, float, str]]
    answers: int
    lost: Mapping[str, int]
    processors: float
    of_processors: int
    recordings: Sequence[Path]
    unreadable: Sequence[str] = field(default=())

    @property
    def robot_s(self) -> float:
        return float(self.curve[-1, 0] if len(self.curve) else self.steps.period.sum())

    @property
    def speed_m_s(self) -> float:
        """Over the last ten minutes of robot time, from windows of the curve that do not overlap."""
        if not len(self.curve):
            return math.nan
        end, count = self.robot_s, max(1, min(round(LAST_S / WINDOW_S), int(self.robot_s // WINDOW_S)))
        return float(np.interp(end - WINDOW_S * np.arange(count), *self.curve.T).mean())

    @property
    def seconds_of(self) -> dict[str, float]:
        """What it did → s, of the wall clock."""
        spent = dict.fromkeys(DONE, 0.0)
        for start, stop, what in self.done:
            spent[what] += stop - start
        return spent

    @property
    def alone(self) -> int:
        """How often it went on by itself."""
        return sum(line.words.startswith("motion begins again by itself") for line in self.log)

    @property
    def words_given(self) -> int:
        """How often somebody said that it may go on: by the space bar, with the command again, or with hands."""
        begun = sum(line.words.startswith("begun") for line in self.log)
        said = sum("by the builder's word" in line.words for line in self.log)
        return max(0, begun - 1) + said

    def as_json(self) -> dict[str, Any]:
        """For scripts: SI units."""
        steps = self.steps

        def quantiles(values: Array) -> dict[str, float] | None:
            known = values[np.isfinite(values)]
            return {"median": float(np.median(known)), "p99": float(np.quantile(known, 0.99))} if len(known) else None

        return {
            "run": str(self.run), "agent": self.facts.get("agent"), "seed": self.facts.get("seed"),
            "robot_s": self.robot_s, "average_reward_m_s": self.speed_m_s,
            "wall_s": self.done[-1][1] - self.done[0][0] if self.done else 0.0, "seconds_of": self.seconds_of,
            "interventions": len(self.interventions), "by_itself": self.alone, "words_given": self.words_given,
            "steps": len(steps.period), "late": int(steps.late.sum()), "late_why": dict(steps.reasons),
            "period_s": quantiles(steps.period),
            "observation_age_s": {name: quantiles(getattr(steps, name)) for name in ("joints", "imu", "position")},
            "processors_of_virtual_robot": self.processors, "processors": self.of_processors,
            "temperatures": {
                one.joint: {"hottest_c": _most(one.hottest), "limit_c": one.limit_c, "forecast": one.forecast}
                for one in self.heat
            },
            "answers": self.answers, "lost": dict(self.lost), "unreadable": list(self.unreadable),
        }  # fmt: skip


# ------------------------------------------------------------------------------------------------------------ reading


def read_training(run: Path, forecast: Path | None = None) -> TrainingRecord:
    """All that the files of a training run on a robot tell.

    Args:
        forecast: what `openant thermal forecast --json` wrote before it.

    Raises:
        BadInput: this is no training run on a robot, or the forecast is none.
    """
    facts_file = run / "run.json"
    if not facts_file.is_file():
        raise BadInput(
            "there is no training run here (no run.json)", where=run, remedy="name the --out of `openant train`"
        )
    facts = read_json(facts_file, "name the --out of `openant train`")
    found = sorted((run / "recordings").glob("*.mcap"))
    if not isinstance(facts, dict) or not found:
        raise BadInput(
            "it has no recordings of a robot", where=run, remedy="name a run of `openant train --env hardware`"
        )
    foreseen = {} if forecast is None else _foreseen(forecast)
    steps: list[Steps] = []
    heat: dict[str, tuple[list[Array], list[Array], float]] = {}
    done: list[tuple[float, float, str]] = []
    lost: Counter[str] = Counter()
    answers, used_s, watched_s, of_processors = 0, 0.0, 0.0, 0
    unreadable: list[str] = []
    offset = 0.0
    for path in found:
        try:
            recording = read_recording(path)
        except BadInput as error:
            unreadable.append(str(error))
            continue
        run_of = recording.run
        offset = _offset(recording, done[-1][1] if done else None, offset)
        made = _steps(recording, offset)
        steps.append(made)
        if done and run_of.t[0] + offset > done[-1][1]:
            done.append((done[-1][1], float(run_of.t[0] + offset), _GONE))
        done += _doings(recording, made, offset)
        ok = run_of.signal("ok")
        answers += int(np.isfinite(ok).sum())
        for joint in run_of.joints:
            words = run_of.columns.get(f"err.{joint}", np.empty(0, object))
            lost.update(str(word) for word in words[run_of.column(f"ok.{joint}")[: len(words)] == 0.0])
            limit = recording.registers.get(joint, {}).get("temperature_limit", math.nan)
            at, hottest = _marks(run_of.t, run_of.column(f"temp.{joint}"))
            times, values, _ = heat.setdefault(joint, ([], [], float(limit)))
            times.append(at + offset)
            values.append(hottest)
        notes = [event for event in recording.events if event["kind"] == "virtual robot"]
        if len(notes) > 1:
            used_s += notes[-1]["processor_s"] - notes[0]["processor_s"]
            watched_s += notes[-1]["t"] - notes[0]["t"]
            of_processors = int(notes[-1]["processors"] or 0)
    curve, torn_curve = _curve(run / "learning_curve.csv")
    interventions, torn_interventions = _interventions(run / "interventions.csv")
    log, torn_log = read_log(run)
    unreadable += [torn for torn in (torn_curve, torn_interventions, torn_log) if torn]
    return TrainingRecord(
        run=run,
        facts=facts,
        curve=curve,
        interventions=interventions,
        log=log,
        steps=Steps.together(steps),
        heat=[
            JointHeat(joint, np.concatenate(times), np.concatenate(values), limit, foreseen.get(joint, ""))
            for joint, (times, values, limit) in heat.items()
        ],
        done=done,
        answers=answers,
        lost=lost,
        processors=used_s / watched_s if watched_s > 0.0 else math.nan,
        of_processors=of_processors,
        recordings=found,
        unreadable=unreadable,
    )


def _offset(recording: Recording, until: float | None, before: float) -> float:
    """s that make a time of the rows one since 1970.

    The clock of a robot in stepped time is not the wall's: then time goes on where the recording before ended.

    Args:
        until: where that one ended, s since 1970; None for the first. before: its own offset, s.
    """
    if until is None or np.isfinite(recording.run.column("act_t")).any():
        return datetime.fromisoformat(recording.started["wall"]).timestamp() - float(recording.started["clock"])
    begins = float(recording.run.t[0])
    return before if begins + before >= until else until - begins


def _curve(path: Path) -> tuple[Array, str]:
    """(points, 2), and words on rows that are torn."""
    points, torn = _read_csv(path, lambda row: (float(row["seconds"]), float(row["average_reward_m_s"] or math.nan)))
    curve = np.array(points).reshape(-1, 2)
    return curve[np.isfinite(curve[:, 1])], torn


def _interventions(path: Path) -> tuple[list[tuple[float, str]], str]:
    return _read_csv(path, lambda row: (float(row["seconds"]), row["reason"]))


def _read_csv(path: Path, make: Callable[[Mapping[str, str]], T]) -> tuple[list[T], str]:
    """What is made of each row, none where there is no such file; and words on rows that are torn."""
    if not path.is_file():
        return [], ""

    def whole(row: Mapping[str, str]) -> T:
        if None in row or None in row.values():
            raise ValueError
        return make(row)

    return whole_rows(path, csv.DictReader(io.StringIO(read_text(path))), whole)


def _foreseen(path: Path) -> dict[str, str]:
    """Joint → what a forecast said of it."""
    with reading(path, "it is no forecast", "name what `openant thermal forecast --json` wrote"):
        table = json.loads(read_text(path))
        said = {}
        for one in table["joints"]:
            when, settles = one["seconds_to_limit"], one.get("settles_c")
            if when is not None:
                minutes = [float(when[key]) / 60.0 for key in ("value", "low", "high")]
                said[str(one["joint"])] = (
                    f"its limit after {number(minutes[0], 'min', minutes[1], minutes[2], decimals=0)}"
                )
            elif settles is not None:
                ends = float(settles["low"]), float(settles["high"])
                said[str(one["joint"])] = f"settles at {number(float(settles['value']), '°C', *ends, decimals=0)}"
            else:
                said[str(one["joint"])] = "stays below its limit"
        return said


def _steps(recording: Recording, offset: float) -> Steps:
    """The steps in which an agent's actions followed each other in real time."""
    run = recording.run
    acted, observed, left = run.column("act_t"), run.column("obs_t"), run.command_times
    extra = run.facts.extra
    first = np.flatnonzero(np.isfinite(acted) & np.r_[True, np.diff(acted) != 0.0])
    empty = np.empty(0)
    if len(first) < 2 or "dt_s" not in extra:
        return Steps(empty, empty, np.empty(0, bool), empty, empty, empty, {})
    dt, cycle = float(extra["dt_s"]), 1.0 / float(extra.get("rate_hz", 100.0))
    period = np.diff(left[first])
    follows = np.flatnonzero((period > 0.0) & (period < PAUSE_STEPS * dt))
    start, end = first[follows], first[follows + 1]
    period, chosen, seen = period[follows], acted[end], observed[end]
    late = period > dt + LATE_SHARE * cycle
    wake = np.nan_to_num(run.column("wake"))
    reasons: Counter[str] = Counter()
    for k in np.flatnonzero(late).tolist():
        parts = {
            "the agent's process saw the observation late": seen[k] - left[start[k]] - dt,
            "the agent took long to decide": chosen[k] - seen[k],
            "the command waited for its cycle": left[end[k]] - chosen[k],
        }
        why = max(parts, key=lambda name: parts[name])
        if wake[start[k] : end[k] + 1].max() > max(LATE_S, 0.5 * (period[k] - dt)):
            why = "the bus's process was late: this computer is busy"
        reasons[why] += 1
    return Steps(
        left[start] + offset, period, late,
        chosen - _newest(run.t, run.t, seen), chosen - _newest(recording.imu.t, recording.imu.t, seen),
        chosen - _newest(recording.pose.t, recording.pose_known, seen), reasons,
    )  # fmt: skip


def _newest(taken: Array, known: Array, at: Array) -> Array:
    """When what was newest at each time `at` was taken; NaN where nothing was known yet."""
    index = np.searchsorted(known, at, side="right") - 1
    return np.where(index >= 0, np.append(taken, np.nan)[index], np.nan)


def _doings(recording: Recording, steps: Steps, offset: float) -> list[tuple[float, float, str]]:
    """What the robot did, by stretches."""
    run = recording.run
    t, torque = run.t + offset, (np.nan_to_num(run.signal("torque", default=1.0)) > 0.0).any(axis=1)
    walking = torque.copy()
    if len(steps.at):
        dt = float(run.facts.extra["dt_s"])
        since = t - _newest(steps.at, steps.at, t)
        walking &= np.nan_to_num(since, nan=np.inf) < PAUSE_STEPS * dt
    else:  # in stepped time nobody keeps when actions were chosen
        command = run.signal("cmd")
        walking &= np.isfinite(command).all(axis=1)
    what = np.where(walking, 0, np.where(torque, 1, 2))
    edges = np.r_[0, np.flatnonzero(np.diff(what)) + 1, len(t)]
    names = list(DONE)
    return [
        (float(t[a]), float(t[min(b, len(t) - 1)]), names[what[a]])
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]


def _marks(t: Array, celsius: Array) -> tuple[Array, Array]:
    """The hottest of every stretch of some s."""
    known = np.isfinite(celsius)
    t, celsius = t[known], celsius[known]
    if not len(t):
        return np.empty(0), np.empty(0)
    group = ((t - t[0]) // HEAT_EVERY_S).astype(int)
    begins = np.r_[0, np.flatnonzero(np.diff(group)) + 1]
    return t[begins], np.maximum.reduceat(celsius, begins)


def _most(values: Array) -> float:
    return float(values.max()) if len(values) else math.nan


# ------------------------------------------------------------------------------------------------------------ the page


def training_report(record: TrainingRecord) -> Report:
    """The page of a run."""
    late, lost = record.steps.late_share, sum(record.lost.values()) / max(record.answers, 1)
    hours = f"{number(record.robot_s / 60, 'min', decimals=1)} of robot time"
    measured = math.isfinite(record.speed_m_s)
    speed = number(100 * record.speed_m_s, "cm/s", decimals=1) if measured else "–"
    helped = f"{len(record.interventions)} intervention{'' if len(record.interventions) == 1 else 's'}"
    rhythm = (
        "in stepped time, which waits for the agent"
        if math.isnan(late)
        else f"{percent(late, decimals=1)} of steps late"
    )
    reached = f"{speed} at the end of {hours}" if measured else "Ended before its speed was noted"
    verdict = f"{reached}, {rhythm}; {helped}, {record.words_given} confirmed by a person."
    busy = late > LATE_STEPS
    agent, seed = record.facts.get("agent", "agent"), record.facts.get("seed", "unknown")
    answer = ReportSummary(
        verdict,
        Figure(_speed_figure(record), "Average reward over 120 s against robot time; each intervention with its number."),
        "Late steps teach the agent delays that it will not meet elsewhere."
        if busy
        else "What was learned was learned at the robot's own pace." if not math.isnan(late)
        else "What was learned was learned without a deadline: a robot in real time has one.",
        "The table below names the programs that held it up: close them." if busy else f"`openant eval {record.run} --env hardware`",
        "" if math.isnan(late) else "warn" if busy else "good",
        figures=[
            KeyFigure("speed", speed, f"last {number(min(LAST_S, record.robot_s) / 60, 'min')}" if measured else "never noted"),
            KeyFigure("steps late", percent(late, decimals=1) if not math.isnan(late) else "–", "" if not math.isnan(late) else "stepped time"),
            KeyFigure("went on by itself", f"{record.alone}×", f"{record.words_given}× confirmed by a person"),
            KeyFigure("answers lost", percent(lost, decimals=2)),
        ],
    )  # fmt: skip
    report = Report("A robot's training", f"{agent}, seed {seed}, {record.run}", answer, recordings=record.recordings)
    _interventions_section(report, record)
    _alone_section(report, record)
    _deadlines_section(report, record)
    _heat_section(report, record)
    causes = ", ".join(f"{count}× {cause or 'unknown'}" for cause, count in Counter(record.lost).most_common())
    report.section("Answers lost").text(
        f"{sum(record.lost.values())} of {record.answers} answers of the servos did not come ({percent(lost, decimals=2)})"
        + (f": {causes}." if causes else ".")
    )
    if record.unreadable:
        report.section("What could not be read", open=True).text("\n".join(f"- {one}" for one in record.unreadable))
    return report


def _kind(reason: str) -> str:
    """A reason without its figures, so that equal ones are counted together."""
    plain = re.sub(r"^/\S+: | \([^)]*\)", "", reason.partition(" → ")[0].partition(";")[0])
    return re.sub(r"\d+(?:\.\d+)?", "…", plain)


def _interventions_section(report: Report, record: TrainingRecord) -> None:
    kinds = Counter(_kind(reason) for _, reason in record.interventions)
    report.section("Interventions", open=True)
    if not kinds:
        report.text("The robot never had to be set up again.")
        return
    report.table(["how often", "why"], [[count, kind] for kind, count in kinds.most_common()])
    rows = [[k, number(at / 60, decimals=1), reason] for k, (at, reason) in enumerate(record.interventions, 1)]
    report.details("Each of them", Table(["number", "robot time (min)", "why"], rows))


def _alone_section(report: Report, record: TrainingRecord) -> None:
    report.section("What the robot did while nobody looked", open=True)
    total = sum(record.seconds_of.values())
    report.figure(_doings_figure(record), "What it did, by the wall clock.")
    report.table(
        ["what", "time (min)", "share"],
        [
            [what, minutes, percent(seconds / total if total else 0.0)]
            for (what, seconds), minutes in zip(
                record.seconds_of.items(), column([s / 60 for s in record.seconds_of.values()]), strict=True
            )
        ],
    )
    begun = record.done[0][0] if record.done else 0.0
    rows = [[number((line.at - begun) / 60, decimals=1), line.words] for line in record.log]
    if rows:
        report.details("All that it said", Table(["after (min)", "words"], rows))


def _deadlines_section(report: Report, record: TrainingRecord) -> None:
    steps = record.steps
    report.section("Deadlines and how old observations are")
    if not len(steps.period):
        report.text(
            "In stepped time a robot waits for its agent: no step can be late, and no observation grows old meanwhile."
        )
        return
    met = int((~steps.late).sum())
    report.text(
        f"{met} of {len(steps.late)} steps were in time, {int(steps.late.sum())} late ({percent(steps.late_share, decimals=1)})."
    )
    if steps.reasons:
        report.table(["late steps", "why"], [[count, why] for why, count in Counter(steps.reasons).most_common()])
    rows = []
    for name, values in (
        ("period, command to command", steps.period), ("joints, when an action is chosen", steps.joints),
        ("IMU", steps.imu), ("position", steps.position),
    ):  # fmt: skip
        known = values[np.isfinite(values)]
        if len(known):
            quantiles = np.quantile(1e3 * known, [0.5, 0.99, 1.0])
            rows.append([name, *(number(float(value), decimals=0) for value in quantiles)])
    report.table(["age", "median (ms)", "99 of 100 (ms)", "most (ms)"], rows)
    if not math.isnan(record.processors):
        report.text(
            f"The virtual robot took {number(record.processors, decimals=2)} of this computer's {record.of_processors} processors, "
            "which a real one leaves to the agent."
        )


def _heat_section(report: Report, record: TrainingRecord) -> None:
    report.section("Temperatures")
    report.figure(_heat_figure(record), "Each servo's temperature; dashed, where it shuts down.")
    columns = ["servo", "hottest (°C)", "limit (°C)", "said beforehand"]
    rows = [
        [one.joint, number(_most(one.hottest), decimals=0), number(one.limit_c, decimals=0), one.forecast or "–"]
        for one in record.heat
    ]
    report.table(columns, rows)


def _speed_figure(record: TrainingRecord) -> MatplotlibFigure:
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=3.0)
    curve = record.curve
    with plots.style():
        axes.axhline(0.0, color=plots.INK, linewidth=0.6)
        axes.plot(curve[:, 0] / 60, 100 * curve[:, 1], color=plots.BLUE)
        for k, (at, _) in enumerate(record.interventions, 1):
            height = float(np.interp(at, *curve.T)) if len(curve) else 0.0
            axes.plot([at / 60], [100 * height], marker="o", color=plots.VERMILLION, linestyle="")
            axes.annotate(str(k), (at / 60, 100 * height), xytext=(3, 4), textcoords="offset points", fontsize=7)
        axes.set_xlabel(plots.axis_label("robot time", "min"))
        axes.set_ylabel(plots.axis_label("average reward over 120 s", "cm/s"))
    return figure


def _doings_figure(record: TrainingRecord) -> MatplotlibFigure:
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=1.2)
    begun = record.done[0][0] if record.done else 0.0
    with plots.style():
        for what, colour in DONE.items():
            bars = [((a - begun) / 60, (b - a) / 60) for a, b, did in record.done if did == what]
            if bars:
                axes.broken_barh(bars, (0, 1), facecolors=colour, label=what)
        axes.set_yticks([])
        axes.set_xlabel(plots.axis_label("time since it began", "min"))
    plots.legend(axes)
    return figure


def _heat_figure(record: TrainingRecord) -> MatplotlibFigure:
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=2.6)
    begun = record.done[0][0] if record.done else 0.0
    with plots.style():
        for k, one in enumerate(record.heat):
            colour = plots.CYCLE[k % len(plots.CYCLE)]
            axes.plot(
                (one.at - begun) / 60, one.hottest, color=colour, label=one.joint, linestyle="-" if k < 7 else "--"
            )
        for limit in sorted({one.limit_c for one in record.heat if math.isfinite(one.limit_c)}):
            axes.axhline(limit, color=plots.INK, linestyle="--", linewidth=0.8)
        axes.set_xlabel(plots.axis_label("time since it began", "min"))
        axes.set_ylabel(plots.axis_label("temperature", "°C"))
    plots.legend(axes, ncols=4)
    return figure
