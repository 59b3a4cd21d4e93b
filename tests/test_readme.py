"""The README says what is so: its Python runs, its commands parse, its files are there."""

import re
import shlex
from pathlib import Path

import pytest

from lanebev.cli import parser

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def _commands():
    lines = "\n".join(_blocks("sh")).replace("\\\n", " ").splitlines()
    return [line.split("#")[0].strip() for line in lines if line.split("#")[0].strip()]


def test_python_runs():
    blocks = _blocks("python")
    assert len(blocks) >= 2
    names = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)


@pytest.mark.parametrize("command", _commands())
def test_command_is_one(command):
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[0] == "lanebev":
        parser().parse_args(words[1:])
    elif words[0] == "pip":
        assert words[1] == "install"
    else:
        assert words[:2] == ["python", "-m"] or words[0] == "python", command
        module = words[2] if words[1] == "-m" else words[1].removesuffix(".py")
        path = ROOT / Path(*re.split(r"[./]", module))
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), command
        for word in words[3:]:
            if word.startswith("configs/"):
                assert (ROOT / word).exists(), command


def test_links_are_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target
