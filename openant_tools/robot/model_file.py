"""Whether an MJCF may be given to MuJoCo: its size, its depth, and the files that it names."""

from __future__ import annotations

from pathlib import Path

from lxml import etree

from openant_tools.errors import BadInput
from openant_tools.numbers import literal
from openant_tools.trust import follows_asset

__all__ = ["check_model_file", "parser"]

#: bytes of an MJCF, and of a mesh or picture; elements, and how deep they nest: the largest published models have 5,000, 30 deep
LARGEST, LARGEST_ASSET, MOST, DEEPEST = 16 * 2**20, 256 * 2**20, 50_000, 100
#: what one attribute may ask for, where a few characters ask for memory or minutes: element → attributes, whose product counts
COUNTS = {
    "replicate": (("count",), 1000),
    "composite": (("count",), 10_000),
    "flexcomp": (("count",), 100_000),
    "hfield": (("nrow", "ncol"), 10_000_000),
    "texture": (("width", "height"), 100_000_000),
}
#: and of any element
LENGTHS = {"nsample": 1_000_000, "nuserdata": 10_000_000, "nkey": 100_000, "njmax": 10_000_000, "nconmax": 10_000_000}
FOLDERS = ("meshdir", "texturedir", "assetdir")
_REMEDY = "is it the model that you mean?"


def parser() -> etree.XMLParser:
    """For files of anybody: no entities, no network, no documents of absurd size."""
    return etree.XMLParser(
        remove_blank_text=False, remove_comments=False, resolve_entities=False, no_network=True, huge_tree=False
    )


def check_model_file(path: Path) -> None:
    """Read an MJCF and what it includes, without MuJoCo.

    Raises:
        BadInput: it is too large, nests too deep, declares entities, includes itself, asks for more than a model needs, or
            names a file that is not followed (`openant_tools.trust`); the place is named.
        OSError: it cannot be read.
    """
    _check(path, path.parent, (path.resolve(),))


def _check(path: Path, main: Path, above: tuple[Path, ...]) -> int:
    """How many elements it has, with what it includes."""
    if path.stat().st_size > LARGEST:
        raise BadInput(f"is larger than {LARGEST // 2**20} MiB", where=path, remedy=_REMEDY)
    try:
        tree = etree.parse(str(path), parser())
    except etree.XMLSyntaxError as error:
        raise BadInput(
            f"MuJoCo cannot load it: not well-formed XML: {error.msg}", where=path, remedy="mend the file at that place"
        ) from None
    declared = tree.docinfo.internalDTD
    if declared is not None and any(True for _ in declared.iterentities()):  # type: ignore[union-attr]  # its stub lacks it
        raise BadInput(
            "declares entities, which no model needs", where=path, remedy="write their text where it belongs"
        )
    count, folders = 0, list[str]()
    for element in tree.getroot().iter(etree.Element):
        count += 1
        where = f"{path}, line {element.sourceline}"
        if count > MOST or len(above) > DEEPEST:
            raise BadInput(f"has more than {MOST} elements", where=path, remedy=_REMEDY)
        if sum(1 for _ in element.iterancestors()) > DEEPEST:
            raise BadInput("its elements nest too deep", where=where, remedy=_REMEDY)
        _check_counts(element, where)
        if element.tag == "compiler":
            folders += [str(element.get(name)) for name in FOLDERS if element.get(name)]
        elif element.tag == "include" and element.get("file"):
            count += _included(str(element.get("file")), path, main, above, where)
    for element in tree.getroot().iter(etree.Element):
        if element.tag != "include":
            for name, value in element.attrib.items():
                if str(name).startswith("file") and str(element.tag) != "key":
                    _check_asset(str(value), path, folders, f"{path}, line {element.sourceline}")
    return count


def _included(named: str, path: Path, main: Path, above: tuple[Path, ...], where: str) -> int:
    if not follows_asset(named, main):
        raise _not_followed(named, where)
    file = next((folder / named for folder in (main, path.parent) if (folder / named).is_file()), None)
    if file is None:
        return 0  # MuJoCo says what it looked for
    if file.resolve() in above:
        raise BadInput(f"includes itself ({named})", where=where, remedy="take the include out")
    return _check(file, main, (*above, file.resolve()))


def _check_asset(named: str, path: Path, folders: list[str], where: str) -> None:
    for folder in (*folders, "."):
        place = Path(folder) / named
        if not follows_asset(place, path.parent):
            raise _not_followed(str(place), where)
        file = path.parent / place
        if file.is_file() and file.stat().st_size > LARGEST_ASSET:
            raise BadInput(f"{named} is larger than {LARGEST_ASSET // 2**20} MiB", where=where, remedy=_REMEDY)


def _not_followed(named: str, where: str) -> BadInput:
    return BadInput(
        f"{named} lies elsewhere and is not followed",
        where=where,
        remedy="put it beside the model, or add --trust-paths",
    )


def _check_counts(element: etree._Element, where: str) -> None:
    names, most = COUNTS.get(str(element.tag), ((), 0))
    product = 1.0
    for one in (element, *element.iterancestors("replicate")) if names else ():
        for name in names if one is element else ("count",):
            for number in str(one.get(name, "1")).split():
                product *= max(_number(number), 1.0)
    if product > most > 0:
        raise BadInput(f"asks for {literal(product, 3)} of its {element.tag}", where=where, remedy=_REMEDY)
    for name, most in LENGTHS.items():
        if element.get(name) is not None and _number(str(element.get(name))) > most:
            raise BadInput(f"asks for {name} = {element.get(name)}", where=where, remedy=_REMEDY)
    if element.tag == "size" and str(element.get("memory", ""))[-1:].upper() in ("T", "P", "E"):
        raise BadInput(f"asks for memory = {element.get('memory')}", where=where, remedy=_REMEDY)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0  # MuJoCo says what is wrong with it
