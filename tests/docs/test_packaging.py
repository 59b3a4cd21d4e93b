"""The wheel declares what it imports, imports nothing that only training needs, and runs by itself."""

import ast
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

import lanebev

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MODULES = {
    "opencv-python-headless": "cv2",
    "pyyaml": "yaml",
    "pillow": "PIL",
    "rerun-sdk": "rerun",
    "mcap-protobuf-support": "mcap_protobuf",
    "foxglove-schemas-protobuf": "foxglove_schemas_protobuf",
}


def _modules(requirements):
    names = [re.split(r"[\[<>=~! ]", requirement)[0].lower() for requirement in requirements]
    return {MODULES.get(name, name) for name in names}


def _imported(folder):
    """Top-level packages that the files of a folder import, in functions too: name -> files."""
    found = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            for name in names:
                found.setdefault(name.split(".")[0], []).append(path.relative_to(ROOT).as_posix())
    return found


RUNTIME = _modules(PROJECT["dependencies"])
EXTRAS = {name: _modules(listed) for name, listed in PROJECT["optional-dependencies"].items()}
IMPORTED = _imported("lanebev")
USED_BY_THE_WHEEL = set.union(
    *(EXTRAS[name] for name in ("export", "rerun", "formats", "fleet", "completion"))
)


def test_every_import_of_the_wheel_is_declared():
    third_party = set(IMPORTED) - sys.stdlib_module_names - {"lanebev"}
    assert third_party <= RUNTIME | USED_BY_THE_WHEEL


def test_every_dependency_is_imported():
    assert set(IMPORTED) >= RUNTIME
    assert set(_imported("train")) | set(_imported("tools")) >= EXTRAS["train"] - {"tensorboard"}


@pytest.mark.parametrize(
    "package", sorted(EXTRAS["train"] | EXTRAS["docs"] | EXTRAS["dev"] | {"train", "tools"})
)
def test_no_file_of_the_wheel_imports_what_only_training_needs(package):
    assert package not in IMPORTED, IMPORTED[package]


@pytest.mark.slow
def test_wheel_runs_without_the_checkout(tmp_path):
    """Only the wheel and its dependencies are on the path; the packages of the extras cannot be imported."""
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", tmp_path]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"lanebev-{lanebev.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    assert {name.split("/")[0] for name in names} == {"lanebev", f"lanebev-{lanebev.__version__}.dist-info"}
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((90, 160, 3), 128, np.uint8))
    (tmp_path / "camera.yaml").write_text("{fx: 130, fy: 130, cx: 79.5, cy: 44.5, width: 160, height: 90}")
    site = next(path for path in sys.path if Path(path, "torch", "__init__.py").exists())
    absent = sorted(EXTRAS["train"] | EXTRAS["export"] | EXTRAS["dev"])
    script = (
        f"import sys; sys.path.append({site!r}); sys.modules.update(dict.fromkeys({absent!r}))\n"
        "import lanebev; from lanebev.cli import main\n"
        f"assert lanebev.__file__.startswith({str(tmp_path)!r}), lanebev.__file__\n"
        "sys.exit(main(['run', 'grey.png', '--camera', 'camera.yaml', '--out', 'out']))"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "MPLCONFIGDIR": str(tmp_path / "mpl")}
    run = [sys.executable, "-S", "-c", script]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "extrinsics.csv").exists()


def test_a_layer_in_another_network_loads_no_decoders():
    code = "import sys, lanebev; print({'av', 'PIL', 'matplotlib'} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "set()"


@pytest.mark.parametrize(
    "start", [["-m", "lanebev"], ["-c", "import sys; sys.argv[0] = 'lanebev'; import lanebev.cli"]]
)
def test_help_is_there_before_torch(start):
    """Torch takes seconds to import; ``--help`` needs none of it."""
    code = [sys.executable, "-X", "importtime", *start, "--help"]
    done = subprocess.run(code, capture_output=True, text=True, check=True)
    imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines()}
    assert "lanebev.cli" in imported
    assert not imported & {"torch", "numpy", "cv2", "av"}


@pytest.mark.slow
def test_the_command_has_the_public_names_too():
    code = "import sys; sys.argv[0] = 'lanebev'; import lanebev; print(lanebev.Status.TRACKING.name)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "TRACKING\n"


def test_version_is_said():
    done = subprocess.run(
        [sys.executable, "-m", "lanebev", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"lanebev {lanebev.__version__}\n"
