"""Options and fixtures of all tests: ``--device`` and ``--dtype`` say where device-agnostic tests run."""

import pytest
import torch
from hypothesis import settings

DTYPES = {"float32": torch.float32, "float64": torch.float64}

settings.register_profile("lanebev", deadline=None, derandomize=True)  # a gate is the same twice
settings.load_profile("lanebev")


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="device of device-agnostic tests: cpu, cuda, or all")
    parser.addoption("--dtype", default="all", choices=(*DTYPES, "all"), help="their floating point type")


def _devices(choice):
    if choice != "all":
        return [choice]
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def pytest_generate_tests(metafunc):
    """Run a test once per device and dtype that the options name, if it asks for them by itself."""
    own = " ".join(str(mark.args[0]) for mark in metafunc.definition.iter_markers("parametrize"))
    wanted = {name for name in ("device", "dtype") if name in metafunc.fixturenames and name not in own}
    if "device" in wanted:
        devices = _devices(metafunc.config.getoption("--device"))
        metafunc.parametrize("device", [torch.device(name) for name in devices], ids=str)
    if "dtype" in wanted:
        choice = metafunc.config.getoption("--dtype")
        names = DTYPES if choice == "all" else [choice]
        metafunc.parametrize("dtype", [DTYPES[name] for name in names], ids=names)


@pytest.fixture(autouse=True)
def _seeded():
    """Make a test's random numbers independent of the tests before it."""
    torch.manual_seed(0)
