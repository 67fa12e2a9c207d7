"""The worked pages of the docs, run anew: their commands, what these print, and their pictures.

    python benchmarks/worked_pages.py [so101|dynamixel|python] [--shared ../shared/realdata] [--work DIR]

Prints each command and its output as they stand in docs/so101.md and docs/dynamixel.md, and puts those pictures of
each fit's report into docs/pictures that the page shows: the held-out error, the moment where the given model is worst.
Of docs/python.md these are what examples/identify.ipynb prints and draws.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image
from real_recordings import SO101, TURNED_KG_M2

from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.tables import read_run

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOTEBOOK = DOCS.parent / "examples" / "identify.ipynb"
PAGES = {
    "so101": (
        "openant rec info runs/chirp_sweep",
        *(
            f"openant sysid fit runs/multisine runs/velocity_ramp --hold-out runs/chirp_sweep --model {joint}.xml "
            f"--joint {joint} --no-effects --out fit-{joint} --report report-{joint}"
            for joint in TURNED_KG_M2
        ),
    ),
    "dynamixel": (
        "openant rec info runs/kp400_sin_time_square",
        "openant servo gains --motor XL330-M288-T --supply 7.4 --position-p 400",
        "openant sysid fit runs/kp400_lift_and_drop runs/kp400_sin_sin --hold-out runs/kp400_sin_time_square "
        "--model runs/pendulum_kp400.xml --out fit --report report",
    ),
}
RECORDINGS = {"so101": "sage-so101", "dynamixel": "bam-xl330"}


def run_page(page: str, shared: Path, work: Path) -> None:
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(shared / RECORDINGS[page], work / "runs")
    if page == "so101":
        for joint, turned in TURNED_KG_M2.items():
            (work / f"{joint}.xml").write_text(SO101.format(joint=joint, turned=turned).strip() + "\n")
    for command in PAGES[page]:
        print(f"$ {command}", flush=True)
        begun = time.monotonic()
        subprocess.run([sys.executable, "-m", "openant_tools.cli", *shlex.split(command)[1:]], cwd=work, check=False)
        print(f"{time.monotonic() - begun:.0f} s", file=sys.stderr)
    if page == "so101":
        for joint in TURNED_KG_M2:
            print_by_frequency(work, joint)
    text = (DOCS / f"{page}.md").read_text()
    for report in sorted(work.glob("report*")):
        pictures = re.findall(r"\]\((figures/.*?\.png)\)", (report / "report.md").read_text())
        name = report.name.replace("report", page).lower().replace("_", "-")
        for picture, what in ((pictures[0], "worst"), (pictures[-1], "error")):  # first what a report begins with
            shown = f"pictures/{name}-{what}.png"
            if shown in text:
                save(report / picture, DOCS / shown)


def save(picture: Path, shown: Path) -> None:
    """Lines on white: 64 colours are enough, in a third of the bytes."""
    with Image.open(picture) as image:
        image.convert("RGB").quantize(64).save(shown, optimize=True)


def run_notebook(work: Path) -> None:
    matplotlib.use("Agg")
    work.mkdir(parents=True, exist_ok=True)
    place: dict[str, Any] = {}
    with contextlib.chdir(work):
        for cell in json.loads(NOTEBOOK.read_text())["cells"]:
            if cell["cell_type"] == "code":
                exec("".join(cell["source"]), place)
        place["figure"].savefig("judged.png", dpi=110)
    save(work / "judged.png", DOCS / "pictures" / "python-judged.png")


def print_by_frequency(work: Path, joint: str) -> None:
    """The chirp's error in 20 s each, by its mean frequency, as rows of a table."""
    run = read_run(work / "runs" / "chirp_sweep")
    parts = [slice(*np.searchsorted(run.t - run.t[0], (start, start + 20.0))) for start in range(0, 120, 20)]
    command = run.column(f"cmd.{joint}")
    turns = [np.count_nonzero(np.diff(np.sign(command[part] - command[part].mean()))) / 40.0 for part in parts]
    print(f"| {joint}, Hz | {' | '.join(f'{hertz:.2f}' for hertz in turns)} |")
    for words, model in (("given", f"{joint}.xml"), ("calibrated", f"fit-{joint}/calibrated.xml")):
        plant = load_plant(work / model, [joint])
        error = run.column(f"pos.{joint}") - Rollouts(plant, [run])().pos[0][:, 0]
        print(f"| {words}, mrad | {' | '.join(f'{1e3 * np.sqrt(np.mean(error[part] ** 2)):.1f}' for part in parts)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", metavar="so101|dynamixel|python")
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "realdata")
    parser.add_argument("--work", type=Path, default=Path("/tmp/worked_pages"))
    options = parser.parse_args()
    for page in options.pages or [*PAGES, "python"]:
        if page == "python":
            run_notebook(options.work / page)
        else:
            run_page(page, options.shared, options.work / page)


if __name__ == "__main__":
    main()
