"""Data flows one way: no package of lanebev imports one above it, no two modules import each other."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

LAYERS = (  # from the bottom: a package imports packages of lower layers only, and its own modules
    {"pipes", "signals", "torch_internals"},
    {"numbers", "tensors"},
    {"geometry.rotation"},  # angles to matrices, which Extrinsics offers as methods
    {"types", "batch", "plain_yaml"},
    {"geometry"},
    {"camera"},
    {"observation"},
    {"estimation", "weights"},
    {"view", "testing"},
    {"render"},
    {"clips"},
    {"pipeline"},
    {"io"},
    {"session", "export"},
    {"report"},
    {"app"},
    {"api"},
    {"cli"},
    {"lanebev", "__main__"},  # lanebev: the names that the package exports
)
LAYER = {name: number for number, names in enumerate(LAYERS) for name in names}
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in (ROOT / "lanebev").rglob("*.py")
}


def _imports(name):
    """Modules of lanebev that a module imports anywhere: in functions and under TYPE_CHECKING too."""
    for node in ast.walk(ast.parse(FILES[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in FILES)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: expected absolute imports, as everywhere in the package"
            for alias in node.names:
                if alias.name == "__version__":
                    continue
                found = f"{node.module}.{alias.name}"
                found = found if found in FILES else node.module
                if found in FILES:
                    yield found


GRAPH = {name: set(_imports(name)) - {name} for name in FILES}


def _package(name):
    if name in ("lanebev.geometry.precision", "lanebev.geometry.rotation"):
        return "geometry.rotation"
    return name.split(".")[1] if "." in name else name


def test_every_package_has_a_layer():
    assert {_package(name) for name in FILES} <= set(LAYER), "give the new package a place in LAYERS"


@pytest.mark.parametrize(
    "package",
    sorted({_package(name) for name in FILES}),
)
def test_no_import_runs_upwards(package):
    upwards = [
        f"{name} imports {other}"
        for name, others in GRAPH.items()
        for other in others
        if _package(name) == package != _package(other) and LAYER[_package(other)] >= LAYER[package]
    ]
    assert not upwards


def test_no_modules_import_each_other():
    TopologicalSorter(GRAPH).prepare()  # raises CycleError, which names the circle


def test_nothing_is_of_any_type_where_parts_are_put_together():
    """Neither the interface of calibrators nor app/ gives up the check of types."""
    paths = [*(ROOT / "lanebev" / "app").rglob("*.py"), ROOT / "lanebev" / "estimation" / "calibrator.py"]
    found = {
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in paths
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name) and node.id == "Any"
    }
    assert not found


MAPPED = sorted(  # the packages, whose docstrings say which module does what; two are one module and files
    path.parent.relative_to(ROOT).as_posix()
    for path in ROOT.glob("lanebev/*/**/__init__.py")
    if path.parent.name not in ("weights", "templates")
)


@pytest.mark.parametrize("package", [*MAPPED, "tools", "train"])
def test_a_package_names_all_of_its_modules(package):
    folder = ROOT / package
    named = re.findall(
        r"``(\w+)``", ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))
    )
    modules = {path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert sorted(named) == sorted(modules - {"__init__", "__main__", "__pycache__"})


@pytest.mark.parametrize("package", MAPPED)
def test_packages_inside_a_package_do_not_import_each_other(package):
    """A folder of modules is one node; the graph of the nodes has no circle either."""
    before = f"{package.replace('/', '.')}."
    nodes = {}
    for name, others in GRAPH.items():
        if name.startswith(before):
            inside = {other[len(before) :].split(".")[0] for other in others if other.startswith(before)}
            nodes.setdefault(name[len(before) :].split(".")[0], set()).update(inside)
    TopologicalSorter({node: others - {node} for node, others in nodes.items()}).prepare()
