"""Reports: one file that opens anywhere, says what it says in words too, and never fetches a thing."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.report import Details, Figure, KeyFigure, KeyFigures, Mark, Report, ReportSummary, Table, Text, plots

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Checks that every tag is closed, and collects ids, links, texts and what would be loaded."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.texts: list[str] = []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value or "")
            if name == "href":
                self.links.append(value or "")
            if name in ("src", "srcset", "data"):
                self.sources.append(value or "")

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def a_figure(points: int = 50) -> Any:
    t = np.linspace(0.0, 10.0, points)
    with plots.style():
        figure, axes = plots.figure(rows=2, sharex=True)
        for axis, signal in zip(axes, ("pos", "vel"), strict=True):
            axis.plot(t, np.sin(t * 7), label="measured")
            axis.set_ylabel(plots.signal_label(signal))
            plots.legend(axis)
        axes[-1].set_xlabel(plots.signal_label("t"))
    return figure


def test_a_legend_hides_no_title() -> None:
    figure, axes = plots.figure(2, 1, height=1.4)
    with plots.style():
        for axis in axes:
            for name in ("read", "95 %", "50 %", "median", "limit"):
                axis.plot([0, 1], [0, 1], label=name)
            axis.set_title("hip_rl stays below 80 °C, whatever else is done, and settles at 34 ± 6 °C")
    plots.legend(axes[0])
    figure.draw_without_rendering()
    [legend] = figure.legends
    boxes = [axis.title.get_window_extent() for axis in axes] + [axis._left_title.get_window_extent() for axis in axes]
    assert not any(legend.get_window_extent().overlaps(box) for box in boxes if box.width > 0)


def test_a_motion_with_a_title_has_one_legend_which_leaves_it_free() -> None:
    figure, (above, below) = plots.figure(2, 1, height=1.4)
    t = np.linspace(0.0, 1.0, 9)
    plots.draw_tracking(
        above, below, "hip_rl", t, t, t, t, t, title="a run with a name as long as those of held-out recordings"
    )
    figure.draw_without_rendering()
    [legend] = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    assert not legend.get_window_extent().overlaps(above._left_title.get_window_extent())


def a_report() -> Report:
    return (
        Report(
            "Fit of ant12 & friends",
            "3 runs, `calibrated.xml`",
            ReportSummary(
                "It leaves 12 % of the error.",
                Figure(a_figure(), "The worst moment."),
                "Of *use*.",
                "Train.",
                "good",
                [KeyFigure("position gap", "0.021 rad", "0.083 rad before", "good")],
            ),
            made_by="openant sysid fit run.mcap",
        )
        .section("Result")
        .text("It **beats** the given model <everywhere>.\n\n- one\n- two\n  goes on")
        .table(["name", "value (N·m)"], [["a|b", 1.5], [Mark("rejected", "bad"), None]], "Parameters")
        .section("Pictures")
        .figure(a_figure(), "Measured against simulated.")
        .figure(a_figure(), "The same again.")
        .details("More", Text("inside"), Figure(a_figure(), "Folded."))
        .code("openant gap measure run.mcap")
    )


def test_a_report_opens_offline_and_is_sound(tmp_path: Path) -> None:
    path = a_report().write(tmp_path / "report.html")
    html = path.read_text(encoding="utf-8")
    page = Page(html)
    assert len(page.ids) == len(set(page.ids))
    assert all(source.startswith("data:") for source in page.sources)
    for link in page.links:
        assert link.startswith("#")
        assert link[1:] in page.ids
    for reference in re.findall(r"url\(#([^)]+)\)", html):
        assert reference in page.ids
    # XML name spaces are names, not addresses.
    assert "http:" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", html)
    assert "https:" not in html
    assert "default-src 'none'" in html
    assert "It" in page.texts or any("beats" in text for text in page.texts)
    assert "&lt;everywhere&gt;" in html
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_it_begins_with_its_answer_folds_the_rest_and_links_its_recording(tmp_path: Path) -> None:
    (tmp_path / "my runs").mkdir()
    recording = tmp_path / "my runs" / "run 1.mcap"
    recording.touch()
    report = a_report()
    report.recordings = [recording, tmp_path / "gone.mcap"]
    html = report.write(tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    order = ["<h1>", "It leaves 12", "The worst moment.", "position gap", "What it means", "What to do next",
             "<details><summary><h2>Result</h2>", "Made from", "openant sysid fit run.mcap"]  # fmt: skip
    assert [html.index(words) for words in order] == sorted(html.index(words) for words in order)
    assert "Of <em>use</em>." in html
    assert '<a href="./../my%20runs/run%201.mcap">run 1.mcap</a>, gone.mcap' in html


def test_figures_follow_the_pages_ink_and_say_what_they_show() -> None:
    html = a_report().html()
    svg = html[html.index("<svg ") : html.index("</svg>")]
    assert 'aria-label="The worst moment."' in svg
    assert "currentColor" in svg
    assert plots.INK not in svg
    assert "position (°)" in svg
    assert "velocity (°/s)" in svg
    assert "time (s)" in svg


def test_a_plot_of_very_many_points_becomes_pixels() -> None:
    rng = np.random.default_rng(0)
    with plots.style():
        figure, axes = plots.figure()
        axes.scatter(*rng.normal(size=(2, 4_000)), s=rng.uniform(1, 5, 4_000))
    html = Figure(figure, "A cloud.").html("f1")
    assert "<svg" not in html
    assert "data:image/png;base64," in html


def test_twins_in_markdown_and_json(tmp_path: Path) -> None:
    a_report().write_folder(tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert text.startswith("# Fit of ant12 & friends\n")
    assert "| a\\|b | 1.50 |" in text
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert len(pictures) == 4
    assert all((tmp_path / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["verdict"] == "It leaves 12 % of the error."
    assert data["answer"][2]["figures"][0]["value"] == "0.021 rad"
    assert data["sections"][0]["parts"][1]["rows"] == [["a|b", 1.5], [{"text": "rejected", "tone": "bad"}, None]]


@settings(max_examples=60)
@given(st.text(max_size=60), st.text(max_size=60))
def test_no_text_can_break_the_page(words: str, cell: str) -> None:
    report = (
        Report(words, words, ReportSummary(words, None, words, words))
        .section(words)
        .text(words)
        .table([cell], [[cell], [Mark(cell, "warn")]], words)
    )
    report.add(KeyFigures([KeyFigure(words, cell, words)])).add(Details(words, [Table([words], [[cell]])])).code(cell)
    Page(report.html())


def test_links_go_where_they_say_and_nothing_else_runs() -> None:
    html = Text("[manual](https://example.org/a) [here](#s1) [bad](javascript:alert(1))").html("t")
    assert html.count("<a ") == 2
    assert "javascript:alert" not in re.sub(r"\[bad\]\(.*", "", html)


def test_numbers_stand_to_the_right_and_missing_ones_are_a_dash() -> None:
    html = Table(["n", "word"], [[np.float64(-0.123456), "a"], [float("nan"), "b"], [12, True]]).html("t")
    assert "<td class=num><span class=short>−0.123</span></td>" in html
    assert "<td class=num><span class=short>–</span></td>" in html
    assert "<td>yes</td>" in html


def test_what_a_table_shows_stands_beside_it_and_is_not_scrolled_with_it() -> None:
    html = Table(["n"], [[1]], "How many.").html("t")
    assert html.startswith('<p class=caption id="t-caption">How many.</p><div class=scroll>')
    assert '<table aria-labelledby="t-caption">' in html


def test_colours_are_told_apart_and_words_carry_the_tone_too() -> None:
    assert len(set(plots.CYCLE)) == 7
    assert '<span class="mark bad">' in Table(["v"], [[Mark("no", "bad")]]).html("t")


@pytest.mark.parametrize(
    ("signal", "label"),
    [
        ("pos", "position (°)"),
        ("gyro.z", "turn rate z (°/s)"),
        ("base.yaw", "heading (°)"),
        ("pwm", "duty (–)"),
        ("temp", "temperature (°C)"),
    ],
)
def test_axes_have_names_and_units(signal: str, label: str) -> None:
    assert plots.signal_label(signal) == label


def test_a_full_disk_leaves_the_old_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = a_report().write(tmp_path / "report.html")
    before = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        Report("New", "", ReportSummary("No.", None, "", "")).write(path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1
