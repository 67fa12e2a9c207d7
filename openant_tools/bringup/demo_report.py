"""The demo's report: what was found in the recordings against what is true of the virtual robot, and what was learned."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.bringup.demo import Demo
from openant_tools.bringup.gait import walks, walks_at
from openant_tools.bringup.robot_picture import robot_picture
from openant_tools.bringup.tracking import Moment, draw_moment, worst_moment
from openant_tools.files import write_bytes
from openant_tools.numbers import number, percent, span
from openant_tools.recording.tables import read_run
from openant_tools.report import Figure, KeyFigure, Mark, Picture, Report, ReportSummary, Table, Text, plots
from openant_tools.report.parts import Tone
from openant_tools.robot.registers import PWM_FULL
from openant_tools.sysid.kinds import said
from openant_tools.virtual.scenario import load_scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["Recovered", "compare", "gap_words", "speed", "spread", "truth", "write_report"]

Array = NDArray[np.float64]

#: kind of parameter → its name and unit on an axis, and what is shown: value × this, or None for value / data sheet
KINDS: Mapping[str, tuple[str, str, float | None]] = {
    "stiffness": ("stiffness", "1", None),
    "damping": ("damping", "1", None),
    "armature": ("rotor inertia", "1", None),
    "coulomb_friction": ("friction", "1", None),
    "zero_offset": ("zero", "°", math.degrees(1)),
    "action_delay": ("delay", "ms", 1e3),
}


@dataclass(frozen=True)
class Recovered:
    """One parameter of the fit beside the truth.

    Attributes:
        name: as in fit.json.
        given, truth, value, low, high: in `unit`.
        verdict: of the fit.
    """

    name: str
    unit: str
    given: float
    truth: float
    value: float
    low: float | None
    high: float | None
    verdict: str

    @property
    def kind(self) -> str:
        return self.name.partition(".")[0]

    @property
    def joint(self) -> str:
        return self.name.partition(".")[2]

    @property
    def determined(self) -> bool:
        """Whether the fit claims to know it."""
        return self.verdict in ("identified", "weak", "conflict")

    @property
    def inside(self) -> bool:
        """Whether the truth lies in the interval."""
        return self.low is not None and self.high is not None and self.low <= self.truth <= self.high


def truth(scenario: Path) -> dict[str, float]:
    """What a perfect fit would find of the virtual robot: parameter as in fit.json → value in SI units.

    stiffness = P / divisor / 885 · τ_stall · scale; damping = kt·ke/R + what the gear adds; armature, friction and zero
    as they are set. The firmware cuts its PWM to whole counts towards zero, half a count on average, which costs the
    torque τ_stall / 885 / 2 and acts like that much more friction.

    Raises:
        BadInput: the scenario cannot be read.
    """
    world = load_scenario(scenario).world
    values: dict[str, float] = {}
    for servo in world.servos:
        motor = servo.motor
        assert motor is not None
        stall = motor.kt * world.supply.volts / motor.resistance
        gain = servo.registers.get("position_p_gain")
        scale = motor.stiffness_scale * motor.strength
        values[f"stiffness.{servo.joint}"] = servo.model.stiffness_nm_rad(gain, world.supply.volts) * scale
        values[f"damping.{servo.joint}"] = motor.kt * motor.ke / motor.resistance + motor.viscous
        values[f"armature.{servo.joint}"] = motor.armature
        values[f"coulomb_friction.{servo.joint}"] = motor.coulomb_nm + stall / PWM_FULL / 2
        values[f"zero_offset.{servo.joint}"] = servo.zero_error_rad
        values[f"action_delay.{servo.joint}"] = motor.action_delay_s
    return values


def compare(fit: Mapping[str, Any], true: Mapping[str, float]) -> list[Recovered]:
    """Every parameter of a fit.json that the truth knows."""
    return [
        Recovered(
            name, found["unit"], found["given"], true[name], found["value"], found["low"], found["high"],
            found["verdict"],
        )
        for name, found in fit["parameters"].items()
        if name in true
    ]  # fmt: skip


def write_report(demo: Demo) -> dict[str, Any]:
    """Write report.html and the pictures; returns the key figures, as for `--json`."""
    fit = json.loads((demo.fit / "fit.json").read_text(encoding="utf-8"))
    rows = compare(fit, truth(demo.scenario))
    run = read_run(demo.held_out[0])
    moment = worst_moment(run, demo.nominal, demo.fit / "calibrated.xml")
    curve = _curve(demo.training / "learning_curve.csv") if demo.learns else None
    walking = _walking(demo) if demo.learns else None
    picture, drawn_by = robot_picture(demo.fit / "calibrated.xml")

    before, after = fit["held_out"]["before"], fit["held_out"]["after"]
    floor = fit["held_out"]["floor_rad"]
    claimed = [row for row in rows if row.determined]
    inside = sum(row.inside for row in claimed)
    figures: dict[str, Any] = {
        "gap_before_rad": before["gap_full_rad"],
        "gap_after_rad": after["gap_full_rad"],
        "floor_rad": floor,
        "settings_determined": len(claimed),
        "settings_within_interval": inside,
        "average_reward_m_s": None if walking is None else walking["average_reward_m_s"],
        "walking": None
        if walking is None
        else {key: walking[key] for key in ("starts", "seconds", "sampled", "likeliest")},
    }

    keys = [
        KeyFigure(
            "held-out error",
            f"{gap_words(before['gap_full_rad']).removesuffix(' mrad')} → {gap_words(after['gap_full_rad'])}",
            f"data sheets → calibrated, over a motion of {number(run.duration_s, decimals=0)} s that the fit did not see",
            "good" if after["gap_full_rad"] < before["gap_full_rad"] else "bad",
        ),
        KeyFigure("floor", gap_words(floor), "what no model could beat: two plays of one motion differ by it"),
        KeyFigure(
            "settings recovered",
            f"{inside} of {len(claimed)}",
            "true value inside the 95 % interval",
            "good" if inside >= 0.9 * len(claimed) else "warn",
        ),
    ]
    if walking is not None:
        keys.append(
            KeyFigure(
                "walks at" if walks(walking["sampled"]["median"]) else "does not walk yet",
                speed(walking),
                f"{_minutes(curve)}; {spread(walking)}",
            )
        )
    ratio = after["gap_full_rad"] / before["gap_full_rad"]
    overview = _keep(demo, "overview", _overview_figure(picture, demo.strip, moment, curve, walking))
    answer = ReportSummary(
        f"The calibrated simulation leaves {percent(ratio)} of the data sheets' error"
        + ("." if walking is None else f", and in it the robot {walks_at(walking['sampled']['median'])}."),
        Figure(
            overview,
            f"The robot; the held-out motion around the moment at which the data sheets' model is worst, {moment.joint}"
            + ("." if walking is None else "; and what it learned."),
        ),
        "What is wrong with this robot was found from its recordings alone: so would what is wrong with yours.",
        "Begin with your own robot, `openant`; or play with this one: `openant --virtual`.",
        "good" if ratio < 1 else "bad",
        keys,
    )
    report = Report(
        "A virtual Open Ant, calibrated", _subtitle(demo), answer, made_by=f"openant demo --robot {demo.folder}",
        recordings=[demo.fitted, *demo.held_out],
    )  # fmt: skip
    if picture is not None:
        write_bytes(demo.pictures / "robot.png", picture)
    else:
        report.section("Picture").text(drawn_by)
    _keep(demo, "gap", _gap_figure(moment))
    report.section("What was found, and what is true").figure(
        _keep(demo, "settings", _settings_figure(rows)),
        "Every setting of the virtual robot, relative to its data sheet: what is true, and the fit's 95 % interval.",
    )
    columns = ["parameter", "data sheet", "true", "found", "95 % interval", "inside"]
    report.details("All values", Table(columns, [_row(row) for row in rows]), Text(_explained(rows)))
    if curve is not None:
        assert walking is not None
        report.section("Learning", open=True)
        if demo.video.exists() and demo.strip.exists():
            report.add(
                Picture(
                    demo.video,
                    "What it learned: the start whose reward was the median, as sampled, in real time. The circle is the task's, "
                    "the arrow the direction that is rewarded.",
                    "The robot walking across its circle",
                    still=demo.strip,
                )
            )
            report.picture(demo.strip, "The same in eight pictures.", "The robot walking, in eight pictures")
        else:
            report.text("There are no pictures of the walk: this machine has no OpenGL to draw them with.")
        report.figure(
            _keep(demo, "learning", _learning_figure(curve, walking)),
            "Average reward of the last 120 s while it trained, in the simulation that was calibrated; and what it achieved "
            f"afterwards from {walking['starts']} starts (median, lowest to highest). The curve looks back two minutes, in which "
            "it was still learning.",
        )
        report.text(_stood_still(walking))
    report.section("The same by hand").code("\n".join(line for stage in demo.stages() for line in stage.command_lines))
    report.write(demo.report)
    return figures


def _keep(demo: Demo, name: str, figure: MatplotlibFigure) -> MatplotlibFigure:
    """The same figure, also as a PNG among the demo's pictures."""
    write_bytes(demo.pictures / f"{name}.png", plots.as_png(figure))
    return figure


def _subtitle(demo: Demo) -> str:
    return (
        "Recorded through its bus, identified, and trained on in simulation. "
        f"What is wrong with it stands in {demo.scenario.name}, which the fit has not seen."
    )


def _minutes(curve: Array | None) -> str:
    return (
        "" if curve is None or not len(curve) else f"after {number(curve[-1, 1] / 60, decimals=0)} minutes of its time"
    )


# ---- figures ----


def _gap_figure(moment: Moment) -> MatplotlibFigure:
    figure: MatplotlibFigure
    figure, (above, below) = plots.figure(2, 1, height=2.2, sharex=True)
    draw_moment(above, below, moment)
    return figure


def _learning_figure(curve: Array, walking: Mapping[str, Any]) -> MatplotlibFigure:
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=2.6)
    _draw_learning(axes, curve, walking)
    plots.legend(axes)
    return figure


def _draw_learning(axes: Any, curve: Array, walking: Mapping[str, Any]) -> None:
    with plots.style():
        axes.axhline(0, color=plots.INK, linewidth=0.6)
        axes.plot(curve[:, 1] / 60, 100 * curve[:, 2], color=plots.BLUE, label="while it trained, sampled")
        end = curve[-1, 1] / 60 if len(curve) else 0.0
        for k, (way, colour, marker) in enumerate((("sampled", plots.BLUE, "o"), ("likeliest", plots.VERMILLION, "s"))):
            median, low, high = (100 * walking[way][key] for key in ("median", "low", "high"))
            axes.errorbar(
                [1.02 * end + 0.02 * end * k], [median], [[median - low], [high - median]], color=colour, marker=marker,
                markersize=5, label=f"afterwards, {way}",
            )  # fmt: skip
        axes.set_xlabel(plots.axis_label("robot time", "min"))
        axes.set_ylabel(plots.axis_label("average reward", "cm/s"))


def _settings_figure(rows: Sequence[Recovered]) -> MatplotlibFigure:
    """A panel a kind, a line a joint: the interval of the fit, and the truth."""
    figure: MatplotlibFigure
    kinds = [kind for kind in KINDS if any(row.kind == kind for row in rows)]
    figure, panels = plots.figure(1, len(kinds), height=3.0, sharey=True, squeeze=False)
    joints = list(dict.fromkeys(row.joint for row in rows))
    for axes, kind in zip(panels[0], kinds, strict=True):
        words, unit, factor = KINDS[kind]
        with plots.style():
            for row in (row for row in rows if row.kind == kind):
                scale = 1 / row.given if factor is None else factor
                y = joints.index(row.joint)
                colour = plots.BLUE if row.determined else plots.SKY
                if row.low is not None and row.high is not None:
                    axes.plot([scale * row.low, scale * row.high], [y, y], color=colour, linewidth=5, alpha=0.45,
                              solid_capstyle="butt", label="found, 95 %" if y == 0 else None)  # fmt: skip
                axes.plot(scale * row.value, y, "|", color=colour, markersize=9)
                axes.plot(
                    scale * row.truth, y, "x", color=plots.VERMILLION, markersize=6, label="true" if y == 0 else None
                )
            axes.axvline(1 if factor is None else 0, color=plots.INK, linewidth=0.8, linestyle=":",
                         label="data sheet")  # fmt: skip
            axes.set_yticks(range(len(joints)), joints)
            axes.set_xlabel(plots.axis_label(words, unit))
    with plots.style():
        figure.legend(*panels[0][-1].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    panels[0][0].invert_yaxis()
    return figure


def _overview_figure(
    picture: bytes | None, strip: Path, moment: Moment, curve: Array | None, walking: Mapping[str, Any] | None
) -> MatplotlibFigure:
    """The demo in one picture: the robot, measured against simulated, learning and walking."""
    from matplotlib.figure import Figure as Canvas
    from matplotlib.image import imread

    figure = Canvas(figsize=(plots.WIDTH, 4.6))
    with plots.style():
        figure.set_layout_engine("constrained")
        left, right = np.ravel(np.asarray(figure.subfigures(1, 2, width_ratios=(1.0, 1.35))))
        if curve is None or walking is None:
            axes = [left.subplots()]
        else:
            axes = list(
                left.subplots(
                    3 if strip.exists() else 2, 1, height_ratios=(1.2, 1.3, 1.0)[-3 if strip.exists() else -2 :]
                )
            )
            _draw_learning(axes[-1], curve, walking)
            axes[-1].set_title("… what it learned in its simulation")
            if strip.exists():
                axes[1].imshow(imread(strip))
                axes[1].axis("off")
        axes[0].axis("off")
        if picture is not None:
            axes[0].imshow(imread(io.BytesIO(picture)))
        above, below = right.subplots(2, 1, sharex=True)
    draw_moment(above, below, moment, "A motion it was not fitted to")
    return figure


def _curve(path: Path) -> Array:
    """(points, 3): step, seconds, average reward in m/s."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = [
            (float(row["step"]), float(row["seconds"]), float(row["average_reward_m_s"]))
            for row in csv.DictReader(stream)
        ]
    return np.array(rows).reshape(-1, 3)


def _walking(demo: Demo) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads((demo.training / "eval.json").read_text(encoding="utf-8"))
    return answer


def speed(walking: Mapping[str, Any]) -> str:
    """How fast it walks as it trained, in a word; every figure of the demo that says it is this one."""
    return f"{_cm_s(walking['sampled']['median'])} cm/s"


def _cm_s(reward_m_s: float) -> str:
    return number(100 * reward_m_s, decimals=1)


def gap_words(gap_rad: float) -> str:
    """An error of position as every page of the demo says it."""
    return number(gap_rad, "rad", name="gap")


def spread(walking: Mapping[str, Any]) -> str:
    """Of how many starts that is the median, how far they lie apart, and what its likeliest action does."""
    sampled, likeliest, starts = walking["sampled"], walking["likeliest"], walking["starts"]
    words = (
        f"sampled, median of {starts} starts, {_cm_s(sampled['low'])} to {_cm_s(sampled['high'])}; "
        f"likeliest action {_cm_s(likeliest['median'])} cm/s"
    )
    if likeliest["stood_still"]:
        words += f", which stood still for good in {likeliest['stood_still']} of {starts}"
    return words


def _stood_still(walking: Mapping[str, Any]) -> str:
    words = "**Sampled**: actions are drawn by chance as in training. **Likeliest**: the mean of what chance would draw from. "
    if walking["likeliest"]["stood_still"]:
        return words + (
            f"From {walking['likeliest']['stood_still']} of {walking['starts']} starts the likeliest action held a pose whose "
            "likeliest action is that pose, for ever; chance takes the robot out of there. Longer training brings the gait from "
            "chance into the mean."
        )
    return words + "Neither stood still for good from any start."


# ---- the table ----


def _row(row: Recovered) -> Sequence[object]:
    tone: Tone = "good" if row.inside else "bad"
    mark = Mark("yes" if row.inside else "no", tone) if row.determined else Mark(row.verdict)
    numbers = (row.given, row.truth, row.value)
    return [said(row.name), *(number(value, row.unit) for value in numbers), span(row.low, row.high, row.unit), mark]


def _explained(rows: Sequence[Recovered]) -> str:
    words = "Friction is the gear's and what the firmware's cutting of its PWM to whole counts adds, half a count on average."
    open_ = [said(row.name) for row in rows if not row.determined]
    if open_:
        words += (
            "\n\nNot to be told from these recordings, and left as they were: "
            + ", ".join(open_)
            + ". On a level stand a hip's axis is vertical: its command and its encoder shift alike when its zero does."
        )
    return words
