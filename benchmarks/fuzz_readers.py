"""Every file that we read, spoilt a great many times: a table for docs/reliability.md.

    python benchmarks/fuzz_readers.py --tries 50000 --state fuzz.json      # so many of each kind; goes on where it stopped
    python benchmarks/fuzz_readers.py --state fuzz.json --table            # the table of what was done so far
    python benchmarks/fuzz_readers.py --state fuzz.json --table --write    # and into docs/reliability.md

The kinds of files and their mutations are those of the tests (tests/readers.py). Survived is what was read, or refused in one
line, within SLOW_S and LARGEST_MB; anything else keeps its file beside the state.
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import reliability
from readers import READERS, Reader, mutations

from openant_tools.errors import OpenAntError
from openant_tools.files import write_text

#: s for one file, on a busy computer; and MB that reading all of them may take at most
SLOW_S, LARGEST_MB = 10.0, 4000
#: tries between two savings
ROUND = 500


def tried(reader: Reader, folder: Path, data: bytes) -> str | None:
    """What went wrong with one file; None where it was read or refused."""
    path = folder / reader.name
    path.write_bytes(data)
    began = time.monotonic()
    try:
        reader.read(path)
    except (OpenAntError, OSError) as error:
        if "\n" in str(error):
            return "more than one line"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return f"{type(error).__name__}: {error}"
    return f"took {time.monotonic() - began:.1f} s" if time.monotonic() - began > SLOW_S else None


def fuzz(kind: str, begin: int, count: int, keep: Path | None = None) -> list[str]:
    """Spoil a kind of file, the mutations from `begin` on; what went wrong."""
    reader, wrong = READERS[kind], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        reader.make(folder)
        good = (folder / reader.name).read_bytes()
        # One seed a round, so that it can be gone on with.
        for k, data in enumerate(itertools.islice(mutations(good, begin), count)):
            found = tried(reader, folder, data)
            if found is not None:
                wrong.append(f"{kind} {begin}+{k}: {found}")
                if keep is not None:
                    (keep / f"{kind.replace(' ', '-')}-{begin}-{k}").write_bytes(data)
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tries", type=int, default=50_000, help="of each kind")
    parser.add_argument("--state", type=Path, default=Path("fuzz_readers.json"))
    parser.add_argument("--table", action="store_true", help="only print what was done")
    parser.add_argument("--write", action="store_true", help="put it into docs/reliability.md")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    state = json.loads(options.state.read_text()) if options.state.is_file() else {}
    while not options.table:
        behind = min(READERS, key=lambda kind: state.get(kind, [0, []])[0])
        done, wrong = state.setdefault(behind, [0, []])
        if done >= options.tries:
            break
        wrong += fuzz(behind, 1000 + done, ROUND, options.state.resolve().parent)
        state[behind] = [done + ROUND, wrong]
        write_text(options.state, json.dumps(state, indent=1) + "\n")
    print("| file | tries | survived |\n|---|---|---|")
    for kind, (done, wrong) in sorted(state.items()):
        print(f"| {kind} | {done} | {done - len(wrong)} |")
    total = sum(done for done, _ in state.values())
    print(f"| **all** | {total} | {total - sum(len(wrong) for _, wrong in state.values())} |")
    if options.write:
        results = json.loads(reliability.RESULTS.read_text(encoding="utf-8"))
        results[reliability.SPOILT] = {
            kind: {"tries": done, "survived": done - len(wrong)} for kind, (done, wrong) in sorted(state.items())
        }
        write_text(reliability.RESULTS, json.dumps(results, indent=1, ensure_ascii=False) + "\n")
        write_text(reliability.PAGE, reliability.page(results))
    for _, wrong in state.values():
        for line in wrong[:5]:
            print(line, file=sys.stderr)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"at most {largest:.0f} MB", file=sys.stderr)
    sys.exit(1 if largest > LARGEST_MB or any(wrong for _, wrong in state.values()) else 0)


if __name__ == "__main__":
    main()
