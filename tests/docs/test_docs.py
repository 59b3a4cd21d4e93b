"""README and docs say what is so: their Python runs, their commands parse, their links lead somewhere."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest
import yaml

import lanebev
from lanebev.cli import parser

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SLOW = {"export.md"}


def _blocks(page, language):
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def _name(page):
    return page.relative_to(ROOT).as_posix()


def _python_pages():
    for page in PAGES:
        blocks = [block for block in _blocks(page, "python") if "--8<--" not in block]
        if blocks:
            marks = pytest.mark.slow if page.name in SLOW else ()
            yield pytest.param(page, blocks, id=_name(page), marks=marks)


@pytest.mark.parametrize(("page", "blocks"), [*_python_pages()])
def test_python_runs(page, blocks, tmp_path, monkeypatch):
    """The blocks of a page run one after the other, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks:
        exec(compile(block, str(page), "exec"), names)


def _commands():
    found = {}
    for page in PAGES:
        lines = "\n".join(_blocks(page, "sh")).replace("\\\n", " ").splitlines()
        for line in lines:
            if command := line.split("#")[0].strip():
                found.setdefault(command, _name(page))
    return found


@pytest.mark.parametrize("command", [*_commands()])
def test_command_is_one(command):
    assert " [" not in command, "expected a command that runs as written, got brackets for an option"
    words = shlex.split(command)
    if words[0] == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert all(re.search(rf"^{word}:", makefile, re.MULTILINE) for word in words[1:] if "=" not in word)
    elif words[0] == "lanebev":
        parser().parse_args(words[1:])
    elif words[0] in ("pip", "pre-commit"):
        assert words[1] == "install"
    else:
        assert words[:2] in (["python", "-m"], [".venv/bin/python", "-m"]) or words[0] == "python", command
        module = words[2] if words[1] == "-m" else words[1].removesuffix(".py")
        if module == "pytest":
            return
        path = ROOT / Path(*re.split(r"[./]", module))
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), command
        for word in words[3:]:
            if word.startswith("configs/"):
                assert (ROOT / word).exists(), command


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        path = target.split("#")[0]
        assert target.startswith("https://") or (page.parent / path).exists(), target


def _resolves(name):
    """Tell whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ImportError:
            continue
        return all((found := getattr(found, part, None)) is not None for part in parts[count:])
    return False


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_names_and_paths_exist(page):
    text = page.read_text(encoding="utf-8")
    for name in set(re.findall(r"`((?:lanebev|train|tools)(?:\.[A-Za-z_]\w*)+)[`(]", text)):
        assert name.endswith(".py") or _resolves(name), name
    for path in set(re.findall(r"`((?:lanebev|train|tools|tests|configs|docs|examples)/[\w/.-]+)`", text)):
        assert (ROOT / path).exists(), path


def test_functions_of_the_paper_exist():
    """In the table of equations: dotted names, of the package they are named after, or of the one before."""
    table = (ROOT / "docs" / "method" / "paper.md").read_text(encoding="utf-8").split("## Deviations")[0]
    homes = (
        "lanebev",
        "lanebev.estimation",
        "lanebev.estimation.two_stage",
        "lanebev.estimation.two_stage.state",
    )
    names = re.findall(r"`([a-z_]+(?:\.\w+)+)`", table)
    assert len(names) > 20
    for name in names:
        assert any(_resolves(f"{home}.{name}") for home in homes), name


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"[\w/]+\.md", text.split("\nnav:")[1]))
    assert listed == {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}


def test_every_public_name_is_on_the_api_pages():
    """In the table of the index, and in a module that a page documents."""
    pages = {page.name: page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md")}
    documented = set(re.findall(r"^::: (\S+)", "\n".join(pages.values()), re.MULTILINE))
    assert set(re.findall(r"`(\w+)`", pages["index.md"])) >= set(lanebev.__all__)
    for name in lanebev.__all__:
        thing = getattr(lanebev, name)
        module = getattr(thing, "__module__", None) or thing.__name__
        if name != "HILLY_ROADS":  # an instance of a class
            assert documented & {module, f"{module}.{name}"}, name


def test_the_version_is_one():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == lanebev.__version__
    assert f"## [{lanebev.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_equations_that_the_joint_calibrator_cites_are_on_its_page():
    page = (ROOT / "docs" / "method" / "joint.md").read_text(encoding="utf-8")
    numbered = [int(number) for number in re.findall(r"\\tag\{J(\d+)\}", page)]
    assert numbered == list(range(1, len(numbered) + 1))
    code = "".join(path.read_text() for path in (ROOT / "lanebev" / "estimation" / "joint").rglob("*.py"))
    cited = {int(number) for number in re.findall(r"\(J(\d+)\)", code)}
    assert cited == set(numbered)


def test_equations_that_the_two_stage_calibrator_adds_are_on_the_paper_s_page_with_their_functions():
    page = (ROOT / "docs" / "method" / "paper.md").read_text(encoding="utf-8")
    numbered = [int(number) for number in re.findall(r"\\tag\{T(\d+)\}", page)]
    assert numbered == list(range(1, len(numbered) + 1))
    folder = ROOT / "lanebev" / "estimation" / "two_stage"
    code = "".join(path.read_text(encoding="utf-8") for path in folder.glob("*.py"))
    assert {int(number) for number in re.findall(r"\(T(\d+)\)", code)} == set(numbered)
    rows = re.findall(r"^\| \(T(\d+)\) \|.*\|(.*)\|$", page, re.MULTILINE)
    assert [int(number) for number, _ in rows] == numbered
    for name in re.findall(r"`(\w+)`", "".join(names for _, names in rows)):
        assert f"def {name}(" in code, name


def test_every_equation_of_the_joint_calibrator_has_a_function():
    """In the table of steps: dotted names, of the joint calibrator's package or of one above it."""
    page = (ROOT / "docs" / "method" / "joint.md").read_text(encoding="utf-8")
    table = page.split("| step |")[1].split("\n\n")[0]
    equations = [int(number) for number in re.findall(r"\bJ(\d+)\b", table)]
    assert sorted(equations) == [int(number) for number in re.findall(r"\\tag\{J(\d+)\}", page)]
    names = re.findall(r"`([a-z_]+(?:\.\w+)+)`", table)
    assert len(names) > len(equations)
    for name in names:
        homes = ("lanebev", "lanebev.estimation", "lanebev.estimation.joint")
        assert any(_resolves(f"{home}.{name}") for home in homes), name


def test_sphinx_roles_of_docstrings_are_shown_as_code():
    specification = importlib.util.spec_from_file_location("roles", ROOT / "docs" / "roles.py")
    roles = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(roles)
    page = "see :func:<code>~lanebev.road.horizon_line</code> and :meth:<code>forward</code>"
    assert roles.on_page_content(page, page=None) == (
        'see <autoref identifier="lanebev.road.horizon_line" optional><code>horizon_line</code></autoref>'
        ' and <autoref identifier="forward" optional><code>forward</code></autoref>'
    )
