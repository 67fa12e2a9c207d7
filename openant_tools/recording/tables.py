"""Runs as tables, in and out: NAME.parquet or NAME.csv with the facts beside it in NAME.json (formats, section 1)."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openant_tools.errors import BadInput
from openant_tools.files import atomic_writer, read_text, reading
from openant_tools.recording.facts import facts_from_json, facts_to_json
from openant_tools.recording.plausibility import check_names, check_run, check_time, need_signals
from openant_tools.recording.run import BODY_COLUMNS, JOINT_SIGNALS, Facts, Run

if TYPE_CHECKING:
    import pyarrow

__all__ = ["find_run", "parquet_table", "read_run", "read_table", "run_of_columns", "write_table"]

#: bytes of a CSV, and of its first line: an Open Ant's has 1,500
LARGEST_CSV, LONGEST_HEADER = 2**30, 64 * 1024
#: numbers of a table: an hour of an Open Ant at 300 Hz has 80 million
LARGEST_TABLE = 400_000_000
#: rows of a CSV that are words at a time: the words of all would take ten times the memory of the numbers
CSV_ROWS = 20_000
#: words that stand for a number in tables of other software
_WORDS = (
    dict.fromkeys(("", "nan", "NaN", "NAN", "null", "NULL", "None", "NA", "N/A"), np.nan)
    | dict.fromkeys(("true", "True", "TRUE"), 1.0)
    | dict.fromkeys(("false", "False", "FALSE"), 0.0)
)


def read_run(path: str | Path, *, need: Sequence[str] = ("cmd", "pos"), plausible: bool = True) -> Run:
    """The run at `path`: a native recording (.mcap) or a table (.parquet, .csv), checked.

    Args:
        path: the file, or its name without the suffix.
        need: signals without which the run is of no use to the caller; `()` takes any run, such as a log of the bus.
        plausible: refuse a table whose values cannot be in the units that they should be in.

    Raises:
        BadInput: the file, the column and the row of what cannot be, and what to do about it.
    """
    path = find_run(Path(path))
    if path.suffix == ".mcap":
        from openant_tools.recording.reader import read_recording

        run = read_recording(path).run
    else:
        run = read_table(path, plausible=plausible)
    check_time(run.t, str(path))
    need_signals(run, need, str(path))
    return run


def read_table(path: str | Path, *, plausible: bool = True) -> Run:
    """The table at `path` (.parquet or .csv), checked row by row if it has to be plausible; see `read_run`."""
    path = Path(path)
    with reading(path, "this table cannot be read", "export it again"):
        return _read(path, plausible)


def _read(path: Path, plausible: bool) -> Run:
    columns = _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    facts_path = path.with_suffix(".json")
    facts = facts_from_json(read_text(facts_path), str(facts_path)) if facts_path.exists() else None
    return _run(columns, path.stem, facts, path, str(path), plausible)


def run_of_columns(columns: Mapping[str, ArrayLike], *, name: str = "run", need: Sequence[str] = ("cmd", "pos")) -> Run:
    """A run of columns in memory, checked as a file's are.

    Args:
        columns: name → (n,) values, as in a table: `t` in s, `cmd.J`, `pos.J` … of joints; a data frame will do.
        name: what the run is called in reports and messages.
        need: as `read_run`.

    Raises:
        BadInput: the column and the row of what cannot be, and what to do about it.
    """
    named = {str(column): values for column, values in columns.items()}
    check_names(list(named), name)
    read: dict[str, NDArray[Any]] = {}
    for column, values in named.items():
        try:
            read[column] = _numbers(column, _one_a_row(values), name)
        except ValueError as error:
            raise BadInput(
                f"the values are no column of numbers: {error}",
                where=f"{name}, column {column}",
                remedy="give (n,) values, one a row",
            ) from error
    rows = len(read["t"]) if "t" in read else 0
    for column, there in read.items():
        if len(there) != rows and "t" in read:
            raise BadInput(
                f"it has {len(there)} values, t has {rows}",
                where=f"{name}, column {column}",
                remedy="give one value a row; NaN where a sample is missing",
            )
    run = _run(read, name, None, None, name, True)
    need_signals(run, need, name)
    return run


def _run(
    columns: dict[str, NDArray[Any]], name: str, facts: Facts | None, path: Path | None, where: str, plausible: bool
) -> Run:
    """The run of columns that were read, its time apart from them."""
    if "t" not in columns:
        raise BadInput(
            "there is no column t",
            where=where,
            remedy="the first column of a run is t, the time in s" + (f"; here are {_few(columns)}" if columns else ""),
        )
    facts = facts or Facts(joints=_joints_of(list(columns), where))
    t = columns.pop("t")
    if t.dtype.kind != "f":
        raise BadInput("t is not a number", where=f"{where}, column t", remedy="give the time in s, as a number")
    run = Run(name=name, facts=facts, t=t, columns=columns, path=path)
    if plausible:
        check_run(run, where)
    elif not len(t):
        check_time(t, where)
    return run


def write_table(run: Run, path: str | Path) -> None:
    """Write `run` to `path` (.parquet or .csv) and its facts beside it (.json); each file appears whole or not at all.

    Missing samples become null (empty in CSV). A relative `facts.model` is rewritten so that it still leads from the
    new place to the same file.
    """
    path = Path(path)
    if path.suffix not in (".parquet", ".csv"):
        raise BadInput("a table is .parquet or .csv", where=path, remedy="name it NAME.parquet")
    columns = {"t": run.t} | {name: run.columns[name] for name in _in_order(run)}
    parquet = path.suffix == ".parquet" and _parquet(columns)
    with atomic_writer(path) as stream, atomic_writer(path.with_suffix(".json")) as facts_stream:
        if parquet:
            parquet(stream)
        else:
            _write_csv(columns, stream)
        facts_stream.write(facts_to_json(run.facts_at(path.parent)).encode())
        # What is left in the buffers goes to the disk before either file takes its place: a full disk makes neither.
        stream.flush()
        facts_stream.flush()


def find_run(path: Path) -> Path:
    """The file that a RUN on the command line means: the suffix may be missing, or be that of its facts."""
    if path.is_dir():
        places = (path, path / "recordings")  # a robot's folder and that of a training run have them there
        inside = [
            str(file.relative_to(path)) for place in places for file in sorted(place.glob("*")) if _may_be_run(file)
        ]
        raise BadInput(
            "this is a folder, not a run", where=path, remedy=f"name one of {_few(inside)}" if inside else None
        )
    if path.suffix == ".json" and path.exists():
        path = path.with_suffix("")
    if path.exists():
        if path.suffix not in (".mcap", ".parquet", ".csv"):
            raise BadInput(
                "this is not a run", where=path, remedy="a run is a .mcap recording or a .parquet or .csv table"
            )
        return path
    for suffix in (".mcap", ".parquet", ".csv"):
        candidate = path.with_name(path.name + suffix)
        if candidate.exists():
            return candidate
    raise BadInput(
        "there is no such file", where=path, remedy="check the name; `openant rec info FILE` shows what a run holds"
    )


def _may_be_run(file: Path) -> bool:
    """By its name; a CSV by its columns, too: a learning curve is none."""
    if file.suffix != ".csv":
        return file.suffix in (".mcap", ".parquet")
    try:
        with file.open(encoding="utf-8", errors="replace") as stream:
            return "t" in stream.readline(10_000).strip().split(",")
    except OSError:
        return False


def _few(names: Any, count: int = 8) -> str:
    names = list(names)
    return ", ".join(names[:count]) + (", …" if len(names) > count else "")


def _joints_of(names: Sequence[str], where: str) -> tuple[str, ...]:
    """The joints of a table without facts, in the order of their columns."""
    for signal in ("pos", "cmd", *JOINT_SIGNALS):
        joints = tuple(name.partition(".")[2] for name in names if name.startswith(f"{signal}."))
        if joints:
            return joints
    raise BadInput(
        "there is no column of a joint, such as pos.knee_fl",
        where=where,
        remedy=f"name the columns SIGNAL.JOINT ({_few(JOINT_SIGNALS, 5)}); here are {_few(names)}",
    )


def _read_parquet(path: Path) -> dict[str, NDArray[Any]]:
    table = parquet_table(path)
    check_names(table.column_names, str(path))
    return {name: _numbers(name, _of_arrow(name, table[name], path), path) for name in table.column_names}


def parquet_table(path: Path, columns: Sequence[str] | None = None, width: int = 1) -> pyarrow.Table:
    """What a parquet file holds of `columns` (default: of all), by its checksums whole.

    Args:
        width: numbers in a cell, where cells are lists.

    Raises:
        BadInput: it is cut, damaged or no such file, or holds more numbers than a run can have.
        OSError: it cannot be opened.
    """
    from openant_tools.optional import pa, pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            size = file.metadata
            wanted = None if columns is None else [name for name in file.schema_arrow.names if name in columns]
            if size.num_rows * max(size.num_columns if wanted is None else len(wanted), 1) * width > LARGEST_TABLE:
                raise BadInput(
                    f"it has {size.num_rows} rows of {size.num_columns} columns",
                    where=path,
                    remedy="cut it into shorter runs",
                )
            return file.read(wanted)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise BadInput(
            "this is not a whole parquet file (cut or damaged)",
            where=path,
            remedy="copy or export it again; a parquet file cut short has lost its index and cannot be repaired",
        ) from error


def _read_csv(path: Path) -> dict[str, NDArray[Any]]:
    text = read_text(path, LARGEST_CSV)
    first = text[: text.find("\n") + 1 or len(text)]
    if len(first) > LONGEST_HEADER or "\0" in first:
        raise BadInput(
            "the first line is no header of columns",
            where=f"{path}, line 1",
            remedy="name the columns there, as in t,pos.J",
        )
    try:
        header = next(csv.reader(io.StringIO(text)), [])
    except csv.Error as error:
        raise BadInput(
            f"the header cannot be read: {error}", where=f"{path}, line 1", remedy="export it again"
        ) from None
    names = [name.strip() for name in header]
    if not any(names):
        raise BadInput("the run is empty: no header, no rows", where=path, remedy="record again, or export it again")
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        raise BadInput(
            "the values are not separated by commas",
            where=f"{path}, line 1",
            remedy="save it with commas between values and points in numbers",
        )
    check_names([name for name in names if name], f"{path}, line 1")
    # A column without a name is an index, or a comma at the end of every line: it holds nothing of ours.
    names = [name or f"unnamed {k}" for k, name in enumerate(names)]
    words: list[list[Any]] = [[] for _ in names]
    plain = text.find("_", len(first)) < 0  # Python reads 1_0 as ten
    for rows in _csv_rows(text, len(names), path):
        for column, cells in zip(words, zip(*rows, strict=True), strict=True):
            column.append(_floats(cells, plain))
    named = {name: parts for name, head, parts in zip(names, header, words, strict=True) if head.strip()}
    return {name: _numbers(name, _joined(parts), path) for name, parts in named.items()}


def _csv_rows(text: str, width: int, path: Path) -> Iterator[list[list[str]]]:
    """The rows below the header, some thousands at a time; each has a cell for each column."""
    reader = csv.reader(_lines(text), strict=True)
    rows: list[list[str]] = []
    try:
        next(reader, None)
        for row in reader:
            if len(row) != width:
                if not row:
                    continue
                raise BadInput(
                    f"a row has {len(row)} values where the header names {width} columns",
                    where=f"{path}, line {reader.line_num}",
                    remedy="the file was cut or edited: complete that row or delete it",
                )
            rows.append(row)
            if len(rows) == CSV_ROWS:
                yield rows
                rows = []
    except csv.Error as error:
        raise BadInput(
            f"this is not a whole CSV file: {error}", where=f"{path}, line {reader.line_num}", remedy="export it again"
        ) from error
    if rows:
        yield rows


def _lines(text: str) -> Iterator[str]:
    """The lines of a text with their ends, without a copy of it all."""
    at = 0
    while at < len(text):
        end = text.find("\n", at) + 1 or len(text)
        yield text[at:end]
        at = end


def _floats(cells: Sequence[str], plain: bool) -> NDArray[Any]:
    """Cells as float64 where all are numbers, empty or true or false; else as the words that they are."""
    if plain:
        try:
            return np.array([float(cell or "nan") for cell in cells])
        except ValueError:
            pass
    try:
        return np.array([_number(cell) for cell in cells])
    except ValueError:
        return np.array(cells, dtype=object)


def _number(cell: str) -> float:
    """What a cell says; raises ValueError where it is no number and no word for one."""
    cell = cell.strip()
    known = _WORDS.get(cell)
    if "_" in cell:
        raise ValueError(cell)
    return float(cell) if known is None else known


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """The pieces of one column: numbers where all are, else words."""
    if not parts:
        return np.array([])
    if all(part.dtype.kind == "f" for part in parts):
        return np.concatenate(parts)
    return np.concatenate([part if part.dtype == object else _as_words(part) for part in parts])


def _as_words(numbers: NDArray[Any]) -> NDArray[Any]:
    return np.array([str(value) for value in _cells(numbers)], dtype=object)


def _one_a_row(values: ArrayLike) -> NDArray[Any]:
    """The values of one column in memory, (n,); raises ValueError where they are no such thing."""
    array = np.asarray(values)
    if array.ndim != 1:
        raise ValueError(f"they have the shape {array.shape}")
    return array


def _of_arrow(name: str, column: pyarrow.ChunkedArray, path: Path | str) -> NDArray[Any]:
    """One column of a parquet file as numbers with NaN where one is missing, or as words, or as objects."""
    from openant_tools.optional import pa, pc

    column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    kind = column.type
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan)
    if (
        pa.types.is_floating(kind)
        or pa.types.is_integer(kind)
        or pa.types.is_boolean(kind)
        or pa.types.is_decimal(kind)
    ):
        values = pc.fill_null(column.cast(pa.float64(), safe=False), np.nan)
        return np.array(values.to_numpy(zero_copy_only=False), dtype=float)
    if _is_ours(name) and not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise BadInput(f"the values are {kind}, not numbers", where=f"{path}, column {name}", remedy="store float64")
    if pa.types.is_temporal(kind):
        column = column.cast(pa.string())
    out = np.empty(len(column), dtype=object)
    out[:] = column.to_pylist()
    return out


def _is_ours(name: str) -> bool:
    signal = name.partition(".")[0]
    return name == "t" or name in BODY_COLUMNS or (signal in JOINT_SIGNALS and "." in name)


def _numbers(name: str, column: NDArray[Any], path: Path | str) -> NDArray[Any]:
    """One column as float64 with NaN where a sample is missing; words where the format holds words or knows nothing."""
    if name.startswith("err."):
        if column.dtype.kind in "fiub":
            column = _as_words(column)
        return np.array(
            [str(word).strip() if word is not None and word == word else "" for word in column], dtype=object
        )
    if column.dtype.kind in "fiub":
        return column.astype(float)
    if column.dtype.kind in "mM":
        column = column.astype(str)
    known = [None if value is None or value != value else value for value in column.tolist()]
    try:
        return np.array([np.nan if value is None else _of_cell(value) for value in known])
    except (ValueError, TypeError):
        if not _is_ours(name):
            return _words_of(known)
        row, word = next((row, value) for row, value in enumerate(known) if not _is_number(value))
        remedy = "leave a missing sample empty" if "," not in str(word) else "write numbers with a point, not a comma"
        raise BadInput(
            f"{str(word).strip()[:40]!r} is not a number", where=f"{path}, column {name}, row {row + 1}", remedy=remedy
        ) from None


def _of_cell(value: Any) -> float:
    return _number(value) if isinstance(value, str) else float(value)


def _is_number(value: Any) -> bool:
    try:
        return value is None or _of_cell(value) == 0.0 or True
    except (ValueError, TypeError):
        return False


def _words_of(values: Sequence[Any]) -> NDArray[Any]:
    out = np.empty(len(values), dtype=object)
    out[:] = ["" if v is None else v.strip() if isinstance(v, str) else v for v in values]
    return out


def _in_order(run: Run) -> list[str]:
    """Column names as a reader expects them: joint by joint in the run's order, then the body, then the rest."""
    wanted = [f"{signal}.{joint}" for joint in run.joints for signal in JOINT_SIGNALS] + list(BODY_COLUMNS)
    first = [name for name in wanted if name in run.columns]
    return first + [name for name in run.columns if name not in set(first)]


def _parquet(columns: Mapping[str, NDArray[Any]]) -> Callable[[IO[bytes]], None]:
    """What writes columns as a parquet file; made before any file is begun, for pyarrow may be missing."""
    from openant_tools.optional import pa, pq

    arrays = {}
    for name, values in columns.items():
        if values.dtype.kind == "f":
            arrays[name] = pa.array(values, mask=np.isnan(values))
        else:
            arrays[name] = pa.array(values.tolist() if values.dtype.kind in "OU" else values)
    table = pa.table(arrays)
    return lambda stream: pq.write_table(table, stream, compression="zstd", write_page_checksum=True)


def _write_csv(columns: Mapping[str, NDArray[Any]], stream: IO[bytes]) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    rows = len(next(iter(columns.values())))
    for first in range(0, rows, CSV_ROWS):
        cells = [_cells(values[first : first + CSV_ROWS]) for values in columns.values()]
        writer.writerows(zip(*cells, strict=True))
    text.detach()


def _cells(values: NDArray[Any]) -> list[Any]:
    """Values as they stand in a CSV: the shortest words that read back the same, nothing where one is missing."""
    if values.dtype.kind == "f":
        return ["" if v != v else int(v) if abs(v) < 1e15 and v == int(v) else v for v in values.tolist()]
    return ["" if value is None else value for value in values.tolist()]
