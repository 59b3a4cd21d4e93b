"""Camera files that tests write, and what is read from them."""

import json

import torch
import yaml

from lanebev import Camera


def written(path, content):
    """Write bytes, text or fields (as JSON where the name says so, else as YAML); return the path."""
    if not isinstance(content, str | bytes):
        content = json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read(path, content, **options):
    """Write a camera file, and read it."""
    return Camera.from_file(written(path, content), **options)


def assert_same(camera, expected):
    """Check that a camera is the expected one, to rounding."""
    torch.testing.assert_close(camera.intrinsics, expected.intrinsics, rtol=0, atol=1e-12)
    torch.testing.assert_close(camera.distortion, expected.distortion, rtol=0, atol=0)
    assert (camera.model, camera.image_size) == (expected.model, expected.image_size)


def assert_is(camera, *parameters):
    """Check that a camera is the one of these parameters."""
    assert_same(camera, Camera.from_parameters(*parameters))
