"""A table of all parameters of a lens."""

import math

from lanebev.camera.model import Camera

_COEFFICIENTS = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "τx", "τy"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "omni": ("ξ", "k1", "k2", "p1", "p2"),
}


def lens_table(camera: Camera) -> dict[str, str]:
    """Return image size, model, focal lengths, principal point, field of view and every coefficient."""
    height, width = camera.image_size
    (fx, skew, cx), (_, fy, cy), _ = camera.intrinsics.double().tolist()
    table = {
        "model": camera.model,
        "image size": f"{width} × {height} px",
        "focal lengths fx, fy": f"{fx:.2f}, {fy:.2f} px",
        "principal point cx, cy": f"{cx:.2f}, {cy:.2f} px",
    }
    if skew:
        table["skew"] = f"{skew:.4g} px"
    if camera.model == "pinhole":
        across, down = (2 * math.degrees(math.atan(side / 2 / f)) for side, f in ((width, fx), (height, fy)))
        table["field of view, without distortion"] = f"{across:.1f}° × {down:.1f}°"
    names = _COEFFICIENTS[camera.model]
    values = camera.distortion.double().tolist()
    table |= {f"distortion {name}": f"{value:.8g}" for name, value in zip(names, values, strict=False)}
    return table if values else table | {"distortion": "none"}
