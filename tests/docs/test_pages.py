"""What README and docs/ tell to type: each command is one, and a page's commands work, in their order, in one folder.

    make docs-check          also the blocks that are marked long (```sh long), and what they need

No robot is here: every command that can have a virtual one gets it, and what costs an hour is cut to a minute.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pytest
from places import ROOT
from plants import run_of

from openant_tools.cli import main
from openant_tools.cli import openant as table
from openant_tools.recording.tables import write_table
from openant_tools.robot.mjcf import nominal_model_path

PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
#: what a fence may say of a block of commands beside its language
MARKS = {
    "": "runs in CI",
    "long": "runs in `make docs-check`",
    "elsewhere": "needs hands, a real robot, or what others or other days have made",
}
#: option → the most of it that is run here, in its own unit; in the first minute, 1200 steps, SARSA does not learn yet
AMOUNTS = {
    "--steps": 1300, "--fine-tune-steps": 50, "--minutes": 1, "--trials": 2, "--seeds": 2, "--seconds": 12, "--robots": 2, "--soaks": 2, "--starts": 2,
}  # fmt: skip
PATIENCE_S = 1800.0


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    language: str
    mark: str
    text: str

    @property
    def commands(self) -> list[str]:
        """Its lines without comments, continued ones joined."""
        return [line for line in self.text.replace("\\\n", " ").splitlines() if line.strip() and line[0] != "#"]

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(page: str) -> list[Block]:
    text = (ROOT / page).read_text(encoding="utf-8")
    fences = re.finditer(r"^```(\w*) ?(.*)\n((?s:.*?))^```$", text, re.MULTILINE)
    return [Block(page, text.count("\n", 0, one.start()) + 1, one[1], one[2].strip(), one[3]) for one in fences]


def words_of(line: str) -> list[str]:
    """A line's words, without its comment and the variables that it sets."""
    words = shlex.split(line, comments=True)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    return words


def stands_for_some(word: str) -> bool:
    """Whether a word stands for something, such as `NAME` or `…`."""
    return re.fullmatch(r"[A-Z]+|…", word) is not None


def options_of(command: click.Command) -> dict[str, click.Option]:
    """A command's options by their names; of a group, those of all that it holds."""
    inside = command.commands.values() if isinstance(command, click.Group) else ()
    own = {
        name: one
        for one in command.params
        if isinstance(one, click.Option)
        for name in (*one.opts, *one.secondary_opts)
    }
    return own | {name: option for one in inside for name, option in options_of(one).items()}


def command_of(words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that the words after `openant` name, and what is left of them."""
    command: click.Command = table
    while isinstance(command, click.Group) and words and not words[0].startswith("-") and not stands_for_some(words[0]):
        found = command.get_command(click.Context(command), words[0])
        assert found is not None, f"no command {words[0]!r}"
        command, words = found, words[1:]
    return command, words


# ---- every command is one ----


@pytest.mark.parametrize("page", PAGES)
def test_every_block_says_what_it_holds(page: str) -> None:
    for block in blocks(page):
        assert block.language in {"sh", "python", "toml", "json", "xml", "mermaid", "text"}, (
            f"{block}: {block.language!r}"
        )
        assert block.mark in MARKS or (block.language != "sh" and re.fullmatch(r"[-.\w]+", block.mark)), block
        if block.language == "python":
            ast.parse(block.text)


@pytest.mark.parametrize("page", PAGES)
def test_every_command_in_a_block_is_one(page: str) -> None:
    for block in blocks(page):
        if block.language == "sh" and not block.text.startswith("cat > "):
            for line in block.commands:
                check_line(f"{block}: {line}", words_of(line))


def check_line(where: str, words: list[str]) -> None:
    match words:
        case ["openant", *rest]:
            command, rest = command_of(rest)
            if isinstance(command, click.Group):
                assert command is table, f"{where}: {command.name} wants a command"
                return  # `openant` alone, with or without options, is the terminal program
            try:
                command.make_context(command.name, rest)
            except click.UsageError as error:
                pytest.fail(f"{where}\n{error.format_message()}")
        case ["make", *targets]:
            makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
            for target in targets:
                assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE), f"{where}: no target {target}"
        case ["python", "-m", module, *_] if module.startswith("openant"):
            assert (ROOT / (module.replace(".", "/") + ".py")).is_file() or (ROOT / module).is_dir(), where
        case ["python", file, *_] if file.endswith(".py"):
            assert (ROOT / file).is_file(), f"{where}: no file {file}"
        case ["pip", "install", *what]:
            extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
                "optional-dependencies"
            ]
            for one in what:
                if named := re.fullmatch(r"(?:\.|openant-tools)\[(.*)\]", one):
                    assert set(named[1].split(",")) <= set(extras), where


@pytest.mark.parametrize("page", PAGES)
def test_every_command_in_a_sentence_is_one(page: str) -> None:
    """Its arguments may be left out or stand for something (`RUN`, `…`), its options and their choices may not be wrong."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for span in re.findall(r"`((?:openant|make|python|pip) [^`]+)`", text):
        where, words = f"{page}: {span}", words_of(" ".join(span.split()))
        if words[0] != "openant":
            check_line(where, words)
            continue
        command, rest = command_of(words[1:])
        options = options_of(command)
        for at, word in enumerate(rest):
            if not word.startswith("--"):
                continue
            name, _, value = word.partition("=")
            assert name in options, f"{where}: no option {name}"
            kind, following = options[name].type, value or (rest[at + 1] if at + 1 < len(rest) else "")
            if isinstance(kind, click.Choice) and re.fullmatch(r"[a-z0-9-]+", following) and following[0] != "-":
                assert following in kind.choices, f"{where}: {name} is one of {', '.join(kind.choices)}"


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page: str) -> None:
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s:]+)\)", text):
        name, _, anchor = link.partition("#")
        there = (ROOT / page).parent / name if name else ROOT / page
        assert there.exists(), f"{page}: {link}"
        if anchor:
            assert anchor in anchors(there), f"{page}: {link}"


#: lines of Markdown that a browser shows at once, about
SCREEN = 60


@pytest.mark.parametrize("page", PAGES[1:])
def test_a_page_fits_a_screen_before_its_reference(page: str) -> None:
    shown = (ROOT / page).read_text(encoding="utf-8").partition("\n## Reference\n")[0]
    assert shown.count("\n") <= SCREEN, f"{page}: its first part has {shown.count(chr(10))} lines"


def anchors(page: Path) -> set[str]:
    """The addresses of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


# ---- every command works ----

#: recordings that pages speak of, all of them copies of one
RECORDINGS = (
    "my-ant/recordings/a.mcap", "my-ant/recordings/a-held-out.mcap", "my-ant/recordings/b.mcap", "my-ant/recordings/stand.mcap",
    "my-ant/recordings/walk.mcap", "a.mcap", "b.mcap", "c.mcap", "walk.mcap", "stand-1.mcap", "stand-2.mcap", "floor-1.mcap",
    "floor-2.mcap", "soak.mcap", "bare.mcap", "finned.mcap", "at-1M.mcap", "at-500k.mcap",
)  # fmt: skip


@pytest.fixture(scope="session")
def thorough(pytestconfig: pytest.Config) -> bool:
    return bool(pytestconfig.getoption("--long", default=False))


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory, thorough: bool) -> Path:
    """A folder as the pages have it: my-ant with recordings, tables of a bench; for the long blocks also runs and fits."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "docs").mkdir()
    (folder / "grams.csv").write_text("deflection,grams\n0.02,95\n0.04,190\n0.06,287\n0.08,380\n")
    run("config new --kit standard --robot my-ant", folder)
    run("config export --robot my-ant --out ant12.json", folder)
    if thorough:
        run("sysid record --protocol stand --seconds 8 --robot my-ant --out one.mcap", folder)
        shutil.copy(nominal_model_path("standard"), folder / "my-ant" / "calibrated.xml")
        run("sysid record --protocol stand --seconds 8 --seed 1 --robot my-ant --out floor-2.mcap", folder)
        for name in ("sac-1", "sac-2"):
            run(f"train sac --robot my-ant --steps 100 --out my-ant/runs/{name}", folder)  # the first point of a curve
        run("thermal soak --robot my-ant --minutes 1 --out bare.mcap", folder)
        shutil.copy(folder / "bare.mcap", folder / "finned.mcap")
    else:
        t = np.arange(0.0, 4.0, 0.01)
        write_table(
            run_of({"cmd.knee_fl": np.sin(t), "pos.knee_fl": np.sin(t - 0.02)}, t, ["knee_fl"]), folder / "one.csv"
        )
        run("rec import one.csv --out one.mcap", folder)
    for name in RECORDINGS:
        if not (folder / name).exists():
            shutil.copy(folder / "one.mcap", folder / name)
    return folder


def runs(block: Block, thorough: bool) -> bool:
    return block.language == "sh" and (block.mark == "" or (block.mark == "long" and thorough))


@pytest.mark.timeout(3 * PATIENCE_S)
@pytest.mark.parametrize("page", [page for page in PAGES if "openant " in "".join(one.text for one in blocks(page))])
def test_the_commands_of_a_page_work_in_their_order(
    page: str, thorough: bool, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    if not any(runs(block, thorough) for block in blocks(page)):
        pytest.skip("all of it takes long: make docs-check")
    prepared = request.getfixturevalue("prepared")
    folder = Path(shutil.copytree(prepared, tmp_path / "here"))
    shutil.copy(ROOT / page, folder / page)
    lines = [line for block in blocks(page) if runs(block, thorough) for line in block.commands]
    if any("config new" in line for line in lines):  # it begins without a robot
        shutil.rmtree(folder / "my-ant")
    for name in (name for line in lines for name in re.findall(r"--out (\S+)", line)):  # which the page makes
        made = folder / name
        shutil.rmtree(made) if made.is_dir() else made.unlink(missing_ok=True)
        made.with_name(f"{made.stem}-held-out{made.suffix}").unlink(missing_ok=True)
    for block in blocks(page):
        if block.language == "sh" and block.text.startswith("cat > "):
            subprocess.run(["bash", "-c", block.text], cwd=folder, check=True)
        elif runs(block, thorough):
            for line in block.commands:
                match words_of(line):
                    case ["openant", *rest] if rest and not rest[0].startswith("-"):
                        run(line.partition("openant ")[2], folder, line)
        elif "." in block.mark:
            (folder / block.mark).write_text(block.text)


def run(command: str, folder: Path, line: str = "") -> None:
    """Run what stands after `openant` in a folder, as `fit_for_here` has it; it may find fault (1), but not fail."""
    words = fit_for_here([name for word in shlex.split(command, comments=True) for name in unfolded(word, folder)])
    variables = dict(re.findall(r"([A-Z_]+)=(\S+) ", line.partition("openant ")[0]))
    if {"--virtual", "--until-eof"} & set(words):
        done = subprocess.run(
            [sys.executable, "-m", "openant_tools", *words], cwd=folder, text=True, capture_output=True, timeout=PATIENCE_S,
            stdin=subprocess.DEVNULL, env=os.environ | variables | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        code, said = done.returncode, done.stdout + done.stderr
    else:  # in this process: what is imported once need not be imported anew
        out = io.StringIO()
        with (
            contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(out),
            pytest.raises(SystemExit) as end,
        ):  # fmt: skip
            main(words)
        code, said = int(end.value.code or 0), out.getvalue()
    print(f"$ openant {shlex.join(words)}\n{said}")
    assert code in (0, 1), f"{line or command}\n{said[-3000:]}"


def unfolded(word: str, folder: Path) -> list[str]:
    """A word as the shell hands it on: `*` stands for the files that there are."""
    return sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if "*" in word else [word]


def fit_for_here(words: list[str]) -> list[str]:
    """The command on a virtual robot, asking nobody, cut short."""
    command, _ = command_of(words)
    options = options_of(command)
    simulated = bool({"--readings", "--static"} & set(words)) or ("--env" in options and "hardware" not in words)
    for option in ("--virtual", "--yes", "--until-eof"):
        if option == "--virtual" and (simulated or option not in options or options[option].name != "virtual_source"):
            continue  # nothing is asked of a robot
        if option in options and option not in words:
            words = [*words, option]
    if "--virtual" in words and "--port" in words:  # which the virtual robot has of its own
        at = words.index("--port")
        words = [*words[:at], *words[at + 2 :]]
    if words[:2] == ["rec", "view"] and "--out" not in words:  # here is no screen to open a window on
        words = [*words, "--out", "view.rrd"]
    if words[0] == "train" and "--steps" in options and "--steps" not in words:  # an hour
        words = [*words, "--steps", "1300"]
    if words[:2] == ["comms", "watch"]:  # until Ctrl-C
        words = [*words, "--seconds", "2"]
    for option, most in AMOUNTS.items():
        if option in words:
            at = words.index(option) + 1
            words = [*words[:at], f"{min(float(words[at]), most):g}", *words[at + 1 :]]
    return words
