"""Attacks on the toolkit, how often each was tried, and how often it was withstood: makes docs/reliability.md.

    python benchmarks/reliability.py [--only PART] [--scale 1.0] [--anew] [--write]

Each part is a `reliability_PART.py` beside this file. Results are kept in `reliability.json` after every row, and further
runs add to them (`--anew`: begin the rows that are run at zero). `--write` makes the page from what is kept. Exit code 1
where a row is not whole.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RESULTS = HERE / "reliability.json"
PAGE = HERE.parent / "docs" / "reliability.md"
PARTS = {
    "bus": "The bus: to which question an answer belongs",
    "door": "Torque: who switches it off when somebody is killed",
    "goeson": "Motion: full disks, and messages that make no sense",
    "state": "Servos as other software left them",
    "silence": "Servos that do not answer: the cause is named",
    "sensors": "Camera, IMU and verdicts",
    "files": "Files, folders and processes",
}
#: what `fuzz_readers.py --write` keeps beside the parts
SPOILT = "spoilt"
TITLES = {**PARTS, SPOILT: "Files, spoilt a great many times: read, or refused in one line"}


def run(part: str, scale: float, anew: bool, results: dict[str, Any]) -> None:
    """Try every row of a part, and keep each as it is done."""
    rows = results.setdefault(part, {})
    for campaign in importlib.import_module(f"reliability_{part}").campaigns():
        row = {"tries": 0, "survived": 0} if anew else rows.get(campaign.attack, {"tries": 0, "survived": 0})
        first, began = row["tries"], time.monotonic()
        failed = []
        for k in range(first, first + max(1, round(campaign.tries * scale))):
            survived = campaign.run(k)
            row["tries"], row["survived"] = row["tries"] + 1, row["survived"] + survived
            if not survived:
                failed.append(k)
        rows[campaign.attack] = row
        RESULTS.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(
            f"{part}: {row['survived']} of {row['tries']}  {campaign.attack}  ({time.monotonic() - began:.0f} s"
            + (f", not survived: {failed}" if failed else "")
            + ")",
            flush=True,
        )


def page(results: dict[str, Any]) -> str:
    """The table as Markdown."""
    lines = [
        "# How it withstands attacks",
        "",
        "<!-- made by `python benchmarks/reliability.py --write` -->",
        "Each attack is made again and again on the virtual robot, on fake servos or on files; `python benchmarks/reliability.py`",
        "makes more tries and adds them. What happens on a fault, one by one, stands in [the bus](comms.md#what-stops-a-motion).",
        "",
        "| what is attacked | attacks | tries | survived |",
        "|---|---|---|---|",
    ]
    for part, title in TITLES.items():
        counts = [(row["tries"], row["survived"]) for row in results.get(part, {}).values()]
        if counts:
            tries, survived = map(sum, zip(*counts, strict=True))
            lines.append(f"| {title} | {len(counts)} | {tries} | {survived} |")
    lines += ["", "## Reference"]
    for part, title in TITLES.items():
        rows = results.get(part, {})
        if not rows:
            continue
        lines += ["", f"### {title}", ""]
        if part == SPOILT:
            lines += [
                "Two scenarios and two blind verdicts were not survived at first: mended, and those files tried again.",
                "",
            ]
        lines += ["| attack, and what counts as withstood | tries | survived |", "|---|---|---|"]
        lines += [f"| {attack} | {row['tries']} | {row['survived']} |" for attack, row in rows.items()]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=tuple(PARTS), action="append")
    parser.add_argument("--scale", type=float, default=1.0, help="times the tries of each row")
    parser.add_argument("--anew", action="store_true")
    parser.add_argument("--write", action="store_true", help="only make the page from what is kept")
    options = parser.parse_args()
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    if not options.write:
        for part in options.only or PARTS:
            run(part, options.scale, options.anew, results)
    PAGE.write_text(page(results), encoding="utf-8")
    sys.exit(any(row["tries"] != row["survived"] for rows in results.values() for row in rows.values()))


if __name__ == "__main__":
    main()
