"""No file that we read can run code: neither our own modules nor what they call unpickle or evaluate anything."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterable, Iterator

from sources import modules

MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "marshal", "shelve", "yaml", "runpy", "code", "imp"}
CALLS = {"eval", "exec", "compile", "__import__"}
#: attribute calls by their last names: module.function
READERS = {
    ("joblib", "load"),
    ("joblib", "dump"),
    ("np", "load"),
    ("numpy", "load"),
    ("pd", "read_pickle"),
    ("yaml", "load"),
}
#: what may stand where, and why
ALLOWED = {
    # torch's restricted unpickler of tensors, numbers and texts; another test hands it malicious files
    ("openant_agents/runs.py", "torch.load"),
    # what its own parent sends over a private socket pair, which no file can reach
    ("openant_tools/comms/parent.py", "pickle"),
}


def found(nodes: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names if name.name.partition(".")[0] in MODULES)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            module = str(node.module)
            taken = {(module, name.name) for name in node.names}
            if module.partition(".")[0] in MODULES or taken & READERS:
                yield node.lineno, module
        elif isinstance(node, ast.Call):
            called = node.func
            if isinstance(called, ast.Name) and called.id in CALLS:
                yield node.lineno, called.id
            elif isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name):
                name = (called.value.id, called.attr)
                if name in READERS or name == ("torch", "load"):
                    yield node.lineno, ".".join(name)
            for keyword in node.keywords:
                if keyword.arg == "allow_pickle" or (keyword.arg == "weights_only" and not _true(keyword.value)):
                    yield node.lineno, keyword.arg


@functools.cache
def ours() -> dict[str, list[ast.AST]]:
    """What all our modules import and call, by the modules' names."""
    return {
        module.name: [node for node in module.nodes if isinstance(node, ast.Import | ast.ImportFrom | ast.Call)]
        for module in modules()
    }


def _true(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is True


def test_no_module_of_ours_unpickles_or_evaluates() -> None:
    wrong = [
        f"{name}:{line}: {what}"
        for name, nodes in ours().items()
        for line, what in found(nodes)
        if (name, what) not in ALLOWED
    ]
    assert not wrong


def test_checkpoints_are_loaded_by_the_restricted_unpickler_alone() -> None:
    calls = [
        node
        for nodes in ours().values()
        for node in nodes
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "load"
        and ast.unparse(node.func) == "torch.load"
    ]
    assert len(calls) == 1
    assert [_true(k.value) for k in calls[0].keywords if k.arg == "weights_only"] == [True]


def test_the_search_finds_what_it_looks_for() -> None:
    text = "import pickle\nfrom joblib import load\nnp.load('x', allow_pickle=True)\neval('1')\ntorch.load('x', weights_only=False)"
    assert [line for line, _ in found(ast.walk(ast.parse(text)))] == [1, 2, 3, 3, 4, 5, 5]
